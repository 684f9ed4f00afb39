"""A prior learned from a fleet: `pool(fleet)`.

    theta_i ~ N(mean, cov)          the parameters of unit i at its first sample
    y_i     from the model of the fleet with theta_i, and the drift and noise of its tracker

Each unit was tracked from a diffuse start, so the likelihood of its record, as a function of theta_i, is N(t_i, P_i)
with the smoothed first sample: no information is lost (models are linear and Gaussian given the regressors). Mean and
covariance maximise

    L = sum_i log N(t_i; mean, cov + P_i) - 1/2 log det sum_i (cov + P_i)^-1         (restricted likelihood)

over a triangular root of cov, by quasi-Newton steps with the exact gradient. With K_i = cov (cov + P_i)^-1 and V the
variance of the estimated mean,

    theta_i | all records ~ N(mean + K_i (t_i - mean), cov - K_i cov + (I - K_i) V (I - K_i)')

The result shrinks each unit towards the others, by as much as its own record leaves open and no more; units with short
records gain most. ``tracker`` starts from N(mean, cov + V), the prediction for a unit that the fleet does not have yet.

With ``noise="each"`` the noise variance of unit i is c_i r, and its drift c_i q. Then t_i is the same, P_i becomes
c_i P_i, and the nu_i residuals of its record say what c_i is. All c_i maximise, together with mean and cov,

    L - 1/2 sum_i (nu_i log c_i + sum_t e_it^2 / (c_i s_it))                     (e, s: innovations for c_i = 1)

Use it for units of the same type. It assumes that theta_i are normal about one mean: look at ``theta`` for groups. The
uncertainty of cov itself is left out: with forty units bands of 95 % cover about 90 %.

Source: Harville, Maximum likelihood approaches to variance component estimation, J. American Statistical Association 72
(1977); Laird and Ware, Random-effects models for longitudinal data, Biometrics 38 (1982). Cost: O(units n^3) for each
of some thirty iterations.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of, plain, warn
from driftfit.run.result import Track
from driftfit.show.text import Printed, path_table
from driftfit.smooth.smoothed import Smoothed
from driftfit.trackers.kalman import Kalman


@dataclass(frozen=True, eq=False)
class Pooled(Printed):
    """The prior of a fleet, and each unit under it.

    Attributes
    ----------
    names, keys : tuples
        Names of the parameters, and the units that were used.
    mean, cov : (n,), (n, n)
        The distribution of theta_i over units.
    theta, std : (units, n)
        Parameters of each unit at its first sample, given its own record and the fleet.
    own : (units, n)
        The same given its own record alone.
    noise : (units,)
        Noise variance of each unit.
    tracker : Kalman
        The fleet's tracker, to start a new unit; with the geometric mean of ``noise``.
    loglik : float
        The maximised restricted log-likelihood L, without its constant.
    """

    names: tuple[str, ...]
    keys: tuple[Hashable, ...]
    mean: Array
    cov: Array
    theta: Array
    std: Array
    own: Array
    noise: Array
    tracker: Kalman
    loglik: float

    def __rich__(self) -> Any:
        title = f"Prior of {len(self.keys)} units"
        return path_table(title, ("mean",), self.mean[:, None], self.spread[:, None], self.names)

    @property
    def spread(self) -> Array:
        """Standard deviation of each parameter over units, (n,)."""
        return np.asarray(np.sqrt(np.diag(self.cov)))


def pool(fleet: Mapping[Hashable, Track], noise: str = "given") -> Pooled:
    """The prior that the units of a fleet share.

    Parameters
    ----------
    fleet : Fleet, or mapping from key to Track
        Runs of one model with `Kalman`, each from the diffuse start (p0=None).
    noise : "given" or "each"
        The noise variance of the tracker, or one for each unit by restricted likelihood, which keeps q / r.

    Raises
    ------
    ValueError
        If units have another tracker than one such Kalman, or fewer than n + 2 of them determine all parameters.
    """
    each = one_of("pool", "noise", noise, ("given", "each")) == "each"
    runs = dict(fleet.items())
    first = next(iter(runs.values()), None)
    tracker = None if first is None else first.tracker
    if first is None or not isinstance(tracker, Kalman) or tracker.p0 is not None:
        raise ValueError(f"pool: track the fleet with Kalman from the diffuse start (p0=None); got {tracker!r}.")
    if any(one.tracker != tracker or one.names != first.names for one in runs.values()):
        raise ValueError("pool: all units must have one model and one tracker.")
    n, found = len(first.names), {}
    for key, run in runs.items():
        smoothed = Smoothed.of(run, "cov")
        P = smoothed.cov(0)
        if np.isfinite(P).all() and np.diag(P).min() > 0.0:
            used = run.ok & np.isfinite(run.innovation_std)
            z = run.innovation[used] / run.innovation_std[used]
            found[key] = smoothed.theta[0], P, z.size * each, z @ z
    if len(found) < n + 2:
        raise ValueError(
            f"pool: {len(found)} of {len(runs)} units determine all {n} parameters; at least {n + 2} are needed."
        )
    if len(found) < len(runs):
        warn(f"pool: {len(runs) - len(found)} of {len(runs)} units do not determine all parameters, and are left out.")
    t, P, nu, rss = (np.array(part) for part in zip(*found.values(), strict=True))
    mean, cov, V, c, loglik = maximised(t, P, nu, rss)
    P = c[:, None, None] * P
    K = cov @ np.linalg.inv(cov + P)
    theta = mean + np.einsum("iab,ib->ia", K, t - mean)
    left = np.eye(n) - K
    var = np.einsum("iaa->ia", cov - K @ cov + left @ V @ left.transpose(0, 2, 1))
    typical = np.exp(np.mean(np.log(c)))
    q, r = (plain(typical * np.asarray(one)) for one in (tracker.q, tracker.r))
    started = replace(tracker, q=q, r=r, theta0=plain(mean), p0=plain(0.5 * (cov + V + (cov + V).T)))
    std = np.sqrt(np.maximum(var, 0.0))
    return Pooled(first.names, tuple(found), mean, cov, theta, std, t, c * np.asarray(tracker.r), started, loglik)


def maximised(t: Array, P: Array, nu: Array, rss: Array) -> tuple[Array, Array, Array, Array, float]:
    """(mean, cov, variance of mean, c, L) from estimates t (units, n) and their covariances P (units, n, n), and the
    number nu (units,) of residuals and their sums of squares; c is 1 where nu is 0.
    """
    from scipy import optimize  # a fifth of a second to import

    n, free = t.shape[1], np.flatnonzero(nu)
    unit = np.sqrt(np.mean(np.einsum("iaa->ia", P), axis=0) + np.var(t, axis=0))
    t, P, lower = t / unit, P / np.outer(unit, unit), np.tril_indices(n)
    entries, log_c = len(lower[0]), np.zeros(len(t))

    def parts(x: Array) -> tuple[float, Array, Array, Array, Array, Array]:
        """-L, its gradient, mean, cov, V, c for the entries of a triangular root, and the log c of units with nu."""
        root = np.zeros((n, n))
        root[lower], log_c[free] = x[:entries], x[entries:]
        cov, c = root @ root.T, np.exp(log_c)
        scaled = c[:, None, None] * P
        W = np.linalg.inv(cov + scaled)
        V = np.linalg.inv(W.sum(axis=0))
        mean = V @ np.einsum("iab,ib->a", W, t)
        Wo = np.einsum("iab,ib->ia", W, t - mean)
        logs = np.sum(np.linalg.slogdet(W)[1]) + np.linalg.slogdet(V)[1]
        loss = 0.5 * (np.einsum("ia,ia->", Wo, t - mean) - logs + np.sum((nu * log_c + rss / c)[free]))
        slope = W - Wo[:, :, None] * Wo[:, None, :] - W @ V @ W
        of_c = 0.5 * (np.einsum("iab,iab->i", slope, scaled) + nu - rss / c)
        return float(loss), np.append((slope.sum(axis=0) @ root)[lower], of_c[free]), mean, cov, V, c

    start = np.linalg.cholesky(np.cov(t.T).reshape(n, n) + 1e-6 * np.eye(n))[lower]
    begin = np.append(start, np.log(rss[free] / nu[free]))
    found = optimize.minimize(
        lambda x: parts(x)[:2], begin, jac=True, method="L-BFGS-B", options={"ftol": 1e-14, "gtol": 1e-7}
    )
    loss, _, mean, cov, V, c = parts(found.x)
    scale = np.outer(unit, unit)
    return mean * unit, cov * scale, V * scale, c, -loss - (len(t) - 1) * float(np.sum(np.log(unit)))

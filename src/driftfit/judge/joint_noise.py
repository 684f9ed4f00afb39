"""One noise for several outputs: the covariance R of their noises, unknown, with an inverse Wishart distribution.

    Y_t = Theta_t' phi_t + v_t,   v_t ~ N(0, R / w_t);    Theta | R ~ MN(M, V, R),   R ~ IW(nu, S)

Outputs on the same regressors share V, whatever R is, and their estimates are those of each output alone. So the lanes
of a run have M, V and the innovations e_t (ny,) with q_t = phi' V phi + 1 / w. The joint noise adds to them

    y_t | past ~ t_(nu - ny + 1),   log p = lgamma((nu+1)/2) - lgamma((nu-ny+1)/2) - ny/2 log(pi q) - 1/2 log |S|
                                            - (nu+1)/2 log(1 + e' S^-1 e / q)
    S <- lambda S + e e' / q,   nu <- lambda nu + 1,   R_t = S / nu,   cov(Theta) = R (x) V

beginning with the improper prior |R|^(-(ny+1)/2), nu = 0 and S = 0. The diagonal of R_t is what each output estimates
of its own noise; the rest is what their noises have in common. With it the outputs can be followed as one:
`JointNoise.rows` are regressions whose noises are independent with one variance, so that a `Bank` has one tree of
events for all outputs.

A sample at which an output is missing has the marginal density of the others and leaves S as it is; afterwards V is not
quite the same for all, and every innovation is divided by its own q.

Source: West and Harrison (1997), section 16.4; Geisser (1965) for the density. Cost: one replay of the run, O(ny^3) per
sample.
"""

from __future__ import annotations

import numpy as np
import scipy

from driftfit.engine.kernel import Array, State, kernel
from driftfit.models.regression import Regression
from driftfit.run.fleet import Outputs


@kernel
def store(o: State, s: State, l: int) -> None:
    """The factor of P after the sample, and the regressor."""
    o.scale[l], o.valid[l] = s.scale[l], s.valid[l]
    for i in range(s.phi.shape[0]):
        o.phi[i, l] = s.phi[i, l]


class JointNoise:
    """The common noise of the outputs of a run.

    Parameters
    ----------
    run : a run with several outputs, each with its own theta, of a tracker that estimates its noise (`RLS`, `FLS`)
    memory : number of samples, or None
        Samples over which the noise is estimated: lambda = 1 - 1 / memory for each sample. None: all samples.

    Attributes
    ----------
    cov : (T, ny, ny)
        R after each sample; NaN before the first residual.
    phi : (T, n)
        The regressors that the outputs share; NaN where a sample has none.
    log_density : (T,)
        Log density of all outputs of a sample given earlier ones, NaN until there are ny residuals.

    Raises
    ------
    ValueError
        If the noise variance is a setting of the tracker, the run has one output, or memory is not above ny + 1.
    """

    def __init__(self, run: Outputs, memory: float | None = None) -> None:
        ny = len(run.outputs)
        if not all(tracker.learns_noise for tracker in run.trackers):
            raise ValueError(
                f"joint_noise: {type(run.trackers[0]).__name__} does not estimate the noise of its innovations; track "
                "with RLS or FLS."
            )
        if memory is not None and not memory > ny + 1.0:
            raise ValueError(f"joint_noise: memory must be above {ny + 1} samples for {ny} outputs; got {memory!r}.")
        self.run, out = run, run.replayed(store, ("scale", "phi", "valid"))
        first = np.array([float((one.start or {}).get("scale", np.nan)) for one in run.values()])
        if not (out["phi"] == out["phi"][..., :1]).all():
            raise ValueError("joint_noise: needs outputs with the same regressors, such as those of ARX or Regression.")
        last = np.concatenate([first[None], out["scale"][:-1]])
        with np.errstate(invalid="ignore", divide="ignore"):
            begun = np.isnan(last) & (out["e"] != 0.0)  # the sample that gave the first scale
            q = np.where(begun, out["e"] ** 2 / out["scale"], out["s"] / last)  # variances in units of the noise
        q = np.where((out["ok"] > 0.0) & np.isfinite(q) & (q > 0.0), q, np.nan)
        self.phi = np.where(out["valid"][:, :1] > 0.0, out["phi"][..., 0], np.nan)
        keep = 1.0 if memory is None else 1.0 - 1.0 / memory
        z = run.innovation / np.sqrt(q)
        whole = np.isfinite(z).all(axis=1)
        S = scipy.signal.lfilter([1.0], [1.0, -keep], z[whole, :, None] * z[whole, None, :], axis=0)
        nu = scipy.signal.lfilter([1.0], [1.0, -keep], np.ones(int(whole.sum())))
        after = np.cumsum(whole)
        S, nu = np.concatenate([np.zeros((1, ny, ny)), S]), np.concatenate([[0.0], nu])
        with np.errstate(invalid="ignore"):
            self.cov: Array = S[after] / nu[after, None, None]
        before: Array = after - whole
        d = np.where(before >= ny, keep * nu[before] - ny + 1.0, 0.0)
        self.log_density: Array = _log_density(z, q, keep * S[before], d)

    @property
    def loglik(self) -> float:
        """The sum of `log_density`: the log evidence of all outputs together, given the samples of the start."""
        return float(np.nansum(self.log_density))

    @property
    def correlation(self) -> Array:
        """(T, ny, ny): correlations of the noises."""
        std = np.sqrt(np.einsum("tii->ti", self.cov))
        return np.asarray(self.cov / (std[:, :, None] * std[:, None, :]))

    def theta_cov(self, t: int) -> Array:
        """Covariance (ny n, ny n) of theta of all outputs, output by output, after sample t: R (x) V."""
        roots = [np.linalg.cholesky(one) for one in self.run.cov(t)]
        share = self.correlation[t]
        return np.block([[share[i, j] * a @ b.T for j, b in enumerate(roots)] for i, a in enumerate(roots)])

    def rows(self, R: Array | None = None) -> tuple[Regression, Array, Array]:
        """(model, y (T, ny), u (T, ny, ny n)): the outputs as measurements of one theta, with independent noises.

            L^-1 y_t = (L^-1 (x) phi_t') vec(Theta) + noise of variance 1,     L L' = R

        ``R`` (ny, ny) is that after the last sample unless it is given. Track it with any tracker, ``track(*rows[:1],
        Bank(), *rows[1:])``: noise variance 1, or unknown if R is known up to a factor only.
        """
        run, ny = self.run, len(self.run.outputs)
        R = self.cov[-1] if R is None else np.asarray(R, dtype=float)
        phi, y = self.phi, run.y
        rows_y, rows_u = np.full(y.shape, np.nan), np.full((len(y), ny, ny * phi.shape[1]), np.nan)
        blocks = np.einsum("ij,tk->tijk", np.eye(ny), phi).reshape(len(y), ny, -1)
        for observed, at in _patterns(np.isfinite(y)):
            L = np.linalg.cholesky(R[np.ix_(observed, observed)])
            place = np.ix_(at, observed)
            rows_y[place] = np.linalg.solve(L, y[place].T).T
            rows_u[place] = np.linalg.solve(L, blocks[place])
        names = tuple(name for each in run.names for name in each)
        return Regression(names, ny=ny, shared=True), rows_y, rows_u


def _log_density(z: Array, q: Array, S: Array, d: Array) -> Array:
    """Log density (T,) of the observed outputs; S (T, ny, ny) and the degrees of freedom d are those before
    the sample.
    """
    found, gamma = np.full(len(z), np.nan), scipy.special.gammaln
    for observed, rows in _patterns(np.isfinite(z)):
        at, k = rows[d[rows] > 0.0], len(observed)
        if not len(at):
            continue
        inner, e = S[np.ix_(at, observed, observed)], z[np.ix_(at, observed)]
        far = np.einsum("ti,ti->t", e, np.linalg.solve(inner, e[..., None])[..., 0])
        wide = k * np.log(np.pi) + np.linalg.slogdet(inner)[1] + np.log(q[np.ix_(at, observed)]).sum(axis=1)
        ratio = gamma(0.5 * (d[at] + k)) - gamma(0.5 * d[at])
        found[at] = ratio - 0.5 * wide - 0.5 * (d[at] + k) * np.log1p(far)
    return found


def _patterns(there: Array) -> list[tuple[Array, Array]]:
    """Every pattern of observed outputs and the samples that have it; samples without an output are left out."""
    kinds, which = np.unique(there, axis=0, return_inverse=True)
    each = [(np.flatnonzero(kind), np.flatnonzero(which.ravel() == k)) for k, kind in enumerate(kinds)]
    return [(observed, at) for observed, at in each if len(observed)]

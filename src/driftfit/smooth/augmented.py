"""The iterative smoother of augmented flexible least squares, as published and in a form that converges.

With N_m(b; t) = b + phi_t (y_t - phi_t' b) / (m / weight_t + phi_t' phi_t), sweep l = 1, 2, .. runs over increasing t:

    t < T          theta_l(t) = N_2mu(w theta_l(t-1) + (1 - w) theta_{l-1}(t+1))
    ends="printed"    t = T:  theta_l(T) = w N_2mu(theta_l(T-1)) + (1 - w) theta_{l-1}(T);  theta_l(0) = theta0
    ends="corrected"  t = 1:  N_mu(theta_{l-1}(2));   t = T:  N_mu(theta_l(T-1))
    schedule="power"     w = lam^l, while lam^l >= tol
    schedule="constant"  w = lam, until a sweep changes theta by less than tol

w = 1/2 with corrected ends is block Gauss-Seidel on the normal equations and converges to the exact smoother, in more
sweeps for larger mu. The exact smoother costs about as much as a few sweeps, so this one is for comparison only. The
power schedule does not converge to that path: it passes near it while w is about 1/2 and then departs from it, and its
tol determines the number of sweeps, not an accuracy. A w = lam other than 1/2 minimises another cost, which gives later
or earlier increments more weight.

Source: Chen et al., "augmented flexible least squares for time-varying parameter systems", eq. 28-30. Departures: index
errors at t = T are corrected as above. Cost: O(T n) per sweep.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.engine.settings import numbers, one_of, vector, whole
from driftfit.run.result import Track
from driftfit.smooth.exact import smooth
from driftfit.smooth.problem import walk_of
from driftfit.smooth.solvers.walk import WEIGHT, Y, constants
from driftfit.trackers.augmented_fls import AugmentedFLS


class AugmentedPath(NamedTuple):
    """The result of the sweeps."""

    theta: Array
    """(T, n)"""
    sweeps: int
    change: float
    """Largest change of theta in the last sweep."""


def augmented(
    run: Track,
    schedule: str = "power",
    lam: float | None = None,
    ends: str | None = None,
    start: Array | float | None = None,
    tol: float | None = None,
    max_sweeps: int = 10_000,
) -> AugmentedPath:
    """Smooth a run of `AugmentedFLS` by sweeps.

    Parameters
    ----------
    run : Track
        A run of `AugmentedFLS`, evenly sampled: its mu and theta0 (theta before the first sample) are used.
    schedule : "power" or "constant"
        How the weight of the past changes from sweep to sweep.
    lam : number in (0, 1)
        0.8 for "power", 0.5 for "constant".
    ends : "printed" or "corrected"
        "printed" for "power", "corrected" for "constant".
    start : (T, n) or number
        The path before the first sweep; None: the tracker's theta0 everywhere.
    tol : number
        0.01 for "power", 1e-10 for "constant".
    max_sweeps : int
        Largest number of sweeps.

    Raises
    ------
    ValueError
        For another tracker, uneven steps, or a setting outside its range.
    """
    if not isinstance(run.tracker, AugmentedFLS):
        raise ValueError(
            f"augmented: the run must be one of AugmentedFLS; got {type(run.tracker).__name__}, whose exact smoother "
            "is run.smooth()."
        )
    power = one_of("augmented", "schedule", schedule, ("power", "constant")) == "power"
    printed = one_of("augmented", "ends", ends or ("printed" if power else "corrected"), ("printed", "corrected"))
    lam = numbers("augmented", "lam", lam or (0.8 if power else 0.5), ndim=0, low=0.0, strict=True)
    if lam >= 1.0:
        raise ValueError(f"augmented: lam must be in (0, 1); got {lam!r}.")
    tol = float(numbers("augmented", "tol", tol or (0.01 if power else 1e-10), ndim=0, low=0.0, strict=True))
    walk = walk_of(run, constants(run.model.n))
    T, n = walk.phi.shape
    started = np.flatnonzero(walk.drift)
    if started.size and np.ptp(walk.drift[started]) > 0.0:
        raise ValueError("augmented: the sweeps need even steps; run.smooth() of an FLS run does not.")
    before = vector("augmented", "theta0", run.tracker.theta0, n)
    theta = np.array(np.broadcast_to(before if start is None else np.asarray(start, dtype=float), (T, n)))
    if printed == "corrected" and T == 1:
        return AugmentedPath(smooth(walk._replace(theta0=before)).theta, 0, 0.0)
    mu, change, l = float(run.tracker.mu or 0.0), np.inf, 0
    for l in range(1, whole("augmented", "max_sweeps", max_sweeps, 1) + 1):
        if power and lam**l < tol:
            return AugmentedPath(theta, l - 1, change)
        w = lam**l if power else lam
        change = sweep(theta, before, walk.phi, walk.signals, mu, w, printed == "printed")
        if not power and change < tol:
            break
    return AugmentedPath(theta, l, change)


@Driver
def sweep(theta: Array, before: Array, phi: Array, signals: Array, mu: float, w: float, printed: bool) -> float:
    """One sweep in place; returns the largest change."""
    T, n = phi.shape
    b = np.empty(n)
    change = 0.0
    for t in range(T):
        past = theta[t - 1] if t > 0 else before
        end = t == T - 1 or (t == 0 and not printed)
        for i in range(n):
            if t == T - 1:
                b[i] = past[i]
            elif end:
                b[i] = theta[t + 1, i]
            else:
                b[i] = w * past[i] + (1.0 - w) * theta[t + 1, i]
        price = mu if end and not printed else 2.0 * mu
        error, power, weight = signals[t, Y], 0.0, signals[t, WEIGHT]
        for i in range(n):
            error -= phi[t, i] * b[i]
            power += phi[t, i] * phi[t, i]
        gain = weight * error / (price + weight * power)
        for i in range(n):
            new = b[i] + gain * phi[t, i]
            if printed and t == T - 1:
                new = w * new + (1.0 - w) * theta[t, i]
            change = max(change, abs(new - theta[t, i]))
            theta[t, i] = new
    return change

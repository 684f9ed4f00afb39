"""Whiteness of a sequence: autocorrelations whose limits do not require a constant variance; and the size of residuals.

    r_k = sum z_t z_(t-k) / sum z_t^2,   se_k^2 = sum z_t^2 z_(t-k)^2 / (sum z_t^2)^2,   Q = sum_k (r_k / se_k)^2

Q is chi-square with K degrees of freedom for martingale differences, whatever their variance. Values are first clipped
at three robust standard deviations, so that a pair of outliers does not decide. Source: Lo and MacKinlay (1989).

Whether residuals are larger where a regressor is: squares, clipped, against the ranks of its size, with the Bartlett
variance of the sum over 4 (N / 100)^(2/9) lags (White 1980, Newey and West 1987, 1994). A gain that is drawn again at
every sample does that, and so does noise that grows with the input: the two are the same distribution of y.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array, Driver
from driftfit.judge.statistics.paired import long_run
from driftfit.judge.statistics.robust import deviation, scale_of

LOUDER = 1e-3
"""p-value, one-sided, of residuals of one size below which they grow with a regressor."""


class Whiteness(NamedTuple):
    """Correlations at K lags with their standard errors under whiteness, Q and its p-value."""

    r: Array
    std: Array
    Q: float
    p: float


def clipped(z: Array) -> Array:
    """z limited to three robust standard deviations, with missing values as 0."""
    z = np.where(np.isfinite(z), z, 0.0)
    used = np.abs(z[z != 0.0])
    limit = 3.0 * deviation(used) if used.size else 0.0
    return np.clip(z, -limit, limit)


def whiteness(z: Array, lags: int | None = None) -> Whiteness:
    """Test z (N,), in order of time, NaN for missing values; 20 lags unless N is below 100."""
    z = clipped(z)
    K = min(20, len(z) // 5) if lags is None else lags
    return _correlation(z, z, range(1, K + 1))


def crossing(z: Array, u: Array, lags: int = 10) -> Whiteness:
    """Correlations of z (N,) with u (N,) of 0 .. lags samples before."""
    u = u - np.mean(u[np.isfinite(u)]) if np.isfinite(u).any() else u
    return _correlation(clipped(z), np.where(np.isfinite(u), u, 0.0), range(min(lags, len(z) - 1) + 1))


def _correlation(z: Array, u: Array, lags: range) -> Whiteness:
    total = np.sqrt(np.sum(z * z) * np.sum(u * u))
    if not total > 0.0 or not len(lags):
        unknown = np.full(len(lags), np.nan)
        return Whiteness(unknown, unknown, float("nan"), float("nan"))
    past = np.concatenate([np.zeros(lags[-1]), u])
    shifted = np.lib.stride_tricks.sliding_window_view(past, len(u))[lags[-1] - np.array(lags)]
    r = shifted @ z / total
    std = np.sqrt((shifted * shifted) @ (z * z)) / total
    Q = float(np.sum((r[std > 0.0] / std[std > 0.0]) ** 2))
    return Whiteness(r, std, Q, float(scipy.special.chdtrc(len(lags), Q)))


def ranks(phi: Array) -> Array:
    """Ranks (N, n) of the sizes of every regressor of phi (N, n), equal ones for equal sizes, about their mean."""
    ranked = np.empty(phi.shape)
    for j in range(phi.shape[1]):
        size = np.abs(phi[:, j])
        known = np.sort(size)
        ranked[:, j] = np.searchsorted(known, size, "left") + np.searchsorted(known, size, "right")
        ranked[:, j] = (ranked[:, j] - np.mean(ranked[:, j])) / (2.0 * len(phi))
    return ranked


@Driver
def _growth(z: Array, ranked: Array) -> Array:
    """Statistics (n,) of whether residuals z (N,) grow with regressors of these ranks (N, n), normal if they do not."""
    square, t = np.minimum(np.abs(z), 3.0 * scale_of(z[z != 0.0])) ** 2, np.empty(ranked.shape[1])
    for j in range(len(t)):
        d = (square - np.mean(square)) * ranked[:, j]
        v = len(z) * long_run(d)
        t[j] = np.sum(d) / np.sqrt(v) if v > 0.0 else -np.inf
    return t


def loudest(z: Array, ranked: Array) -> int | None:
    """The regressor, of those with `ranks` (N, n), with which residuals z (N,) grow most clearly; None if with none."""
    t = _growth(z, ranked) if z.any() else np.full(ranked.shape[1], -np.inf)
    most = int(np.argmax(t))
    return most if scipy.special.ndtr(-t[most]) * len(t) < LOUDER else None

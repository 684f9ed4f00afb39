"""Are the coefficients of a regression constant? A score test with the null of the record itself.

    theta    the constant that solves sum phi_t psi(e_t) = 0,  e_t = y_t - phi_t' theta
    psi(e)   = e clipped at 1.5 scales of the noise
    S_t      = sum_{s <= t} phi_s psi(e_s)                      score path, 0 at the end
    A_t      = sum_{s <= t} phi_s phi_s' psi'(e_s)              information
    V_t      = sum_{s <= t} phi_s phi_s' psi(e_s)^2             variance of the scores
    L_i      = mean_t S_ti^2 / V_Ti,    L = mean_t S_t' V_T^-1 S_t                (Nyblom 1989, Hansen 1992)

If theta is constant, S_t = F_t - A_t A_T^-1 F_T, where F has independent increments of variance dV_t, so that

    Cov(S_t, S_s) = V_min(t,s) - V_t A^-1 A_s - A_t A^-1 V_s + A_t A^-1 V_T A^-1 A_s

and L is a weighted sum of chi-squares whose weights are the eigenvalues of that covariance; its tail is inverted
numerically. Where noise and regressors are stationary this is the table of Hansen (1992). Where the noise variance or
the excitation change, that table is wrong and this is not: the null follows the variance profile of the record.
Zero drift lies on the boundary of "q >= 0", which spoils likelihood-ratio tests; a score test has no such trouble.

Which parameter moves is asked of A_T^-1 S_t, the path of the estimates: a move of one parameter shows in the scores of
all whose regressors are correlated with its own, but there only in its own row.

Where scores are correlated V is the Bartlett estimate with ``lags`` lags, which are found from the record
(`driftfit.judges.bandwidth`) unless they are given; none where scores are white.

Departures: bounded scores (Huber 1964), so that outliers do not hide a drift; the null from the record (the idea of
Hansen 2000, with the distribution inverted instead of simulated). Cost: O(T n^2), and an eigenvalue problem of at most
about 700 rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.judges.bandwidth import automatic, parts
from driftfit.judges.quadratic import tail
from driftfit.kernel import Array

CLIP = 1.5
POINTS = 100
"""At most so many points of the path enter the statistic and its null."""
ROWS = 400
"""At most about so many rows of the covariance of the joint path."""
EDGE = 0.05
"""Share of a record at each end where no date is looked for."""


class Fit(NamedTuple):
    """Constant coefficients of N samples on n regressors."""

    theta: Array
    """(n,)"""
    residual: Array
    """(N,): y - phi' theta."""
    scale: float
    """Noise standard deviation, from the median of the absolute residuals."""
    psi: Array
    """(N,): residuals clipped at 1.5 scales."""
    inside: Array
    """(N,): 1 where a residual is not clipped."""


class Constancy(NamedTuple):
    """Tests of constancy; NaN where the record determines nothing."""

    L: Array
    """(n,): statistic of each parameter."""
    p: Array
    """(n,): its p-value, for the scores as Hansen has them."""
    p_own: Array
    """(n,): p-value of the path of the estimate, which tells correlated parameters apart."""
    joint: float
    """Statistic of all parameters together."""
    p_joint: float
    at: Array
    """(n,): the sample (of the N) from which on each parameter most likely is another."""
    path: Array
    """(N, n): standardised path of each estimate; about +-3 is far."""
    fit: Fit
    lags: int
    """Lags of correlation that were allowed for."""


def robust_fit(phi: Array, y: Array) -> Fit:
    """Constant coefficients with bounded influence of outliers in y; phi (N, n), y (N,)."""
    theta = np.linalg.lstsq(phi, y, rcond=None)[0]
    residual = y - phi @ theta
    for _ in range(30):
        scale = float(1.4826 * np.median(np.abs(residual)))
        if not scale > 1e-12 * np.sqrt(np.mean(y * y)):
            break
        root = np.sqrt(np.minimum(1.0, CLIP * scale / np.maximum(np.abs(residual), 1e-300)))
        theta, before = np.linalg.lstsq(phi * root[:, None], y * root, rcond=None)[0], theta
        residual = y - phi @ theta
        if np.max(np.abs(phi @ (theta - before))) < 1e-8 * scale:
            break
    scale = float(1.4826 * np.median(np.abs(residual)))
    psi = np.clip(residual, -CLIP * scale, CLIP * scale)
    return Fit(theta, residual, scale, psi, (np.abs(residual) <= CLIP * scale).astype(float))


def constancy(phi: Array, y: Array, lags: int | None = None) -> Constancy:
    """Test whether y (N,) on phi (N, n) has constant coefficients; ``lags`` as in the module."""
    N, n = phi.shape
    size: Array = np.sqrt(np.mean(phi * phi, axis=0)) if N else np.zeros(n)
    if 4 * n + 8 > N or not (size > 0.0).all() or np.linalg.matrix_rank(phi / size, 1e-9) < n:
        return _nothing(N, n)
    X = phi / size
    fit = robust_fit(X, y)
    if not fit.scale > 1e-10 * np.sqrt(np.mean(y * y)):
        return _nothing(N, n)._replace(fit=fit._replace(theta=fit.theta / size))
    lags = automatic(X, fit.psi, _piecewise(X, y)) if lags is None else lags
    scores = X * fit.psi[:, None]
    m = max(24, min(POINTS, ROWS // n, N // 2))
    ends = np.linspace(0, N, m + 1).astype(int)[1:]
    A = _profile(X * fit.inside[:, None], X, ends)
    V = _profile(*(2 * (_summed(scores, lags),)), ends)
    if np.linalg.matrix_rank(A[-1], 1e-12, hermitian=True) < n:
        return _nothing(N, n)
    S, inverse = np.cumsum(scores, axis=0), np.linalg.inv(A[-1])
    null = _null(A, V, inverse)
    own = np.einsum("ij,bjck,kl->bicl", inverse, null, inverse)
    path = S @ inverse
    var = np.einsum("ij,jk,ki->i", inverse, V[-1], inverse)
    L, p = _each(S[ends - 1], null, np.diag(V[-1]))
    _, p_own = _each(path[ends - 1], own, var)
    joint, p_joint = _joint(S[ends - 1], null, V[-1])
    spread = np.sqrt(np.maximum(np.einsum("bibi->bi", own), 0.0))
    std = np.stack([np.interp(np.arange(1, N + 1), np.append(0, ends), np.append(0.0, spread[:, i])) for i in range(n)])
    at, z = _dates(path, std.T)
    return Constancy(L, p, p_own, joint, p_joint, at, z, fit._replace(theta=fit.theta / size), lags)


def _nothing(N: int, n: int) -> Constancy:
    unknown = np.full(n, np.nan)
    fit = Fit(unknown, np.full(N, np.nan), float("nan"), np.full(N, np.nan), np.zeros(N))
    return Constancy(unknown, unknown, unknown, np.nan, np.nan, np.zeros(n, int), np.full((N, n), np.nan), fit, 0)


def _piecewise(X: Array, y: Array) -> Array:
    """Bounded residuals of coefficients that are fitted in each part of the record by itself."""
    return np.concatenate([robust_fit(X[part], y[part]).psi for part in parts(*X.shape)])


def _summed(scores: Array, lags: int) -> Array:
    """Moving sums over lags + 1 samples, scaled so that their squares are the Bartlett estimate."""
    if lags == 0:
        return scores
    total = np.cumsum(np.concatenate([np.zeros((lags + 1, scores.shape[1])), scores]), axis=0)
    summed: Array = (total[lags + 1 :] - total[: -lags - 1]) / np.sqrt(lags + 1.0)
    return summed


def _profile(left: Array, right: Array, ends: Array) -> Array:
    """sum over s < end of left_s right_s', (m, n, n)."""
    starts = np.concatenate([[0], ends[:-1]])
    blocks = [left[a:b].T @ right[a:b] for a, b in zip(starts, ends, strict=True)]
    total: Array = np.cumsum(np.array(blocks), axis=0)
    return total


def _null(A: Array, V: Array, inverse: Array) -> Array:
    """Covariance of the score path, (m, n, m, n)."""
    m = len(A)
    G = A @ inverse
    earlier = np.minimum.outer(np.arange(m), np.arange(m))
    cross = np.einsum("bij,ckj->bcik", V, G)
    both = np.einsum("bij,jk,clk->bcil", G, V[-1], G, optimize=True)
    cov = V[earlier] - cross - np.swapaxes(np.swapaxes(cross, 0, 1), 2, 3) + both
    return np.ascontiguousarray(np.swapaxes(cov, 1, 2))


def _weights(cov: Array) -> Array:
    """Weights of the chi-squares of the mean square of a path with this covariance over its m points."""
    weights: Array = np.maximum(np.linalg.eigvalsh(0.5 * (cov + cov.T)), 0.0)
    return weights


def _each(S: Array, cov: Array, var: Array) -> tuple[Array, Array]:
    """Statistic and p-value of each parameter by itself."""
    m, n = S.shape
    L = np.mean(S * S, axis=0) / var
    p = [tail(_weights(cov[:, i, :, i]) / (m * var[i]), L[i]) for i in range(n)]
    return L, np.array(p)


def _joint(S: Array, cov: Array, V: Array) -> tuple[float, float]:
    """Statistic and p-value of all parameters together."""
    m, n = S.shape
    lower = np.linalg.cholesky(V)
    root = np.linalg.inv(lower)
    L = float(np.sum((S @ root.T) ** 2) / m)
    white = np.einsum("ij,bjck,lk->bicl", root, cov, root, optimize=True).reshape(m * n, m * n)
    return L, tail(_weights(white) / m, L)


def _dates(path: Array, std: Array) -> tuple[Array, Array]:
    """Where each standardised path is furthest from zero, edges left out."""
    N = len(path)
    z = path / np.where(std > 0.0, std, np.inf)
    low, high = int(EDGE * N), max(int((1.0 - EDGE) * N), int(EDGE * N) + 1)
    return low + np.argmax(np.abs(z[low:high]), axis=0) + 1, z

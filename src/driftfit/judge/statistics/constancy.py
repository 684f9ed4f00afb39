"""Are the coefficients of a regression constant? Score tests whose null distribution comes from the record itself.

    theta    the constant that solves sum phi_t psi(e_t) = 0,  e_t = y_t - phi_t' theta
    psi(e)   = e clipped at 1.5 scales of the noise
    S_t      = sum_{s <= t} phi_s psi(e_s)                      score path, 0 at the end
    A_t      = sum_{s <= t} phi_s phi_s' psi'(e_s)              information
    V_t      = sum_{s <= t} phi_s phi_s' psi(v_s)^2             variance of the scores
    L_i      = mean_t S_ti^2 / V_Ti,    L = mean_t S_t' V_T^-1 S_t                (Nyblom 1989, Hansen 1992)

If theta is constant, S_t = F_t - A_t A_T^-1 F_T, where F has independent increments of variance dV_t, so that

    Cov(S_t, S_s) = V_min(t,s) - V_t A^-1 A_s - A_t A^-1 V_s + A_t A^-1 V_T A^-1 A_s

and L is a weighted sum of chi-squares whose weights are the eigenvalues of that covariance; its tail probability is
computed numerically. If noise and regressors are stationary, this is the table of Hansen (1992). If the noise variance
or the excitation changes, that table is wrong, but the null distribution used here follows the variance profile of the
record. Zero drift lies on the boundary of "q >= 0", which invalidates likelihood-ratio tests, but not a score test.

L averages over the record and is most powerful against slow drift. The suprema over one break and over an interval
(`driftfit.judge.statistics.supremum`) are most powerful against a sudden or temporary change. If the scores are white
and the record is long enough, a wild bootstrap joins them (`driftfit.judge.statistics.wild_bootstrap`), which finds
a break in the last few samples too. The Cauchy combination of Liu and Xie (2020) turns them into one p-value, whose
error rate is that of all together.

The noise is estimated under the alternative (`driftfit.judge.statistics.noise`): v_s are residuals of segments, which
are those of constants if the record is not divided. Residuals of constants would count a large change as noise, and the
test would lose power as the change grows. If the noise is an autoregression, the rows of the regression are whitened
first. The Bartlett estimate of V allows for the remaining correlation of the scores, with up to 4 (N / 100)^(2/9) lags,
the rule of thumb (`driftfit.judge.statistics.bandwidth`). Missing samples are passed over, which correlation at short
lags survives, unless the noise has a season, which they would blur: then rows are whitened at their own times.

To find out which parameter moves, the test uses A_T^-1 S_t, the path of the estimates. A change of one parameter
appears in the scores of all parameters whose regressors are correlated with its own, but in this path only in its own
row.

Rare events, such as counts that are mostly 0, have no level in a window and no variance in a few rows. Then V_t is V_T
in proportion to the squares of the regressors, intervals are longer, and there is no bootstrap. The size of events has
little effect on bounded scores: for counts that are nearly all 0 the test sees how often they occur.

Departures: bounded scores (Huber 1964), so that outliers do not hide a drift; the null from the record (the idea of
Hansen 2000, with the distribution inverted instead of simulated). Cost: O(T n^2), and an eigenvalue problem of at most
about 200 rows.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.statistics.bandwidth import plugged_in, rule_of_thumb
from driftfit.judge.statistics.noise import HELD, ORDER, Noise, noise, of_rare_events, whitened
from driftfit.judge.statistics.parts.coarse_readings import drawn_within
from driftfit.judge.statistics.quadratic import tail
from driftfit.judge.statistics.robust import Basis, Fit, clipped, fit_in, noisy, orthonormal, robust_fit, sole
from driftfit.judge.statistics.supremum import TIED, suprema, together
from driftfit.judge.statistics.wild_bootstrap import wild_supremum

POINTS = 48
"""Largest number of points of the path for the suprema and their null; the mean squares use every second point."""
ROWS = 200
"""The covariance of the joint path has at most about this many rows."""
CELLS = 200
"""Largest number of positions for breaks when the noise is estimated."""
MOST_LAGS = 3
"""Largest number of lags of all regressors that are added if the regressors are not independent of the noise."""
SKEWED, TIED_AT_END = 1.0, 0.25
"""Skewness of the scores, and share of readings equal to the smallest or the largest one, of rare events."""
FEW = 16.0
"""Rows in an interval of rare events, in units of their squared skewness: that of the sum is then a quarter."""
CLIPPED = 0.1
"""Smallest information in any direction, as a share of that of all residuals, that clipping may leave."""
REGULAR = 1e-14
"""The smallest eigenvalue of a correlation matrix that is regular."""
EDGE = 0.05
"""Share of a record at each end in which no date is searched."""


class Constancy(NamedTuple):
    """Tests of constancy; NaN if the record determines nothing."""

    L: Array
    """(n,): Nyblom's statistic of each parameter."""
    p: Array
    """(n,): its p-value, for the scores as in Hansen."""
    p_own: Array
    """(n,): p-value of the path of the estimate, all tests together; it distinguishes correlated parameters."""
    joint: float
    """Nyblom's statistic of all parameters together."""
    p_joint: float
    """p-value of all tests of all parameters together."""
    p_each: tuple[float, float, float, float]
    """p-values of all parameters: of the mean square, of one break, of an interval, of one break near an end (NaN for
    coloured scores, short records and rare events)."""
    at: Array
    """(n,): the sample (of the N) at which each parameter most likely changed."""
    path: Array
    """(N, n): standardised path of each estimate; values beyond about +-3 are unusual."""
    fit: Fit
    """The fit with constant coefficients."""
    noise: Noise | None
    lags: int
    """Order of the autoregression plus the further lags that were allowed for."""


def least_rows(n: int) -> int:
    """Rows that a test of n parameters needs."""
    return 4 * n + 8


def shortest(n: int) -> int:
    """Rows in the shortest segment or interval that is searched."""
    return max(10, 4 * n)


def constancy(
    phi: Array, y: Array, lags: int | None = None, at: Array | None = None, step: Array | None = None
) -> Constancy:
    """Test whether y (N,) on phi (N, n) has constant coefficients.

    ``lags``: order of the autoregression of the noise; None estimates it, and 0 assumes white scores. ``at`` (N,):
    sample numbers of the rows, where some may be missing between them. ``step`` (N,): that of a coarse sensor.
    """
    N, n = phi.shape
    if n == 0 or least_rows(n) > N:
        return _nothing(N, n)
    basis = orthonormal(phi)
    if not basis.distinct or sole(basis.Q).any():
        return _nothing(N, n)
    fit = fit_in(basis, y)
    if step is not None:
        drawn = drawn_within(basis.Q, y, step)
        if drawn is not y:
            return constancy(phi, drawn, lags, at)
    if not noisy(fit, phi, y):
        return _nothing(N, n)._replace(fit=fit)
    rare = _rare(fit.psi, y, shortest(n))
    estimated = partial(of_rare_events if rare else noise, basis.Q, fit.residual, CELLS, rare or shortest(n))
    found = estimated(None, at) if lags is None and at is not None and at[-1] - at[0] >= N else None
    if found is None or len(found.ar) <= ORDER:  # without a season, rows are those of successive samples
        found = estimated(lags)
    if step is not None and len(found.breaks):
        drawn = drawn_within(basis.Q, y, step, found.breaks)
        if drawn is not y:
            return constancy(phi, drawn, lags, at)
    return _tested(basis, phi, fit, found, lags)


def transformed(test: Constancy, phi: Array, M: Array, lags: int | None) -> Constancy:
    """The test of the coefficients of phi M, M (n, n) regular, from that of phi (N, n): fit and noise are the same."""
    basis = orthonormal(phi @ M)
    if test.noise is None or not basis.distinct:
        return _nothing(*phi.shape)
    fit = test.fit._replace(theta=np.linalg.solve(M, test.fit.theta))
    return _tested(basis, phi @ M, fit, test.noise, lags)


def _rare(psi: Array, y: Array, least: int) -> int | None:
    """Rows in the shortest interval if y (N,) counts rare events or has a bound that it often meets; otherwise None.

    The squares of such scores tell nothing about the variance of a few rows: between two events they are all small.
    The scores psi (N,) of noise that has a density have a skewness below 0.9.
    """
    z = psi - psi.mean()
    skewness = np.mean(z**3) / max(np.mean(z * z) ** 1.5, 1e-300)
    if abs(skewness) <= SKEWED and max(np.mean(y == y.min()), np.mean(y == y.max())) <= TIED_AT_END:
        return None
    return max(least, min(int(FEW * skewness**2), len(y) // 4))


def _tested(basis: Basis, phi: Array, fit: Fit, found: Noise, lags: int | None) -> Constancy:
    """The tests in the orthonormal basis: moments of regressors with a large mean would have lost their digits."""
    X, R, size = basis
    N, n = X.shape
    still, added = fit, np.zeros((N, 0))
    if len(found.ar):
        c = found.level[:, None]
        rows, y = whitened(X / c, found.held / found.level, found.ar, found.at)
        added = c * missing_lags(phi / size / c, rows, found) if lags is None else added
        X, y = rows * c, y * found.level
        still = robust_fit(np.column_stack([X, added]), y)
    psi = _alternative(found, still, added)
    rest = min(plugged_in(X, psi), rule_of_thumb(N)) if lags is None else 0
    m = max(24, min(POINTS, ROWS // n, N // 2))
    ends = np.linspace(0, N, m + 1).astype(int)[1:]
    whole = np.column_stack([X, added])
    A = _information(whole, still.inside, ends)
    V = _profile(*(2 * (_summed(whole * psi[:, None], rest),)), ends)
    if not full_rank(A[-1]) or not full_rank(V[-1]):
        return _nothing(N, n)
    if found.rare:
        V = _even(V[-1], _profile(whole, whole, ends))
    S, inverse = np.cumsum(whole * still.psi[:, None], axis=0), np.linalg.inv(A[-1])
    null = _null(A, V, inverse)
    each = np.linalg.solve(R, inverse[:n])
    own, path = _turned(null, each), S @ each.T
    var = np.diag(each @ V[-1] @ each.T)
    S, null, V = S[:, :n], np.ascontiguousarray(null[:, :n, :, :n]), V[:, :n, :n]
    least, apart = found.least, len(found.breaks) > 0
    mean = np.arange(m)[::-2][::-1]
    L, p = _each(S[ends[mean] - 1] @ R, _turned(_thinned(null, mean), R.T), np.diag(R.T @ V[-1] @ R))
    _, p_path = _each(path[ends[mean] - 1], _thinned(own, mean), var)
    alone = ((path[ends - 1, i : i + 1], own[:, i : i + 1, :, i : i + 1]) for i in range(n))
    p_own = [together(p_path[i], *suprema(*one, ends, least, apart)) for i, one in enumerate(alone)]
    joint, p_mean = _joint(S[ends[mean] - 1], _thinned(null, mean), V[-1])
    white = len(found.ar) + rest == 0 and not found.rare
    late = wild_supremum(X, still.residual, found.level) if white else np.nan
    p_each = (p_mean, *suprema(S[ends - 1], null, ends, least, apart), late)
    spread = np.sqrt(np.maximum(np.einsum("bibi->bi", own), 0.0))
    std = np.stack([np.interp(np.arange(1, N + 1), np.append(0, ends), np.append(0.0, spread[:, i])) for i in range(n)])
    at, z = _dates(path, std.T)
    return Constancy(L, p, np.array(p_own), joint, together(*p_each), p_each, at, z, fit, found, len(found.ar) + rest)


def _information(X: Array, inside: Array, ends: Array) -> Array:
    """A_t at the ends (m, k, k). If nearly all residuals of one direction of X (N, k) are clipped, as those of a rare
    pulse whose effect changes far, what is left inside says little about when its information came: then the share
    that is inside is the same for all rows.
    """
    A, B = _profile(X * inside[:, None], X, ends), X.T @ X
    if scipy.linalg.eigh(A[-1], B, eigvals_only=True, subset_by_index=[0, 0])[0] < CLIPPED * inside.mean():
        A = inside.mean() * _profile(X, X, ends)
    return A


def missing_lags(X: Array, rows: Array, found: Noise) -> Array:
    """Lags of the regressors X (N, n) that are not in ``rows``, the white rows: (N, q), Q' Q = N I.

    If the regressors contain lags of y, as in ARX, correlated noise is not independent of them, and least squares
    leaves noise that no autoregression whitens. If the noise is an autoregression of order one, the regression with one
    more lag of all variables has white noise. Further lags are added as long as they improve the criterion of Hannan
    and Quinn (1979). Their coefficients are not tested; each costs one degree of freedom.
    """
    N, n = X.shape
    least = 1e-6 * np.sqrt(N * np.mean(X * X))
    w = whitened(X[:, :0], np.clip(found.residual / found.level, -HELD, HELD), found.ar, found.at)[1]
    basis = scipy.linalg.qr(rows, mode="economic")[0]
    w = w - basis @ (basis.T @ w)
    for k in range(1, min(len(found.ar), MOST_LAGS) + 1):
        lagged = np.zeros((N, n))
        if found.at is None:
            lagged[k:] = X[:-k]
        else:
            before = np.searchsorted(found.at, found.at - k)
            known = found.at[before] == found.at - k
            lagged[known] = X[before[known]]
        lagged[: len(found.ar)] = 0.0
        lagged -= basis @ (basis.T @ lagged)
        Q, R, _ = scipy.linalg.qr(lagged, mode="economic", pivoting=True)
        new = Q[:, np.abs(np.diag(R)) > least]
        explained = new.T @ w
        gain = -N * np.log1p(-explained @ explained / (w @ w))
        if k > 1 and gain < 2.0 * new.shape[1] * np.log(np.log(N)):
            break
        basis, w = np.column_stack([basis, new]), w - new @ explained
    return np.asarray(np.sqrt(N) * basis[:, n:])


def _alternative(found: Noise, still: Fit, added: Array) -> Array:
    """Bounded residuals of the segments, on the rows of the test, without the part that the regressors ``lags``
    explain.

    Each is the residual of a fit without its row, because a short segment fits its own rows too well (MacKinnon and
    White, 1985).
    """
    if not len(found.breaks):
        return still.psi
    c = found.level
    v = found.residual
    if len(found.ar):
        held = np.clip(v / c, -HELD, HELD)
        v = c * whitened(np.zeros((len(v), 0)), held, found.ar, found.at)[1]
    v = v - added @ np.linalg.lstsq(added, v, rcond=None)[0]
    return clipped(still.theta, v / np.maximum(1.0 - found.leverage, 0.05), still.scale).psi


def _even(V: Array, B: Array) -> Array:
    """The variance V (k, k) of all scores, spread over the record as the squares of its regressors B (m, k, k) are."""
    M = np.linalg.cholesky(V) @ np.linalg.inv(np.linalg.cholesky(B[-1]))
    spread: Array = M @ B @ M.T
    return spread


def full_rank(M: Array) -> bool:
    """Whether a covariance or information M (k, k) is regular, whatever the units of its rows."""
    size = np.sqrt(np.diag(M))
    if not (size > 0.0).all():
        return False
    return bool(np.linalg.eigvalsh(M / size / size[:, None])[0] > REGULAR)


def _nothing(N: int, n: int) -> Constancy:
    unknown = np.full(n, np.nan)
    fit = Fit(unknown, np.full(N, np.nan), float("nan"), np.full(N, np.nan), np.zeros(N))
    path = np.full((N, n), np.nan)
    return Constancy(unknown, unknown, unknown, np.nan, np.nan, (np.nan,) * 4, np.zeros(n, int), path, fit, None, 0)


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
    blocks = np.add.reduceat(left[:, :, None] * right[:, None, :], starts, axis=0)
    total: Array = np.cumsum(blocks, axis=0)
    return total


def _null(A: Array, V: Array, inverse: Array) -> Array:
    """Covariance of the score path, (m, n, m, n)."""
    m, n = A.shape[:2]
    G = A @ inverse
    earlier = np.minimum.outer(np.arange(m), np.arange(m))
    tall = G.reshape(m * n, n)
    cross = (V.reshape(m * n, n) @ tall.T).reshape(m, n, m, n)
    both = (tall @ V[-1] @ tall.T).reshape(m, n, m, n)
    cov: Array = np.swapaxes(V[earlier], 1, 2) - cross - np.transpose(cross, (2, 3, 0, 1)) + both
    return np.ascontiguousarray(cov)


def _thinned(cov: Array, points: Array) -> Array:
    """Covariance of some points of a path."""
    return cov[points][:, :, points]


def _turned(cov: Array, M: Array) -> Array:
    """Covariance (m, n, m, n) of a path whose rows are multiplied by M (n, n)."""
    m, n = cov.shape[:2]
    left = (M @ cov.reshape(m, n, m * n)).reshape(-1, n)
    return (left @ M.T).reshape(m, len(M), m, len(M))


def _weights(cov: Array) -> Array:
    """Weights (.., m) of the chi-squares of the mean square of a path with covariance (.., m, m) over its m points."""
    weights: Array = np.maximum(np.linalg.eigvalsh(cov), 0.0)
    return weights


def _each(S: Array, cov: Array, var: Array) -> tuple[Array, Array]:
    """Statistic and p-value of each parameter separately."""
    m = len(S)
    L = np.mean(S * S, axis=0) / var
    weights = _weights(np.moveaxis(np.diagonal(cov, axis1=1, axis2=3), -1, 0)) / (m * var[:, None])
    return L, np.array([tail(*one) for one in zip(weights, L, strict=True)])


def _joint(S: Array, cov: Array, V: Array) -> tuple[float, float]:
    """Statistic and p-value of all parameters together."""
    m, n = S.shape
    lower = np.linalg.cholesky(V)
    root = np.linalg.inv(lower)
    L = float(np.sum((S @ root.T) ** 2) / m)
    white = _turned(cov, root).reshape(m * n, m * n)
    return L, tail(_weights(white) / m, L)


def _dates(path: Array, std: Array) -> tuple[Array, Array]:
    """The positions at which each standardised path is furthest from zero, without the edges."""
    N = len(path)
    z = path / np.where(std > np.sqrt(TIED) * std.max(axis=0), std, np.inf)
    low, high = int(EDGE * N), max(int((1.0 - EDGE) * N), int(EDGE * N) + 1)
    return low + np.argmax(np.abs(z[low:high]), axis=0) + 1, z

"""The noise of a regression whose coefficients may change: its level over time and its correlation.

    v_t = y_t - phi_t' theta_(segment of t)          residuals of coefficients that are constant within segments
    c_t                                              level of v around t: 1.4826 median |v| in windows, interpolated
    v_t / c_t = sum_k a_k v_(t-k) / c_(t-k) + w_t    an autoregression, w white

In the residuals of constants, a large change looks like noise with a changing level and with correlation. Level and
correlation are therefore estimated from segments, and the segments in turn need level and correlation:

    1. Each window of the record is fitted separately; level and partial autocorrelations are medians over windows,
       of which a few contain a break.
    2. y is limited to three levels around the fit, so that an outlier does not become a segment. Rows are divided by
       the level and whitened, y_t - sum a_k y_(t-k) on phi_t - sum a_k phi_(t-k), and
       `driftfit.judge.statistics.partition` finds the segments.
    3. Level and correlation are estimated again from their residuals; repeat from 2 until the segments do not change.

The order of the autoregression minimises BIC. If its residuals are correlated at one longer lag s (a day, a season),
the noise is (1 - a(B)) (1 - b B^s) v = w. Because s is one of many, it must gain 2 log(count) more than BIC requires. A
fit reduces the correlation of its residuals: the first autocorrelation r of N residuals is too small by (2 r + sum_i
(g_i - r)(1 + g_i r) / (1 - g_i r)) / N, where g_i are the autocorrelations of the regressors (for a mean alone (1 + 3
r) / N); this bias is corrected.

Rows are samples, of which some may be missing between them; ``at`` says which. A missing row is filled by what the
autoregression predicts from those before it, regressors and outputs alike, and the autoregression is estimated with
the filled residuals, a few times in turn. Without that, missing samples blur a season of the noise.

Source: Chakar, Lebarbier, Levy-Leduc and Robin (2017) for whitening before the segments; Box and Jenkins (1970) for the
seasonal factor; Marriott and Pope (1954) for the bias of a mean. Cost: O(T n^2), and that of the partition.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.engine.simd import WIDTH, fill, load, minus, plus, store, times
from driftfit.judge.statistics.partition import partition
from driftfit.judge.statistics.robust import cholesky, columns_of, deviation, huber, median, moments, ones

HELD = 3.0
"""y is limited to this many noise levels around the fit."""
ORDER = 8
"""Highest order of the autoregression."""
SEASON = 200
"""Longest lag of a seasonal factor; it is also at most an eighth of the record."""
LARGEST = 0.97
ALONE = 0.5
"""Leverage from which on a row is fitted mainly by itself, as a pulse that is the only one of its window or segment:
its residual is that of constants."""
ROUNDS = 6
FILLS = 5
"""Times that missing rows are filled and the autoregression is estimated again."""
QUIET = 0.01
"""Probability that a record with constant coefficients is divided."""
WINDOW = 50
SMALLEST, SMALL = 1e-5, 0.01
"""The least noise, as a share of the residuals of constants: sums of squares that are accumulated over a record have no
more digits, and breaks would divide rounding errors. That of segments is also at least a share of that of windows."""


class Noise(NamedTuple):
    """The estimated noise of N rows."""

    breaks: Array
    """(K,): first rows of the segments after the first."""
    residual: Array
    """(N,): v, without limits."""
    level: Array
    """(N,): c_t, standard deviation of v."""
    ar: Array
    """(p,): a."""
    held: Array
    """(N,): y within three levels of the fit of its segment, or of the nearest one next to a break."""
    near: Array
    """(N,): v, or next to a break that of the neighbouring segment if it is smaller."""
    leverage: Array
    """(N,): diagonal of the projector on the white rows of each segment."""
    white: float
    """Standard deviation of w, in units of the level."""
    penalty: float
    """The gain required for a break, in units of w's variance."""
    least: int
    """Rows in the shortest segment."""
    rare: bool = False
    """Whether these are rare events, whose variance a few rows do not show."""
    at: Array | None = None
    """(N,): sample numbers of the rows; None if no sample is missing between them."""


@shared
def lagged(v: Array, r: Array) -> None:
    """Add sum v_t v_(t-k) to r_k for all lags k = 0 .. P of r (P + 1,), which are vectorised."""
    N = v.shape[0]
    for t in range(N):
        for k in range(min(r.shape[0], N - t)):
            r[k] += v[t] * v[t + k]


def _windows(columns: Array, starts: Array, ends: Array, residual: Array, level: Array, r: Array) -> None:
    """Robust fits of windows: residual (N,) of the nearest centre, level (W,), sums at lags 0 .. P in r (W, P + 1)."""
    n, W = columns.shape[0] - 1, starts.shape[0]
    theta, h = np.zeros(n), np.empty((1, np.max(ends - starts) + WIDTH))
    for w in range(W):
        a, b = starts[w], ends[w]
        own = np.empty((1, b - a + WIDTH))
        level[w] = huber(columns, a, b, theta, own) * np.sqrt((b - a) / max(b - a - n, 1.0))
        first = a if w == 0 else (a + ends[w - 1]) // 2
        final = b if w == W - 1 else (starts[w + 1] + b) // 2
        lever(columns, a, b, h)
        for t in range(first, final):
            residual[t] = own[0, t - a] if h[0, t - a] < ALONE else columns[n, t]
        limit = HELD * level[w]
        for t in range(b - a):
            own[0, t] = min(max(own[0, t], -limit), limit)
        lagged(own[0, : b - a], r[w])


def _segments(Q: Array, y: Array, columns: Array, bounds: Array, order: Array, out: Array) -> None:
    """Robust fits of segments on the white rows, ``columns``, those that are mixed left out.

    ``out`` (3, N) are the residual of y on Q, that of the neighbouring segment where a break is near and it is smaller,
    and the leverage of the white rows.
    """
    residual, near, leverage = out[0], out[1], out[2]
    N, n = Q.shape
    K = bounds.shape[0] - 1
    theta, own = np.zeros((K, n)), np.empty((1, N + WIDTH))
    for k in range(K):
        a, b = bounds[k], bounds[k + 1]
        first = min(a + order[0], b - 1)
        huber(columns, first, b, theta[k], own)
        lever(columns, first, b, own)
        for t in range(a, b):
            leverage[t] = own[0, t - first] if t >= first else 0.0
    for k in range(K):
        a, b = bounds[k], bounds[k + 1]
        for t in range(a, b):
            residual[t] = y[t]
            for i in range(n):
                residual[t] -= Q[t, i] * theta[k, i]
            if leverage[t] > ALONE:
                residual[t] = y[t]
            near[t] = residual[t]
            other = k - 1 if t - a < b - t else k + 1
            if 0 <= other < K and min(t - a, b - t) < NEAR:
                e = y[t]
                for i in range(n):
                    e -= Q[t, i] * theta[other, i]
                if abs(e) < abs(near[t]):
                    near[t] = e


@partial(shared, arrays=True)
def lever(columns: Array, first: int, last: int, h: Array) -> None:
    """h_t = x_t' (X' X)^-1 x_t of the rows first .. last of `columns_of`, h (1, N + 8)."""
    n = columns.shape[0] - 1
    M, sums = np.zeros((n + 1, n + 1)), np.empty(((n + 1) * n, WIDTH))
    ones(h, last - first)
    moments(columns, first, last, h, sums, M)
    cholesky(M, n)
    for t in range(first, last, WIDTH):
        total = fill(0.0)
        for i in range(n):
            z = load(columns, i, t)
            for j in range(i):
                z = minus(z, times(fill(M[i, j]), load(sums, j, 0)))
            z = times(z, fill(1.0 / M[i, i] if M[i, i] > 0.0 else 0.0))
            store(sums, i, 0, z)
            total = plus(total, times(z, z))
        store(h, 0, t - first, total)


def _pooled(v: Array, bounds: Array, r: Array) -> None:
    """Sums at lags 0 .. P of products within segments, r (P + 1,)."""
    for k in range(bounds.shape[0] - 1):
        lagged(v[bounds[k] : bounds[k + 1]], r)


def _filled(rows: Array, at: Array, ar: Array, past: Array) -> None:
    """Rows (N, k) minus what the autoregression predicts, in place; ``past`` (span, k) is scratch, 0."""
    N, k, p = rows.shape[0], rows.shape[1], ar.shape[0]
    row = 0
    for t in range(past.shape[0]):
        present = t == at[row] - at[0]
        for j in range(k):
            predicted = 0.0
            for i in range(min(t, p)):
                predicted += ar[i] * past[t - 1 - i, j]
            past[t, j] = rows[row, j] if present else predicted
            if present:
                rows[row, j] = rows[row, j] - predicted if t >= p else 0.0
        row = min(row + 1, N - 1) if present else row


NEAR = 20
_fit_windows = Driver(_windows)
_fit_segments = Driver(_segments)
_lags = Driver(_pooled)
_whiten_with_gaps = Driver(_filled)


def noise(Q: Array, y: Array, cells: int, least: int, order: int | None = None, at: Array | None = None) -> Noise:
    """The noise of y (N,) on Q (N, n), Q' Q = N I.

    ``cells``: largest number of positions for breaks, evenly spaced; ``least``: rows in a segment; ``order`` of the
    autoregression, None estimates it; ``at`` (N,): sample numbers of the rows, if some are missing between them.
    """
    return begun(Q, y, cells, least, order, at=at)[1]


def begun(
    Q: Array,
    y: Array,
    cells: int,
    least: int,
    order: int | None = None,
    quiet: float = QUIET,
    at: Array | None = None,
) -> tuple[Search, Noise, tuple[Array, Array]]:
    """The search of `noise`, its result, and the autoregressions that it began with: of windows, of the whole.

    ``quiet``: probability that constants are divided.
    """
    N, n = Q.shape
    spans = _spans(N, n)
    P = max(order or 0, min(ORDER, N // 20, (spans[1][0] - spans[0][0]) // 6))
    residual, level, r = np.empty(N), np.empty(len(spans[0])), np.zeros((len(spans[0]), P + 1))
    _fit_windows(columns_of(Q, y), *spans, residual, level, r)
    g = overlap(Q)
    width = int(spans[1][0] - spans[0][0])
    least_level = SMALLEST * deviation(y)
    c = np.maximum(_level(spans, level, N), least_level)
    search = Search(Q, y, c, spans, g, P, order, _grid(N, cells), least,
                    penalty(N, n, least, quiet), max(SMALL, least_level / median(c)), at)  # fmt: skip
    r = r[r[:, 0] > 0.0]
    pacf = np.median(_partial(r, g, width), axis=0) if len(r) else np.zeros(P)
    local = _chosen(pacf, min(N, 8 * width), order)
    whole = search.correlation(y, np.zeros(0, np.int64))
    found = search.settle(local, residual, residual)
    if len(whole) or len(local):
        found = min(found, search.settle(whole, residual, y), key=lambda one: one[0])
    return search, found[1], (local, whole)


def of_rare_events(
    Q: Array, y: Array, cells: int, least: int, order: int | None = None, at: Array | None = None
) -> Noise:
    """`noise` of one level, where windows show none, because they hold too few events.

    Sums of rare events are skewed, so a break must gain twice as much as in Gaussian noise.
    """
    (N, n), none = Q.shape, np.zeros(0, np.int64)
    P = max(order or 0, min(ORDER, N // 20))
    search = Search(Q, y, np.full(N, deviation(y)), _spans(N, n), overlap(Q), P, order, _grid(N, cells), least,
                    2.0 * penalty(N, n, least, QUIET), SMALL, at)  # fmt: skip
    starts = [search.correlation(y, none), none[:0].astype(float)]
    return min((search.settle(ar, y, y) for ar in starts), key=lambda one: one[0])[1]._replace(rare=True)


def _grid(N: int, cells: int) -> Array:
    """At most so many positions for breaks, evenly spaced."""
    return np.unique(np.linspace(0, N, min(cells, N) + 1).astype(np.int64))[1:]


def overlap(Q: Array) -> Array:
    """First autocorrelations (n,) of regressors Q (N, n), Q' Q = N I, in the directions that diagonalise them."""
    return np.linalg.eigvalsh(0.5 * (Q[1:].T @ Q[:-1] + Q[:-1].T @ Q[1:]) / len(Q))


class Search(NamedTuple):
    """The data of a search for segments; y is the residual of constants."""

    Q: Array
    y: Array
    c: Array
    spans: tuple[Array, Array]
    g: Array
    P: int
    order: int | None
    grid: Array
    least: int
    penalty: float
    finest: float
    """The least noise of segments, in units of c."""
    at: Array | None
    """Sample numbers of the rows, if some are missing between them."""

    def settle(self, ar: Array, local: Array, near: Array) -> tuple[float, Noise]:
        """-2 log-likelihood, and segments and noise that agree, starting from ``ar``, the autoregression of ``near``.

        ``local``: residuals of windows, for outliers.
        """
        Q, y, c = self.Q, self.y, self.c
        N, breaks = len(y), np.zeros(0, np.int64)
        held = y - local + np.clip(local, -HELD * c, HELD * c)
        for _ in range(ROUNDS):
            before = breaks
            X, z = whitened(Q / self.c[:, None], held / self.c, ar, self.at)
            size = self.size(near, ar)
            breaks = partition(X / size, z / size, self.grid, self.price(ar), self.least, len(ar))
            found = self.described(breaks, X, ar)
            near, ar, held = found.near, found.ar, found.held
            if np.array_equal(before, breaks):
                break
        cost = 2.0 * N * np.log(self.size(near, ar)) + len(breaks) * self.price(ar) + len(ar) * np.log(N)
        return float(cost), found

    def described(self, breaks: Array, X: Array, ar: Array) -> Noise:
        """The noise given its breaks; segments are fitted on X, the regressors divided by c and whitened by ``ar``."""
        Q, y, N = self.Q, self.y, len(self.y)
        z = whitened(X[:, :0], y / self.c, ar, self.at)[1]
        fits = np.empty((3, N))
        _fit_segments(Q, y, columns_of(X, z), np.concatenate([[0], breaks, [N]]), np.array([len(ar)]), fits)
        residual, near, leverage = fits
        ar = self.correlation(near, breaks)
        c = self.c * max(deviation(near / self.c), self.finest)
        held = y - near + np.clip(near, -HELD * c, HELD * c)
        white = self.size(near, ar) * median(self.c / c)
        return Noise(breaks, residual, c, ar, held, near, leverage, white, self.price(ar), self.least, at=self.at)

    def price(self, ar: Array) -> float:
        """The penalty, raised by the standard error of the logarithm of the noise's long-run variance."""
        total = max(float(ar.sum()), 0.0)
        return self.penalty * (1.0 + (2.0 * np.sqrt((1.0 + total) / (1.0 - total) / len(self.y)) if len(ar) else 0.0))

    def correlation(self, v: Array, breaks: Array) -> Array:
        """The autoregression of v within segments."""
        N, v = len(v), v / self.c
        limit = HELD * deviation(v)
        held, ar = np.clip(v, -limit, limit), np.zeros(0)
        for _ in range(1 if self.at is None else FILLS):
            every, bounds, r = *self.without_gaps(held, breaks, ar), np.zeros(self.P + 1)
            _lags(every, bounds, r)
            if not r[0] > 0.0:
                return r[:0]
            ar = _chosen(_partial(r[None], self.g, N / (len(breaks) + 1.0))[0], N, self.order)
        return ar if self.order is not None else self.seasonal(v, ar, breaks)

    def seasonal(self, v: Array, ar: Array, breaks: Array) -> Array:
        """The autoregression, with one more factor if its residuals of v are correlated at a longer lag."""
        N = len(v)
        longest = min(SEASON, N // 8)
        if longest <= self.P:
            return ar
        w = whitened(np.zeros((N, 0)), v, ar, self.at)[1]
        limit, r = HELD * deviation(w), np.zeros(longest + 1)
        _lags(*self.without_gaps(np.clip(w, -limit, limit), breaks, ar[:0]), r)
        share = self.share(longest)[self.P + 1 :]
        later = r[self.P + 1 :] / r[0] / share if r[0] > 0.0 else np.zeros(longest - self.P)
        best = int(np.argmax(later * later * share))
        b = float(np.clip(later[best], -LARGEST, LARGEST))
        if N * share[best] * np.log1p(-b * b) + np.log(N) + 2.0 * np.log(longest) > 0.0:
            return ar
        season = np.zeros(self.P + best + 2)
        season[0], season[-1] = 1.0, -b
        return -np.convolve(np.append(1.0, -ar), season)[1:]

    def without_gaps(self, v: Array, breaks: Array, ar: Array) -> tuple[Array, Array]:
        """v with missing samples as the autoregression predicts them, and the bounds of the segments in it."""
        if self.at is None:
            return v, np.concatenate([[0], breaks, [len(v)]])
        place = self.at - self.at[0]
        every = np.zeros((int(place[-1]) + 1, 1))
        _whiten_with_gaps(v[:, None].copy(), self.at, ar, every)
        return every[:, 0].copy(), np.concatenate([[0], place[breaks], [len(every)]])

    def share(self, longest: int) -> Array:
        """Pairs of rows that are 0 .. longest samples apart, as shares of those of as many rows without gaps."""
        if self.at is None:
            return np.ones(longest + 1)
        N, pairs = len(self.at), np.zeros(longest + 1)
        every, bounds = self.without_gaps(np.ones(N), np.zeros(0, np.int64), np.zeros(0))
        _lags(every, bounds, pairs)
        return np.maximum(pairs, 1.0) / (N * (1.0 - np.arange(longest + 1) / len(every)))

    def size(self, v: Array, ar: Array) -> float:
        """Standard deviation of the white noise, with outliers limited."""
        w = whitened(np.zeros((len(v), 0)), v / self.c, ar, self.at)[1]
        limit = HELD * deviation(w)
        held = np.clip(w, -limit, limit)
        return max(float(np.sqrt(held @ held / len(held))), self.finest) if limit > 0.0 else 1.0


def whitened(X: Array, y: Array, ar: Array, at: Array | None = None) -> tuple[Array, Array]:
    """Rows minus a times the rows before; the first p rows are left out.

    ``at`` (N,): sample numbers, if some are missing between the rows; those are filled as the autoregression predicts
    them. After a gap a row has more noise than others.
    """
    p = len(ar)
    if p == 0:
        return X, y
    if at is not None:
        both = np.column_stack([X, y])
        _whiten_with_gaps(both, at, ar, np.zeros((int(at[-1] - at[0]) + 1, both.shape[1])))
        return np.ascontiguousarray(both[:, :-1]), both[:, -1].copy()
    rows, values = X.copy(), y.copy()
    for k, a in enumerate(ar, 1):
        rows[k:] -= a * X[:-k]
        values[k:] -= a * y[:-k]
    rows[:p], values[:p] = 0.0, 0.0
    return rows, values


@lru_cache(4096)
def penalty(N: int, n: int, least: int, quiet: float) -> float:
    """Smallest decrease of the sum of squares that justifies a break.

    In white Gaussian noise the probability of one false break, and half of that of a pair, are about ``quiet``. This
    follows from the supremum of a chi-square process with n degrees of freedom over its places (Siegmund, 1985).
    """
    span = np.log(max(N / least - 1.0, np.e))
    one = _exceeded(lambda c: scipy.special.gammaincc(0.5 * n, 0.5 * c) * c * span - quiet)
    pair = _exceeded(lambda c: scipy.special.gammaincc(0.5 * n, 0.5 * c) * max(c * c / least, 1.0) * N - 0.5 * quiet)
    return max(one, 0.5 * pair)


def _exceeded(excess: Any) -> float:
    from scipy import optimize  # with ndimage a quarter of the time of importing the package

    return float(optimize.brentq(excess, 4.0, 1000.0))


def _spans(N: int, n: int) -> tuple[Array, Array]:
    """Starts and ends of windows that overlap by half."""
    width = min(N, max(4 * n + 12, min(max(WINDOW, 10 * n), N // 6), N // 16))
    count = max(1, 2 * (N // width) - 1)
    starts = np.linspace(0, N - width, count).astype(np.int64)
    return starts, starts + width


def _level(spans: tuple[Array, Array], level: Array, N: int) -> Array:
    """c (N,) from the levels of windows (W,): medians of five, at least a twentieth of the median of all."""
    from scipy import ndimage

    smooth = ndimage.median_filter(level, 5, mode="nearest") if len(level) > 2 else level
    positive = smooth[smooth > 0.0]
    floor = 0.05 * median(positive) if len(positive) else 1.0
    return np.interp(np.arange(N), 0.5 * (spans[0] + spans[1]), np.maximum(smooth, floor))


def _partial(r: Array, g: Array, N: float) -> Array:
    """Partial autocorrelations (W, P) from sums at lags 0 .. P, r (W, P + 1), of residuals of fits on N rows."""
    found = np.empty((len(r), r.shape[1] - 1))
    _recursion(np.ascontiguousarray(r), np.ascontiguousarray(g), float(N), found)
    return found


def _levinson(r: Array, g: Array, N: float, found: Array) -> None:
    """The recursion of Durbin and Levinson, with the bias of the first autocorrelation corrected."""
    W, P = found.shape
    a, turned = np.zeros(P), np.zeros(P)
    for w in range(W):
        left = 1.0
        for k in range(P):
            last = r[w, k + 1] / r[w, 0]
            for j in range(k):
                last -= a[j] * r[w, k - j] / r[w, 0]
            last = min(max(last / max(left, 1e-9), -LARGEST), LARGEST)
            found[w, k] = last
            for j in range(k):
                turned[j] = a[j] - last * a[k - 1 - j]
            for j in range(k):
                a[j] = turned[j]
            a[k] = last
            left *= 1.0 - last * last
        if P > 0:
            first = rho = found[w, 0]
            for _ in range(10):
                lost = 2.0 * rho
                for i in range(g.shape[0]):
                    lost += (g[i] - rho) * (1.0 + g[i] * rho) / (1.0 - g[i] * rho)
                rho = min(max(first + lost / N, -LARGEST), LARGEST)
            found[w, 0] = rho


_recursion = Driver(_levinson)


def _chosen(pacf: Array, N: int, order: int | None) -> Array:
    """Coefficients of the autoregression of least BIC, or of the order given."""
    if order is None:
        bic = np.cumsum(N * np.log1p(-pacf * pacf) + np.log(N))
        order = int(np.argmin(np.concatenate([[0.0], bic])))
    a = np.zeros(0)
    for last in pacf[:order]:
        a = np.append(a - last * a[::-1], last)
    return a

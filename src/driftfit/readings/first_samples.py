"""Fault codes among the first samples, before there is anything with which they could be compared.

The signals of the first samples are kept, and judged together when there are ``first`` + n of them. Samples that repeat
the one before are kept once, with their number. While the record begins with so many equal readings that they and the
samples of which they are lags are half of all, the oldest makes room for the newest, and ``gate_decided`` counts down:
a plant at rest, and a run of codes at the start, are judged when something happens. A value is outlying if it is
`OUTLYING` usual distances from the median, the usual distance being the median of those that are not 0. A sample is
doubtful if

    its reading is outlying and no regressor is: probably a fault code;
    or a regressor is outlying and the reading is not: a code of an input, or of an earlier output, now a lag.

A large output after a large input is neither; a lag with the same fault code as the reading does not explain it, and
where the model is ``implicit``, its regressors contain functions of the reading, and none of them does.
Doubtful samples are left out if the others contradict them: if least squares on all leaves a sum of squares Q, and
least squares on the others only q with nu residuals, and with k doubtful samples

    nu (Q - q) > WORSE k q

or if the first sample that can be used does not respond to an outlying reading before it, which none predicts.
Then the signals that made samples doubtful are marked, ``gate_replay`` is set, and the driver restores
the state before the first sample and replays whole samples without the codes, once. Several outputs are kept together,
each is judged by its own regression, and the samples are replayed without the codes of all.

Source: the test is Chow's (1960), the median deviation as a scale Hampel's (1974), the recursive QR decomposition
Gentleman's (1974); what is doubtful is ours. Cost: a copy of the sample, and O(N^2 (n + m) + N n^2) once.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel

OUTLYING = 10.0
"""Usual distances from the median from which on a value is outlying."""
WORSE = 16.0
"""F statistic from which samples contradict each other: four standard deviations for one sample."""
RESIDUALS = 6
"""Fewest residuals of the samples that are not doubtful."""
FEW = 3
"""Values that differ from the median, from which on their distance is usual."""
ROUNDED = 1e-20
"""Share of the sum of squares of y that may be an error of rounding."""
TIMES, READING, DT, NOISE, DRIFT, U = range(6)
CODES = -1
"""Columns of a kept sample: how often it came, its reading (NaN if missing), intervals since the last sample, factors
of noise and drift, the inputs, the regressor (NaN if it is incomplete), and what a linearised model subtracts from y.
When it is decided, which signals are codes takes the last place."""


def no_samples(first: int, n: int, m: int, shifts: bool) -> Mapping[str, Any]:
    """Fields before the first sample; with ``shifts`` the model subtracts something from y."""
    N = first + n if first > 0 else 1
    return {
        "gate_first": np.full((N + 1, U + max(m, 1) + n + shifts), np.nan), "gate_kept": 0,
        "gate_decided": 0 if first > 0 else 1, "gate_replay": 0, "gate_fit": np.zeros((n + 1, n + 1)),
        "gate_doubt": np.zeros(N), "raw_y": np.nan,
    }  # fmt: skip


@kernel
def bring(s: State, l: int, g: State, k: int) -> None:
    """The present sample, as it was measured, takes the place behind those that are kept."""
    N, U_END = g.gate_first.shape[0] - 1, U + s.u.shape[0]
    g.gate_first[N, TIMES, k], g.gate_first[N, READING, k] = 1.0, s.raw_y[l] if s.observed[l] > 0.0 else np.nan
    g.gate_first[N, DT, k], g.gate_first[N, NOISE, k], g.gate_first[N, DRIFT, k] = s.dt[l], s.noise[l], s.drift[l]
    g.gate_first[N, g.gate_first.shape[1] - 1, k] = s.shift[l]  # if the model has one, a place of its own
    for j in range(s.u.shape[0]):
        g.gate_first[N, U + j, k] = s.u[j, l]
    for i in range(s.phi.shape[0]):
        g.gate_first[N, U_END + i, k] = s.phi[i, l] if s.valid[l] > 0.0 else np.nan


@kernel
def entry(g: State, k: int, column: int, center: float, apart: bool, l: int) -> float:
    """The entry of sample k in a column; with ``apart`` its distance from center, NaN if that is 0."""
    x = g.gate_first[k, column, l]
    away = abs(x - center)
    return (away if away > 0.0 else np.nan) if apart else x


@partial(kernel, short=True)
def usual_value(g: State, column: int, center: float, apart: bool, l: int) -> float:
    """The lower median of the entries of a column; of fewer than `FEW` distances 0."""
    N, count = g.gate_doubt.shape[0], 0
    for k in range(N):
        x = entry(g, k, column, center, apart, l)
        count += 1 if x == x else 0
    for k in range(0 if apart & (count < FEW) else N):
        value, less, same = entry(g, k, column, center, apart, l), 0, 0
        for other in range(N):
            x = entry(g, other, column, center, apart, l)
            less += 1 if x < value else 0
            same += 1 if x == value else 0
        if (less <= (count - 1) // 2) & ((count - 1) // 2 < less + same):
            return value  # type: ignore[no-any-return]
    return 0.0 if apart else np.nan


@partial(kernel, short=True)
def judge_each(g: State, implicit: bool, l: int) -> None:
    """Write for each sample 1 if its reading is outlying, 2 if a regressor is, else 0."""
    N, n, PHI = g.gate_doubt.shape[0], g.gate_fit.shape[0] - 1, U + g.gate_low.shape[0]
    for i in range(-1, n):
        column = PHI + i if i >= 0 else READING
        center = usual_value(g, column, 0.0, False, l)
        most = OUTLYING * usual_value(g, column, center, True, l)
        for k in range(N):
            x, d = g.gate_first[k, column, l], g.gate_doubt[k, l] if i >= 0 else 0.0
            same = (implicit | (abs(x) == abs(g.gate_first[k, READING, l]))) & (d == 1.0)
            outlying = (abs(x - center) > most) & (d < 2.0) & (not same)
            g.gate_doubt[k, l] = d + (0.0 if not outlying else 1.0 if i < 0 else 2.0)
    for k in range(N):
        g.gate_doubt[k, l] = g.gate_doubt[k, l] if g.gate_doubt[k, l] < 3.0 else 0.0


@kernel
def regressed(g: State, k: int, l: int) -> float:
    """The output of the regression at sample k; NaN if it cannot be used."""
    PHI, last = U + g.gate_low.shape[0], g.gate_first.shape[1] - 1
    y = g.gate_first[k, READING, l] - (g.gate_first[k, last, l] if last == PHI + g.gate_fit.shape[0] - 1 else 0.0)
    complete = g.gate_first[k, PHI, l] == g.gate_first[k, PHI, l]
    return y if complete & (g.gate_first[k, NOISE, l] < np.inf) else np.nan


@kernel
def rotate_in(g: State, k: int, y: float, l: int) -> float:
    """Givens rotations of one row into the triangle ``gate_fit``, [phi' y]; returns the square that it adds."""
    n, PHI = g.gate_fit.shape[0] - 1, U + g.gate_low.shape[0]
    for i in range(n):
        g.gate_fit[n, i, l] = g.gate_first[k, PHI + i, l]
    g.gate_fit[n, n, l] = y
    for i in range(n):
        a, b = g.gate_fit[i, i, l], g.gate_fit[n, i, l]
        larger = max(abs(a), abs(b))
        if larger > 0.0:
            r = larger * np.sqrt((a / larger) ** 2 + (b / larger) ** 2)
            for j in range(i, n + 1):
                up, down = g.gate_fit[i, j, l], g.gate_fit[n, j, l]
                g.gate_fit[i, j, l] = (a * up + b * down) / r
                g.gate_fit[n, j, l] = (a * down - b * up) / r
    return g.gate_fit[n, n, l] ** 2  # type: ignore[no-any-return]


@partial(kernel, short=True)
def contradicted(g: State, l: int) -> bool:
    """Whether the samples that are not doubtful, which come first into the triangle, contradict those that are."""
    for i in range(g.gate_fit.shape[0]):
        for j in range(g.gate_fit.shape[0]):
            g.gate_fit[i, j, l] = 0.0
    spare, some, alone, more, total = 1 - g.gate_fit.shape[0], 0, 0.0, 0.0, 0.0
    first, unexplained = -1.0, False  # doubt of the first sample that can be used
    for turn in range(2):
        for k in range(g.gate_doubt.shape[0]):
            sure, y, doubt = turn == 0, regressed(g, k, l), g.gate_doubt[k, l]
            first = doubt if (y == y) & (first < 0.0) else first
            unexplained |= (first < 0.0) & (doubt == 1.0)
            if (y == y) & (sure == (doubt == 0.0)):
                square = rotate_in(g, k, y, l)
                spare, some = spare + (1 if sure else 0), some + (0 if sure else 1)
                alone, more = alone + (square if sure else 0.0), more + (0.0 if sure else square)
                total += y**2 if sure else 0.0
    unexplained &= first == 2.0
    return (spare >= RESIDUALS) & (unexplained | (more * spare > WORSE * some * (alone + ROUNDED * total)))  # type: ignore[no-any-return]


@partial(kernel, short=True)
def mark(g: State, ages: int, l: int) -> bool:
    """The signals that made samples doubtful, as bits in the last column: 1 for the output, 2, 4, .. for inputs; none
    if the others do not contradict them."""
    N, last, bit, found = g.gate_doubt.shape[0], g.gate_first.shape[1] - 1, 2.0, contradicted(g, l)
    for k in range(N):
        g.gate_first[k, last, l] = 1.0 if found & (g.gate_doubt[k, l] == 1.0) else 0.0
    for j in range(g.gate_low.shape[0]):
        center = usual_value(g, U + j, 0.0, False, l)
        most = OUTLYING * usual_value(g, U + j, center, True, l)
        for k in range(N):
            hit = 0.0
            for later in range(k, min(k + ages + 1, N)):
                hit = bit if found & (g.gate_doubt[later, l] == 2.0) else hit
            outside = abs(g.gate_first[k, U + j, l] - center) > most
            g.gate_first[k, last, l] += hit if outside else 0.0
        bit *= 2.0
    return found  # type: ignore[no-any-return]


@kernel
def enough(g: State, l: int) -> bool:
    """Whether the output moved: its readings do not begin with so many equal ones that they are half of all."""
    N, first, equal = g.gate_doubt.shape[0], g.gate_first[0, READING, l], 1
    while (equal < N) and (g.gate_first[equal, READING, l] == first):
        equal += 1
    return (first == first) & ((equal == 1) | (2 * (equal + g.gate_fit.shape[0] - 1) < N))  # type: ignore[no-any-return]


@partial(kernel, short=True)
def decide(s: State, g: State, ages: int, implicit: bool) -> None:
    """Where samples made room for others they were judged one by one, unless they are the codes themselves."""
    dropped, whole, found = -s.gate_decided[0], True, False
    for l in range(g.gate_kept.shape[0]):
        judge_each(g, implicit, l)
        whole &= (dropped == 0) | (g.gate_doubt[0, l] == 1.0)
        found |= mark(g, ages, l)
    for l in range(s.gate_decided.shape[0]):
        s.gate_decided[l], s.gate_replay[l] = 1, 1 + dropped if found & whole else 0


@partial(kernel, short=True)
def remember(s: State, g: State, ages: int, implicit: bool) -> None:
    """Keep the sample that was brought, of all outputs, and decide once one of them moved; inputs stay for ``ages``
    samples."""
    N, (_, width, L) = g.gate_doubt.shape[0], g.gate_first.shape
    last, again, known, moved = max(g.gate_kept[0] - 1, 0), g.gate_kept[0] > 0, False, False
    for l in range(L):
        known |= g.gate_first[0, READING, l] == g.gate_first[0, READING, l]
        for column in range(READING, width):
            again &= g.gate_first[N, column, l] == g.gate_first[last, column, l]
    full = (g.gate_kept[0] == N) & (not again)
    last = last if again | full else g.gate_kept[0]
    for l in range(s.gate_decided.shape[0]):
        s.gate_decided[l] -= int(g.gate_first[0, TIMES, 0]) if full & known else 0
    for l in range(L):
        g.gate_kept[l] = last + 1
        g.gate_first[N, TIMES, l] += g.gate_first[last, TIMES, l] if again else 0.0
        for k in range(1 if full else N, N + 1):  # the oldest makes room
            for column in range(width):
                g.gate_first[k - 1 if full else last, column, l] = g.gate_first[k, column, l]
        moved |= (last + 1 == N) & enough(g, l)
    if moved:
        decide(s, g, ages, implicit)

"""Structure: which inputs matter, with which delays and lags, and how many lags of the output.

    y_t = sum_(i <= na) a_i y_(t-i) + sum_j sum_(k < nb_j) b_jk u_j,(t - nk_j - k) + c + v_t

The search climbs from several starts: it adds an input at its best delay, exchanges one for another, leaves one out,
and lengthens, shortens and shifts its lags, as long as the score less a price rises (`driftfit.identify.scores`). Each
input costs log p nats, where p is the number of columns among which it was chosen, and each column `COLUMN`. Of the
structures on the way the simplest within one standard error of the best is taken. An input must then beat copies of
itself that are displaced in time or reversed, each at its best delay, because a slow input resembles any slow drift.
Then the inputs that were left out are searched again by their squares about the median: one with the same effect on
both sides has no straight line.

What is predicted is the present output: with nk = 0 an input explains it, but does not forecast it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import monotonic

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.identify.roles import NoAnswerError
from driftfit.identify.scores import FEWEST, Scores, lead
from driftfit.use.simulate import moved

COLUMN = 1.5
"""Price of a column in nats, about half the logarithm of the rows that a coefficient needs."""
TIED = 2.0
"""Nats within which delays and inputs are said to be as good."""
COPIES = 19
COLUMNS = 250
"""Columns that the search holds in memory: 80 blocks and four memories of them take a fifth of a gigabyte."""
FILLED = 3
"""Missing readings in a row of a regressor that the search replaces by the last one."""

Shape = tuple[int, tuple[tuple[int, int, int], ...]]
"""na, and (input, nb, nk) of every input, sorted."""


@dataclass(frozen=True)
class Structure:
    """What was chosen: ``na``, and (nb, nk) of each input by its place.

    ``delays``: the least and the largest nk that are as good. ``second``: other structures, by how many nats they are
    behind, and the standard error of that. ``doubtful``: inputs that are no better than displaced copies. ``instead``:
    pairs of an input and one that could replace it. ``log``: by how many nats the same of the logarithm of a positive
    output leads, on the scale of the output. ``forecast``: the same with nk of at least 1, if it is another.
    ``narrowed``: where the search was cut short.
    """

    na: int
    lags: Mapping[int, tuple[int, int]]
    delays: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    second: tuple[tuple[Shape, float, float], ...] = ()
    doubtful: tuple[int, ...] = ()
    instead: tuple[tuple[int, int], ...] = ()
    log: tuple[float, float] = (0.0, 0.0)
    forecast: Structure | None = None
    narrowed: str = ""

    @property
    def shape(self) -> Shape:
        return self.na, tuple((j, nb, nk) for j, (nb, nk) in sorted(self.lags.items()))


def filled(x: Array) -> Array:
    """A signal (T,) whose last reading replaces up to `FILLED` missing ones, not across gaps in time, which are inf."""
    t, known = np.arange(len(x)), ~np.isnan(x)
    last = np.maximum.accumulate(np.where(known, t, 0))
    return np.where((t - last <= FILLED) & np.isfinite(x[last]), x[last], np.nan)


class Pool:
    """All columns of a record on a regular grid: 1, na lags of y (T,), lags first..M of every column of U (T, m)."""

    def __init__(self, y: Array, U: Array, M: int, first: int = 0, na: int = 8, more: Array | None = None):
        past, U = filled(y), np.column_stack([filled(u) for u in U.T]) if U.shape[1] else U
        self.m, self.M, self.na = U.shape[1], M, na
        self.place: dict[tuple[int, int], int] = {}
        columns = [np.ones(len(y))]
        for j, x in [(-1, past), *enumerate(U.T)]:
            for k in range(1, na + 1) if j < 0 else range(first, M + 1):
                self.place[j, k] = len(columns)
                columns.append(moved(x, k))
        X = np.column_stack([*columns, *([] if more is None else [more])])
        self.rows = np.flatnonzero(np.isfinite(X).all(axis=1) & np.isfinite(y))
        if len(self.rows) < FEWEST:
            raise NoAnswerError(f"{len(self.rows)} rows of {len(y)} have all lags; at least {FEWEST} are needed.")
        self.scores = Scores(X[self.rows], y[self.rows])
        self.shapes: dict[Shape, float] = {}

    def columns(self, shape: Shape) -> list[int]:
        na, inputs = shape
        each = [self.place[-1, k] for k in range(1, na + 1)]
        return [0, *each, *(self.place[j, k] for j, nb, nk in inputs for k in range(nk, nk + nb))]

    def fits(self, shape: Shape) -> bool:
        inside = (nb >= 1 and (j, nk) in self.place and nk + nb - 1 <= self.M for j, nb, nk in shape[1])
        return 0 <= shape[0] <= self.na and all(inside)

    def value(self, shape: Shape) -> float:
        """The score less the price."""
        if shape not in self.shapes:
            columns = self.columns(shape)
            price = COLUMN * len(columns) + np.log(self.scores.p) * len(shape[1])
            self.shapes[shape] = self.scores.score(columns) - price
        return self.shapes[shape]

    def best_delays(self, shape: Shape) -> dict[int, tuple[float, int]]:
        """(score, delay) of every input that the structure lacks, added at its best delay."""
        added, used = self.scores.added(self.columns(shape)), {j for j, *_ in shape[1]}
        best: dict[int, tuple[float, int]] = {}
        for (j, k), column in self.place.items():
            if j >= 0 and j not in used:
                best[j] = max(best.get(j, (-np.inf, 0)), (float(added[column]), k))
        return best

    def near(self, shape: Shape) -> list[Shape]:
        """The structures one step away."""
        na, inputs = shape
        found: list[Shape] = [(na - 1, inputs), (na + 1, inputs)]
        found += [(na, (*inputs, (j, 1, k))) for j, (_, k) in self.best_delays(shape).items()]
        for one in inputs:
            j, nb, nk = one
            rest = tuple(other for other in inputs if other != one)
            moves = [(nb - 1, nk), (nb - 1, nk + 1), (nb + 1, nk), (nb + 1, nk - 1), (1, nk), (1, nk + nb - 1)]
            moves += [(nb, nk + d) for d in (-3, -2, -1, 1, 2, 3)]
            found += [(na, rest), *((na, (*rest, (j, *move))) for move in moves)]
            found += [(na, (*rest, (i, 1, k))) for i, (_, k) in self.best_delays((na, rest)).items()]
        return [(na, tuple(sorted(inputs))) for na, inputs in found if self.fits((na, inputs))]

    def climb(self, shape: Shape, end: float) -> Shape:
        """The structure from which no step rises; ``end``: the time (`time.monotonic`) at which it stops."""
        while monotonic() < end and self.value(top := max(self.near(shape), key=self.value)) > self.value(shape):
            shape = top
        return shape

    def simplest(self, shape: Shape) -> Shape:
        """The simplest within one standard error: lags are left out as long as the loss is no larger than that."""
        best = self.scores.terms(self.columns(shape))
        while True:
            size = len(self.columns(shape))
            simpler = [one for one in self.near(shape) if len(self.columns(one)) < size]
            top = max(simpler, key=self.value, default=shape)
            loss, error = lead(best, self.scores.terms(self.columns(top)))
            if top == shape or loss > min(error, TIED):
                return shape
            shape = top


def without(shape: Shape, left: tuple[int, ...]) -> Shape:
    """A structure without some inputs."""
    return shape[0], tuple(one for one in shape[1] if one[0] not in left)


def search(y: Array, U: Array, M: int, first: int, end: float, rng: np.random.Generator) -> Structure:
    """The structure of a record on a regular grid; ``end``: the time (`time.monotonic`) at which the search stops."""
    M, narrowed = _affordable(y, U, M)
    pool = Pool(y, U, M, first)
    starts: list[Shape] = [(2, ()), (0, ())]
    for _ in range(3):  # the floor is that of the best structure
        pool.scores.refer(pool.columns(starts[0]))
        pool.shapes.clear()
        starts = [max((pool.climb(one, end) for one in starts), key=pool.value)]
    shape = pool.simplest(starts[0])
    doubtful = tuple(j for j, _, _ in shape[1] if monotonic() < end and not _beats_copies(y, U, shape, j, rng))
    if doubtful:  # the others may need other lags without them
        shape = without(pool.climb(without(shape, doubtful), end), doubtful)
    used = [j for j, _, _ in shape[1]]
    squares = (U - np.nanmedian(np.where(np.isfinite(U), U, np.nan), axis=0)) ** 2
    squares[:, used] = U[:, used]
    even = Pool(y, squares, M, first)
    even.scores.refer(even.columns(shape))
    other = even.simplest(even.climb(without(shape, doubtful), end))
    found = [j for j, _, _ in other[1] if j not in used]
    if found and all(_beats_copies(y, squares, other, j, rng) for j in found):
        pool, shape, U = even, other, squares
    narrowed = "; ".join(filter(None, (narrowed, "the budget of time ended the search" if monotonic() > end else "")))
    return _told(pool, shape, doubtful, _of_log(pool, shape, y, U, first), narrowed)


def _told(pool: Pool, shape: Shape, doubtful: tuple[int, ...], log: tuple[float, float], narrowed: str) -> Structure:
    """A structure with its rivals."""
    own, (na, inputs) = pool.scores.terms(pool.columns(shape)), shape
    base, delays, instead = float(own.sum()), {}, []
    for j, nb, nk in inputs:
        rest, ends = without(shape, (j,))[1], [nk, nk]
        for side, step in enumerate((-1, 1)):
            while pool.fits(near := (na, (*rest, (j, nb, ends[side] + step)))):
                if base - pool.scores.score(pool.columns(near)) >= TIED:
                    break
                ends[side] += step
        delays[j] = ends[0], ends[1]
        instead += [(j, i) for i, (score, _) in pool.best_delays((na, rest)).items() if i != j and base - score < TIED]
    rivals = sorted((one for one in pool.shapes if one != shape), key=pool.value, reverse=True)
    second = tuple((one, *lead(own, pool.scores.terms(pool.columns(one)))) for one in rivals[:3])
    lags = {j: (nb, nk) for j, nb, nk in inputs}
    return Structure(na, lags, delays, second, doubtful, tuple(instead), log, narrowed=narrowed)


def _of_log(pool: Pool, shape: Shape, y: Array, U: Array, first: int) -> tuple[float, float]:
    """The lead of a structure of log y over that of y, on the scale of y: d log y = dy / y."""
    own, S = pool.scores, pool.columns(shape)
    if not np.all((y > 0.0) | np.isnan(y)):
        return 0.0, 0.0
    other = Pool(np.log(y), U, pool.M, first).scores
    other.refer(S)
    slope = np.add.reduceat(np.log(y[pool.rows]), np.cumsum(own.count).astype(int) - own.count.astype(int))
    return lead(other.terms(S) - own.count * np.log(other.size / own.size) - slope, own.terms(S))


def _affordable(y: Array, U: Array, M: int) -> tuple[int, str]:
    """The longest lag that memory and record allow, and what is said of it: half of the rows must have all lags."""
    t, known = np.arange(len(y)), np.isfinite(np.column_stack([filled(x) for x in (y, *U.T)])).all(axis=1)
    run = (t - np.maximum.accumulate(np.where(known, -1, t)))[np.isfinite(y)]  # known samples in a row
    half = int(np.median(run[run > 1])) - 1 if (run > 1).any() else 1
    most = max(1, min(M, len(y) // 10, COLUMNS // max(U.shape[1], 1) - 1, half))
    return most, f"lags of inputs up to {most} instead of {M}" if most < M else ""


def _beats_copies(y: Array, U: Array, shape: Shape, j: int, rng: np.random.Generator) -> bool:
    """Whether an input is more useful than copies of itself at other times, each at the best of several delays."""
    own, used, T = next(one for one in shape[1] if one[0] == j), [one[0] for one in shape[1]], len(y)
    x = filled(U[:, j])
    x, copies = np.where(np.isfinite(x), x, np.nanmean(x)), []
    for k in range(COPIES):
        other = np.roll([x, x[::-1]], int(rng.integers(T // 10, T - T // 10)))[0][:: 1 if k % 2 else -1]
        copies += [np.roll(other, lag) for lag in range(0, 24, 3)]
    depth = max(nb + nk - 1 for _, nb, nk in shape[1])
    pool = Pool(y, U[:, used], max(depth, 1), na=max(shape[0], 1), more=np.column_stack(copies))
    base = pool.columns((shape[0], tuple((used.index(i), nb, nk) for i, nb, nk in without(shape, (j,))[1])))
    pool.scores.refer(base)
    with_it = [*base, *(pool.place[used.index(j), k] for k in range(own[2], own[2] + own[1]))]
    return bool(pool.scores.score(with_it) > pool.scores.added(base)[-len(copies) :].max())

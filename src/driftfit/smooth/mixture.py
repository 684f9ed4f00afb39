"""The smoother of mixtures: a random walk whose drift follows a Markov chain, with events and a mixture of noises.

    theta_t = theta_{t-1} + w_t,   w_t ~ N(0, Q of the move),   P(move to mode s' with event e | mode s) = p
    y_t = phi_t' theta_t + v_t,    v_t ~ N(offset_l, r_t factor_l) with the probability of noise l in mode s

One filter goes forwards through p(theta_t, s_t | y_1 .. y_t), another backwards through p(y_t .. y_T | theta_t, s_t).
Both are sums of Gaussians (`driftfit.smooth.solvers.components`) and run the same routine. Between t and t + 1 they
meet,

    p(theta_t, i, m, j | y)  proportional to  F_i(theta_t) p_m integral N(w; 0, Q_m) B_j(theta_t + w) dw

for all components i and j and moves m. This gives the moments of the mixture, the probabilities of the events, and how
far theta moved. The sum over all of them is the evidence at every t. Where it is not constant the reductions have lost
a hypothesis that counts, and the record is smoothed again with more components there.

Source: Kitagawa (1994), "The two-filter formula for smoothing and an implementation of the Gaussian-sum smoother".
Cost: O(K^2 M n^3) per sample for K components and M moves. Memory: that of the result, and the components of `BLOCK`
samples; the filter runs again from checkpoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.smooth.solvers.components import (
    COST,
    LOG,
    MODE,
    MOVE,
    ROOMY,
    SHARE,
    Filter,
    Moves,
    Noises,
    Room,
    absorb,
    copy_upper,
    grow,
    log_det,
    lowered,
    moments,
    observe,
    reduce,
    room_for,
)
from driftfit.smooth.solvers.rank import column_sizes

BLOCK = 1000
"""Samples between checkpoints."""
MOST_COMPONENTS = 48
"""Components that are kept at most, where the evidence is not constant; `ROOMY` elsewhere."""
NEAR = 16
"""Samples to either side of such a place that get more components."""
CONSTANT = 0.2
"""Change of the log evidence from one sample to the next that is accepted."""
NEGLIGIBLE = 8.0
"""Log of the ratio to the most probable pair below which a pair is left out of the moments."""
VAGUE = 1e-11
"""Information on theta outside the record, as a share of the root of that in one sample."""


class Alternatives(NamedTuple):
    """What may happen between two samples: M moves between S modes."""

    source: Array
    target: Array
    event: Array
    """(M,): modes before and after, and the event, 0 for none."""
    log_prob: Array
    """(U, M): U tables of log probabilities; those out of a mode sum to 1. At the first sample all is in mode 0."""
    roots: Array
    """(E, n, n): upper triangles G with G G' the covariance of an event."""
    adds: bool = False
    """Whether the drift of event 0 happens too when there is another event."""

    def first(self) -> Array:
        """(U, E): the probabilities of the events out of mode 0."""
        probs = np.zeros((len(self.log_prob), len(self.roots)))
        for move in np.flatnonzero(self.source == 0):
            probs[:, self.event[move]] += np.exp(self.log_prob[:, move])
        return probs

    def moves(self, scale: Array, back: bool = False) -> Moves:
        """The same in one direction of time, for theta multiplied by ``scale``."""
        source, target = (self.target, self.source) if back else (self.source, self.target)
        order, modes = np.argsort(source, kind="stable"), max(source.max(), target.max()) + 1
        begin = np.searchsorted(source[order], np.arange(modes + 1))
        own = np.where(self.event > 0, self.event, -1)
        roots = (0 * own, own) if self.adds else (self.event, np.full_like(own, -1))
        kind = np.column_stack([target, self.event, *roots])[order].astype(np.int64)
        return Moves(begin, kind, np.ascontiguousarray(self.log_prob[:, order]), self.roots * scale[:, None])


class Problem(NamedTuple):
    """T samples of a regression of n parameters, and what may happen between them."""

    phi: Array
    """(T, n), finite."""
    y: Array
    r: Array
    """(T,): noise variance; inf for samples that are not used."""
    alternatives: Alternatives
    table: Array
    """(T,): which table of probabilities holds before each sample."""
    sizes: Array
    """(T, E): factors of the roots before each sample."""
    start: Array
    """(k, n + 1): information before the first sample, rows theta = value of variance 1."""
    noises: Noises


class Mixture(NamedTuple):
    """The moments of the mixture given the whole record."""

    theta: Array
    cov: Array
    """(T, n), and variances (T, n) or covariances (T, n, n)."""
    events: Array
    """(T, E): probabilities of the events between t - 1 and t, event 0 first."""
    shift: Array
    shift_var: Array
    """(T, n): mean and variance of theta_t - theta_{t-1} if there was an event other than 0."""
    evidence: Array
    """(T,): log evidence as computed at each sample, without the constant of a start without information."""
    kept: Array
    """(T,): how many components were allowed."""
    moves: Array
    """(E, n) bool: which parameters an event moves."""

    @property
    def var(self) -> Array:
        """(T, n)"""
        return np.asarray(self.cov if self.cov.ndim == 2 else np.einsum("tii->ti", self.cov))

    def increment(self, first: int, last: int) -> tuple[Array, Array]:
        """Mean and standard deviation (n,) of how far theta moved by events at these samples, if there was one.

        Two events at neighbouring samples have some probability, and each of them may then have been of any size. The
        mean is therefore that of their sum, and the variance at most that of the path before and after together.
        """
        part = slice(first, last + 1)
        p, each = 1.0 - self.events[part, :1], self.shift[part]
        mean = np.sum(p * each, axis=0)
        center = mean / p.sum()
        var = np.sum(p * (self.shift_var[part] + (each - center) ** 2), axis=0) / p.sum()
        return mean / min(p.sum(), 1.0), np.sqrt(np.minimum(var, self.var[max(first - 1, 0)] + self.var[last]))

    def turned(self, B: Array) -> Mixture:
        """That of B theta, B (m, n), if what an event moves, by B, is independent; names of parameters stay."""
        shift, var = self.shift @ B.T, self.shift_var @ (B**2).T
        return self._replace(theta=self.theta @ B.T, cov=B @ self.cov @ B.T, shift=shift, shift_var=var)

    @property
    def uneven(self) -> Array:
        """(T,) bool: whether the evidence differs from that of the next sample, so that a hypothesis was lost."""
        return np.append(np.abs(np.diff(self.evidence)) > CONSTANT, False)

    @property
    def needed(self) -> Array:
        """(T,): how many components the next smoother of the record should be allowed."""
        more = self.kept.copy()
        for t in np.flatnonzero(self.uneven):
            more[max(t - NEAR, 0) : t + NEAR] = MOST_COMPONENTS
        return more


class Samples(NamedTuple):
    """A block of samples for a pass, and the moves before them, or after them backwards."""

    phi: Array
    y: Array
    r: Array
    keep: Array
    table: Array
    sizes: Array


@shared
def join(mean: Array, cov: Array, share: float, m: Array, R: Array, d: Array) -> None:
    """The moments of a mixture, with one more component N(m, R R') of this share."""
    n = len(m)
    for i in range(n):
        d[i] = m[i] - mean[i]
    for i in range(n):
        mean[i] += share * d[i]
        for j in range(i + 1):
            t = 0.0
            for k in range(i, n):
                t += R[i, k] * R[j, k]
            cov[i, j] += share * (t + (1.0 - share) * d[i] * d[j] - cov[i, j])
            cov[j, i] = cov[i, j]


@shared
def step(
    A: Array, move: Array, roots: Array, sizes: Array, work: Array, share: float, out: Array, row: Array
) -> None:  # fmt: skip
    """The same for the change w of a move, from the posterior N(m, R R') of theta before it and the likelihood A:

    E w = Q S' (d - S m),   Var w = Q - Q S' S Q + (R' S' S Q)' (R' S' S Q)
    """
    n = len(A)
    R, m, Q, V, shift, shift_var = work[1, :, :n], work[1, :, n], work[2], work[3], out[n + 1], out[n + 2]
    for i in range(n):
        for j in range(n):
            Q[i, j] = 0.0
    for which in range(2):
        G = move[2 + which]
        if G >= 0:
            size = sizes[G]
            for i in range(n):
                for j in range(n):
                    for k in range(max(i, j), n):
                        Q[i, j] += size * size * roots[G, i, k] * roots[G, j, k]
    for i in range(n):
        row[i] = A[i, n]
        for j in range(i, n):
            row[i] -= A[i, j] * m[j]
        for j in range(n):
            V[i, j] = 0.0
            for k in range(i, n):
                V[i, j] += A[i, k] * Q[k, j]
    for j in range(n):
        mean, var = 0.0, Q[j, j]
        for i in range(n):
            mean += V[i, j] * row[i]
            var -= V[i, j] * V[i, j]
        for k in range(n):
            z = 0.0  # row k of R' S' V
            for i in range(n):
                t = 0.0
                for q in range(i, k + 1):
                    t += A[i, q] * R[q, k]
                z += t * V[i, j]
            var += z * z
        d = mean - shift[j]
        shift[j] += share * d
        shift_var[j] += share * (max(var, 0.0) + (1.0 - share) * d * d - shift_var[j])


@shared
def meet(
    X: Array, facts: Array, C: int, moves: Moves, sizes: Array, room: Room, out: Array, events: Array
) -> float:  # fmt: skip
    """All pairs of K components of the filter and C children of the components after them.

    Adds the probabilities of events to ``events``; the rows of ``out`` become the mean, those of the covariance, and
    mean and variance of the change at an event. Returns the log of the sum of all pairs.
    """
    K, Y, more, row, work = len(X), room.born, room.born_facts, room.row, room.squares
    n, top, total, moved = X.shape[1], -np.inf, 0.0, 0.0
    W, R, m, mean, cov = work[0], work[1, :, :n], work[1, :, n], out[0], out[1 : n + 1]
    for i in range(n + 3):
        for j in range(n):
            out[i, j] = 0.0
    for f in range(K):
        for k in range(C):
            ahead = max(facts[f, LOG] - facts[f, SHARE], more[k, LOG] - more[k, SHARE])
            c = facts[f, LOG] + more[k, LOG]
            if facts[f, MODE] != more[k, MODE] or c - ahead < top - NEGLIGIBLE:
                continue
            copy_upper(X[f], W)
            for q in range(n):
                for j in range(n + 1):
                    row[j] = Y[k, q, j] if j >= q else 0.0
                e = absorb(W, row)
                c -= 0.5 * e * e
                if c - ahead < top - NEGLIGIBLE:
                    break
            c -= max(log_det(W), ahead)  # of a pair that is given up, W lacks rows
            if c < top - NEGLIGIBLE:
                continue
            w = np.exp(c - top)
            if c > top:
                scale = np.exp(top - c)
                total, moved, top, w = total * scale, moved * scale, c, 1.0
                for e in range(len(events)):
                    events[e] *= scale
            moments(W, R, m)
            total += w
            join(mean, cov, w / total, m, R, row)
            label, at = int(moves.kind[int(more[k, MOVE]), 1]), int(more[k, MOVE])
            events[label] += w
            if label > 0:
                moved += w
                step(Y[k], moves.kind[at], moves.roots, sizes, work, w / moved, out, row)
    for e in range(len(events)):
        events[e] /= total
    return float(top + np.log(total))


@Driver
def forwards(
    samples: Samples, moves: Moves, noises: Noises, now: Filter, stored: Filter, room: Room, store: bool
) -> None:  # fmt: skip
    """The filter through a block of samples. With ``store`` it stores its components after each sample, and the levels
    before and after it.
    """
    phi, y, r, keep, table, sizes = samples
    K = now.many[0]
    stored.level[0] = now.level[0]
    for t in range(len(y)):
        C = grow(K, now, moves, moves.log_prob[table[t]], sizes[t], room)
        if r[t] < np.inf:
            C = observe(C, room, phi[t], y[t], r[t], noises, now)
        K = reduce(C, room, keep[t], now)
        now.level[0] += lowered(K, now.facts)
        if store:
            stored.many[t], stored.level[t + 1] = K, now.level[0]
            stored.A[t, :K], stored.facts[t, :K] = now.A[:K], now.facts[:K]
    now.many[0] = K


@Driver
def backwards(
    samples: Samples, moves: Moves, noises: Noises, now: Filter, stored: Filter, room: Room, last: bool, found: Mixture
) -> None:  # fmt: skip
    """The likelihood through a block, and where it meets the filter; ``last``: the record ends with the block."""
    phi, y, r, keep, table, sizes = samples
    K, n, wide = now.many[0], phi.shape[1], found.cov.shape[2]
    out = np.zeros((n + 3, n))
    for t in range(len(y) - 1, -1, -1):
        if last and t == len(y) - 1:
            C = K
            room.born[:K], room.born_facts[:K] = now.A[:K], now.facts[:K]
        else:
            C = grow(K, now, moves, moves.log_prob[table[t]], sizes[t], room)
        X, facts = stored.A[t, : stored.many[t]], stored.facts[t]
        total = meet(X, facts, C, moves, sizes[min(t, len(sizes) - 1)], room, out, found.events[t])
        found.evidence[t] = stored.level[t + 1] + now.level[0] + total
        found.theta[t], found.shift[t], found.shift_var[t] = out[0], out[n + 1], out[n + 2]
        for i in range(n):
            for j in range(wide if wide > 1 else 0):
                found.cov[t, i, j] = out[1 + i, j]
            found.cov[t, i, min(i, wide - 1)] = out[1 + i, i]
        if r[t] < np.inf:
            C = observe(C, room, phi[t], y[t], r[t], noises, now)
        K = reduce(C, room, keep[t], now)
        now.level[0] += lowered(K, now.facts)
    now.many[0] = K


def smooth(problem: Problem, covariances: bool = False, kept: Array | None = None) -> Mixture:
    """Smooth a record; with ``covariances`` of every sample, and otherwise variances.

    ``kept`` (T,) says how many components another smoother of the record needed, with which this one begins. Where the
    evidence is not constant, `MOST_COMPONENTS` are allowed (`Mixture.needed`).
    """
    needed = np.full(len(problem.y), ROOMY) if kept is None else kept
    while True:
        found = Passes(problem, needed).smoothed(covariances)
        needed = found.needed
        if np.array_equal(needed, found.kept):
            return found


def average(w: Array, found: Sequence[Mixture]) -> Mixture:
    """The mixture of mixtures with shares w (K,) that sum to 1; evidence and components are those of the first."""
    theta = np.asarray(sum(share * one.theta for share, one in zip(w, found, strict=True)))
    events = np.asarray(sum(share * one.events for share, one in zip(w, found, strict=True)))
    moved = w[:, None] * np.array([1.0 - one.events[:, 0] for one in found])
    moved = (moved / np.maximum(moved.sum(axis=0), np.finfo(float).tiny))[:, :, None]
    shift = np.asarray(sum(share * one.shift for share, one in zip(moved, found, strict=True)))
    cov, shift_var = np.zeros_like(found[0].cov), np.zeros_like(shift)
    for share, given, one in zip(w, moved, found, strict=True):
        away = one.theta - theta
        cov += share * (one.cov + (away**2 if cov.ndim == 2 else away[:, :, None] * away[:, None, :]))
        shift_var += given * (one.shift_var + (one.shift - shift) ** 2)
    return found[0]._replace(theta=theta, cov=cov, events=events, shift=shift, shift_var=shift_var)


def filtered(problem: Problem, keep: int) -> tuple[float, float, float]:
    """The log evidence, the expected sum of e_t^2 / s_t, and the expected number of samples with another noise than the
    first, from a filter with this number of components.
    """
    passes = Passes(problem, np.full(len(problem.y), keep))
    evidence, facts = passes.forward(), passes.ahead.facts[: passes.ahead.many[0]]
    weight = np.exp(facts[:, SHARE])
    return evidence, float(weight @ facts[:, COST] / weight.sum()), float(passes.ahead.spikes[0])


class Passes:
    """The two filters over one record, in units in which columns of regressors have unit size."""

    def __init__(self, problem: Problem, keep: Array) -> None:
        phi, r, noises = problem.phi, problem.r, problem.noises
        self.problem, self.keep, used = problem, keep, np.isfinite(r)
        self.places: list[Filter] = []
        T, n = phi.shape
        S, most = len(noises.log_prob), max(int(keep.max()), len(noises.log_prob))
        self.constant = -0.5 * used.sum() * np.log(2.0 * np.pi)
        self.scale = column_sizes(phi[used]) if used.any() else np.ones(n)
        self.ways = [problem.alternatives.moves(self.scale, back) for back in (False, True)]
        children = max(int(np.diff(way.begin).max()) for way in self.ways) * len(noises.kind)
        self.room = room_for(n, most, children)
        self.samples = Samples(phi / self.scale, problem.y, r, keep, problem.table, problem.sizes)
        unit = VAGUE / np.sqrt(np.median(r[used])) if used.any() else VAGUE
        end, rows = unit * np.eye(n, n + 1), problem.start / np.append(self.scale, 1.0)
        self.ahead, self.behind = (
            Filter(np.zeros((most, n, n + 1)), np.zeros((most, 5)), np.full(1, many), np.zeros(1), np.zeros(1))
            for many in (1, S)
        )
        self.ahead.A[0] = triangle(np.vstack([rows, end]))
        size = np.sum(np.log(np.diag(self.ahead.A[0])))
        self.ahead.facts[0, LOG], self.ahead.facts[0, SHARE] = (size, 0.0) if len(rows) >= n else (0.0, -size)
        self.behind.A[:S] = end
        self.behind.facts[:S, MODE], self.behind.facts[:S, SHARE] = np.arange(S), -n * np.log(unit)
        size = min(T, BLOCK)
        self.stored = Filter(
            np.zeros((size, most, n, n + 1)), np.zeros((size, most, 5)), np.zeros(size, np.int64), np.zeros(size + 1),
            np.zeros(0),
        )  # fmt: skip

    def _block(self, a: int, later: int) -> Samples:
        """The samples from a on, with the moves so many samples later."""
        starts = (a, a, a, a, a + later, a + later)
        return Samples(*(values[b : b + BLOCK] for values, b in zip(self.samples, starts, strict=True)))

    def _forward(self, a: int, store: bool) -> None:
        forwards(self._block(a, 0), self.ways[0], self.problem.noises, self.ahead, self.stored, self.room, store)

    def forward(self) -> float:
        """The filter over the record, of whose components those before every block and in the last one are stored.

        Returns the log evidence.
        """
        for a in range(0, len(self.keep), BLOCK):
            self.places.append(Filter(*(values.copy() for values in self.ahead)))
            self._forward(a, a + BLOCK >= len(self.keep))
        now = self.ahead
        return float(now.level[0] + np.log(np.exp(now.facts[: now.many[0], SHARE]).sum()) + self.constant)

    def smoothed(self, covariances: bool) -> Mixture:
        """Both passes, or the second if the first one is done."""
        if not self.places:
            self.forward()
        T, n = self.problem.phi.shape
        roots = self.problem.alternatives.roots
        E = len(roots)
        found = Mixture(
            np.empty((T, n)), np.empty((T, n, n if covariances else 1)), np.zeros((T + 1, E)), np.zeros((T + 1, n)),
            np.zeros((T + 1, n)), np.empty(T), self.keep, np.asarray(roots.any(axis=2)),
        )  # fmt: skip
        for a, place in reversed([*zip(range(0, T, BLOCK), self.places, strict=True)]):
            here, after = slice(a, min(a + BLOCK, T)), slice(a + 1, min(a + BLOCK, T) + 1)
            if here.stop < T:
                for values, before in zip(self.ahead, place, strict=True):
                    values[:] = before
                self._forward(a, True)
            places = here, here, after, after, after, here
            part = Mixture._make([*(values[at] for values, at in zip(found[:-2], places, strict=True)), *found[-2:]])
            samples, last = self._block(a, 1), here.stop == T
            backwards(samples, self.ways[1], self.problem.noises, self.behind, self.stored, self.room, last, part)
        found.events[0] = np.eye(1, E)
        scale = self.scale
        return found._replace(
            theta=found.theta / scale, events=found.events[:T], shift=found.shift[:T] / scale,
            cov=found.cov / np.outer(scale, scale) if covariances else found.cov[:, :, 0] / scale**2,
            shift_var=found.shift_var[:T] / scale**2, evidence=found.evidence + self.constant,
        )  # fmt: skip


def triangle(rows: Array) -> Array:
    """[S | d] of at least n rows [phi | y]."""
    R = np.asarray(np.linalg.qr(rows, mode="r"))[: rows.shape[1] - 1]
    return np.triu(R * np.where(np.diag(R) < 0.0, -1.0, 1.0)[:, None])

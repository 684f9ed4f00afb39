"""Records with many settings at once: every lane of a tile runs the same series with its own tracker.

Several records are independent: the state begins again with each of them, and their sums are added. For each setting
the runs are reduced to the sums that the criteria need, so memory does not grow with the records:

    log-likelihood   -1/2 (N log 2 pi + sum log s + sum log F + sum e^2 / s) + sum of the model's log Jacobian
    profiled         s = sigma^2 s0:  sigma^2 = mean(e^2 / s0),
                     -1/2 (N (log 2 pi sigma^2 + 1) + sum log s0 + sum log F) + sum of the model's log Jacobian
    h-step error     mean of w_t (y_t - phi_t' theta_{t-h})^2 after the start

N (`used`) counts the usable samples that did not determine a new direction, F are the diffuse terms of those that did.
Trackers that estimate their own scale report s = scale s0 with the scale known before the sample; it is divided out.
For a tracker that weighs hypotheses, the log-likelihood is the sum of the log densities of the mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.drivers import stored_too
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.tiles import output_type
from driftfit.models.base import Model
from driftfit.run.program import Program, tile_of
from driftfit.run.result import burn_in
from driftfit.run.track import Decisions
from driftfit.trackers.base import Tracker

BLOCK = 1024
"""Samples between two reductions: the output of a tile for that many samples fits into the cache."""


class Task(NamedTuple):
    """The task on which settings are scored: a bound model and checked records; theta is unknown at each start."""

    model: Model
    records: tuple[Record, ...]
    left_out: Decisions | None = None
    """What a gate left out of each record, by its key."""

    @property
    def longest(self) -> int:
        """Samples of the longest record."""
        return max(map(len, self.records))


class Scores(NamedTuple):
    """The reduced results of S settings: sums over all records, (S,) each, but powers (n, S)."""

    used: Array
    log_s: Array
    squares: Array
    more: Array
    """Further terms of the log-likelihood: log Jacobians, or densities that the tracker computes itself."""
    errors: Array
    scored: Array
    powers: Array
    samples: Array

    @property
    def power(self) -> Array:
        """Mean squares of the regressors over the factors of the noise variance, (n, S)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.powers / self.samples)

    def sigma2(self) -> Array:
        """The noise variance if P is relative to it: mean(e^2 / s0)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.squares / self.used)

    def loglik(self, noise: Array | float) -> Array:
        """The log-likelihood if the noise variance is ``noise`` times that of the trackers; -inf if there is none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            body = self.used * np.log(2.0 * np.pi * noise) + self.squares / noise
            value = -0.5 * (body + self.log_s) + self.more
        return np.where(np.isfinite(value), value, -np.inf)


@kernel
def store_inside(o: State, s: State, l: int) -> None:
    """Store the regressor as the tracker received it, and the scale after the sample."""
    o.scale[l] = s.scale[l]
    for i in range(s.phi.shape[0]):
        o.phi[i, l] = s.phi[i, l]


def spread(record: Record, L: int) -> tuple[Array, Array, Array]:
    """(y, u, known) of a record, the same in each of L lanes."""
    y, u, known = (np.repeat(part[..., None], L, axis=-1) for part in (record.y, record.u, record.known.columns))
    return y, u, known


def score(task: Task, trackers: Sequence[Tracker], h: int = 1) -> Scores:
    """Run the records under each tracker (all of one class and one form of settings)."""
    width = Program(task.model, trackers[0]).width
    parts = []
    for a in range(0, len(trackers), width):
        some = list(trackers[a : a + width])
        full = some + [some[-1]] * (width - len(some))
        sums = [_score_tile(task.model, record, full, h) for record in task.records]
        parts.append([sum(values)[..., : len(some)] for values in zip(*sums, strict=True)])
    return Scores(*(np.concatenate(values, axis=-1) for values in zip(*parts, strict=True)))


def _score_tile(model: Model, record: Record, trackers: Sequence[Tracker], h: int) -> Scores:
    L = len(trackers)
    made = {id(tracker): Program(model, tracker) for tracker in trackers}  # lanes beyond the last setting repeat it
    programs = [made[id(tracker)] for tracker in trackers]
    T, tile = len(record), tile_of(programs)
    steps, own = programs[0].steps, trackers[0].outputs if trackers[0].density else ()
    out = np.empty(min(BLOCK, T), output_type(tile, ("scale", "phi", *own)))
    run = (
        programs[0]
        .drivers(steps=steps._replace(store=stored_too(store_inside, steps.store) if own else store_inside))
        .run
    )
    sums = _Sums(model, record, trackers[0], tile, h)
    for a in range(0, T, BLOCK):
        b = min(a + BLOCK, T)
        run(tile, *spread(record.part(slice(a, b)), L), out[: b - a])
        sums.add(a, out[: b - a])
    return sums.scores(tile)


class _Sums:
    """Sums over the blocks of a run, each with the lanes on the last axis."""

    def __init__(self, model: Model, record: Record, tracker: Tracker, tile: Array, h: int) -> None:
        n, L = tile["theta"].shape[1:]
        self.model, self.record, self.tracker, self.h = model, record, tracker, h
        self.burn = min(burn_in(n), len(self.record) // 3)
        self.count, self.log_s, self.squares, self.more = np.zeros((4, L))
        self.errors, self.scored, self.used = np.zeros((3, L))
        self.powers = np.zeros((model.n, L))
        self.scale = np.ones(L) * tile["scale"][0]
        self.past = np.full((h, n, L), np.nan)

    def add(self, a: int, out: Array) -> None:
        ok = out["ok"] > 0.0
        y = self.record.y[a : a + len(out), None]
        counted = self._likelihood(out, ok)
        self._forecast(a, out, ok, y)
        if self.model.implicit and not self.tracker.output_error:
            terms = self.model.implicit.log_jacobian(np.moveaxis(out["theta"], 1, -1), np.broadcast_to(y, ok.shape))
            self.more += np.sum(np.where(counted, terms, 0.0), axis=0)
        root = np.reshape(np.sqrt(self.record.known.part(slice(a, a + len(out))).noise), (-1, 1, 1))
        self.powers += np.sum(np.where(ok[:, None], out["phi"] / root, 0.0) ** 2, axis=0)
        self.used += ok.sum(axis=0)

    def _likelihood(self, out: Array, ok: Array) -> Array:
        """Add the terms of the samples that have them; returns which samples do, (T, L)."""
        before = np.concatenate([self.scale[None], out["scale"][:-1]])
        self.scale = out["scale"][-1].copy()
        with np.errstate(divide="ignore", invalid="ignore"):
            s = out["s"] / before
            first = ok & np.isnan(before)  # no scale was known before the sample that gave the first one
            s = np.where(first, out["e"] ** 2 / out["scale"], s)
            counted = ok & np.isfinite(s) & (s > 0.0)
            own = self.tracker.log_density(out)
            if own is not None:
                self.more += np.sum(np.where(counted, own, 0.0), axis=0)
                return np.asarray(counted)
            self.log_s += np.sum(np.where(counted, np.log(s), 0.0), axis=0)
            self.squares += np.sum(np.where(counted, out["e"] ** 2 / s, 0.0), axis=0)
        self.count += counted.sum(axis=0)
        return np.asarray(counted)

    def _forecast(self, a: int, out: Array, ok: Array, y: Array) -> None:
        error = out["e"]
        if self.h > 1:
            theta = np.concatenate([self.past, out["theta"]])
            self.past = theta[-self.h :].copy()
            error = y - np.sum(out["phi"] * theta[: len(out)], axis=1)
        weight = 1.0 / self.record.known.part(slice(a, a + len(out))).noise[:, None]
        scored = ok & (np.arange(a, a + len(out)) >= self.burn)[:, None]
        with np.errstate(invalid="ignore"):
            self.errors += np.sum(np.where(scored, weight * error**2, 0.0), axis=0)
        self.scored += scored.sum(axis=0)

    def scores(self, tile: Array) -> Scores:
        if "F" in (tile.dtype.names or ()):
            self.log_s += np.sum(np.log(tile["F"][0]), axis=0)
        sums = (self.count, self.log_s, self.squares, self.more, self.errors, self.scored, self.powers, self.used)
        return Scores(*sums)

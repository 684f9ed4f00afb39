"""The diffuse start of trackers that do not judge outliers by themselves: the first samples are judged together.

A diffuse start fits the first samples exactly, so a fault code among them would determine the estimate. The start
therefore lasts until there are `RESIDUALS` more samples than directions of theta that they span, and `FIRST` samples.
If some of them are doubtful (`driftfit.trackers.parts.faults.first_samples`), it lasts until the others have
`RESIDUALS_IN_DOUBT`, or the store is full. If the estimate from all samples contradicts the others, the start is
repeated without the doubtful ones, at every sample until that is decided: models may compute later regressors with the
estimate. It is in square-root form until a covariance is accurate enough.

Samples (`driftfit.trackers.parts.faults.stored_samples`) are stored with the time since the previous stored one, so
that drift and forgetting are repeated as well.

Cost: O(n) more for each of a few samples, and O(n N^2) once for N stored samples.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel, nothing
from driftfit.trackers.parts.covariance import symmetric_product
from driftfit.trackers.parts.diffuse import BEFORE, MACHINES, know_nothing, reform
from driftfit.trackers.parts.faults.contradictions import (
    add_to_block,
    close_block,
    judge_unusual,
    learn_reading,
    needs_begin,
    needs_judging,
    no_contradictions,
)
from driftfit.trackers.parts.faults.first_samples import (
    NOISE,
    PHI,
    READING,
    RESIDUALS,
    RESIDUALS_IN_DOUBT,
    SPAN,
    contradict,
    doubtful,
)
from driftfit.trackers.parts.faults.outlying_readings import FIRST
from driftfit.trackers.parts.faults.stored_samples import (
    doubtful_samples,
    machine_doubt,
    recall,
    squares_left,
    store,
    without_fault,
)
from driftfit.trackers.parts.faults.strange_inputs import (
    OUTSIDE_GIVEN_DRIFT,
    blame_of_inputs,
    learn_inputs,
    learn_stored_inputs,
    no_strange_inputs,
)

MORE = 16
"""Samples that are stored beyond the number of parameters."""
VARIED = 3.0
"""Number of readings, not counting those that repeat the one before, that show a range of the plant: at rest it has one
or two, but a coarse meter beside an input that is held for some samples has few more."""
FEW = 2.0
"""Variance of a prediction after a start, in those of the noise."""


def unjudged(theta: Array, diffuse: bool) -> dict[str, Any]:
    """Fields before the first sample, for a start at theta (n,); with a proper prior nothing is judged."""
    n = len(theta)
    return {
        "samples": np.zeros((n + MORE, PHI + n)), "ages": np.zeros(n + MORE), "remembered": 0, "waited": 0.0,
        "age": 0.0, "start_over": 0 if diffuse else 1, "start_theta": theta, "start_faults": 0.0,
        **no_contradictions(0 if diffuse else n), **no_strange_inputs(n),
    }  # fmt: skip


START_MACHINES = (*MACHINES, machine_doubt)
"""The routines that a start calls; see `TrackerSteps`."""


@kernel
def room(s: State, l: int) -> int:
    """Number of samples that are stored at most."""
    most: int = s.samples.shape[0] - s.absent[l]
    return most


@kernel
def spare_samples(s: State, l: int) -> int:
    """Number of stored samples beyond the directions that they span."""
    spare: int = s.remembered[l] - (s.rank[l] - s.absent[l])
    return spare


@kernel
def keep(s: State, l: int) -> None:
    """Store the sample, also with the intervals of forgetting since the last one in ``ages``."""
    s.age[l] += s.dt[l]
    s.waited[l] += s.dt[l] * s.drift[l]
    if (s.ok[l] > 0.0) & (s.remembered[l] < room(s, l)):
        store(s, l)
        s.ages[s.remembered[l], l] = s.age[l]
        s.age[l], s.waited[l] = 0.0, 0.0
        s.remembered[l] += 1


@kernel
def as_before(s: State, l: int) -> None:
    """The state of the diffuse start before the first sample."""
    n = s.theta.shape[0]
    for i in range(n):
        s.theta[i, l], s.var[i, l] = s.start_theta[i, l], np.inf
    know_nothing(s, l)


@kernel
def settle(s: State, l: int) -> None:
    """The start is over: the readings of the samples that it used are the range of later ones."""
    s.start_over[l] = 1
    s.block_left[l] = s.block_size[l]  # what was added to the block is learned from the stored samples
    for at in range(s.remembered[l]):
        if s.samples[at, NOISE, l] > 0.0:
            learn_reading(s, s.samples[at, READING, l], l)
    varied = s.y_count[l] >= VARIED
    known = (s.scale[l] > 0.0) & varied  # it is NaN without residuals
    s.ratios[l] = max(spare_samples(s, l) - s.start_faults[l], 0.0) if known else 0.0
    s.mean_ratio[l] = squares_left(s, l) / (max(s.ratios[l], 1.0) * s.r[l] * s.scale[l]) if known else 0.0
    # samples are judged alone from now on, also if some of these readings repeat others; but a plant at rest has shown
    # nothing of its range
    s.judged_from[l] = min(s.judged_from[l], s.y_count[l]) if varied else FIRST + s.theta.shape[0]
    s.usual_variance[l] = FEW * s.r[l] * s.scale[l]
    learn_stored_inputs(s, l)
    close_block(s, l)


@kernel
def judge_sample(s: State, y_hat: float, v: float, l: int) -> None:
    """Judge a sample that is not ordinary, and its inputs: how far it is off, when errors so far were smaller than
    expected, still depends on what is not known of theta.
    """
    blame = blame_of_inputs(s, s.y[l] - y_hat, v * s.scale[l] * max(s.mean_ratio[l], 1.0), OUTSIDE_GIVEN_DRIFT, l)
    judge_unusual(s, y_hat, v, blame, l)


@kernel
def trust_all(s: State, l: int) -> None:
    for at in range(s.remembered[l]):
        s.samples[at, NOISE, l] = abs(s.samples[at, NOISE, l])


@lru_cache
def reconsidering(one: Step, restart: Step) -> Any:
    """``reconsider(s, found, l)``: the start repeated without the doubtful samples, if they contradict the others."""

    @partial(kernel, inline=False)
    def repeat(s: State, every: bool, l: int) -> None:
        """The start again, with every sample or without the doubtful ones."""
        age, waited = 0.0, 0.0
        as_before(s, l)
        restart(s, l)
        for at in range(s.remembered[l]):
            age += s.ages[at, l]
            waited += s.samples[at, SPAN, l]
            if every or s.samples[at, NOISE, l] > 0.0:
                recall(s, at, l)
                s.dt[l], s.drift[l] = age, waited / age if age > 0.0 else 0.0
                one(s, l)
                age, waited = 0.0, 0.0

    @partial(kernel, inline=False)
    def reconsider(s: State, found: int, l: int) -> None:
        y, y_hat, e, v, noise, shift = s.y[l], s.y_hat[l], s.e[l], s.s[l], s.noise[l], s.shift[l]
        dt, drift = s.dt[l], s.drift[l]
        if s.start_faults[l] > 0.0:
            repeat(s, True, l)
        with_all = squares_left(s, l)
        repeat(s, False, l)
        contradicted = contradict(with_all, squares_left(s, l), spare_samples(s, l) - found)
        if not contradicted:
            repeat(s, True, l)
            trust_all(s, l)
        left = found if contradicted else 0
        s.left_out[l] += left - s.start_faults[l]
        s.start_faults[l] = left
        recall(s, s.remembered[l] - 1, l)
        s.y[l], s.y_hat[l], s.e[l], s.s[l], s.noise[l], s.shift[l] = y, y_hat, e, v, noise, shift
        s.dt[l], s.drift[l] = dt, drift
        if contradicted:
            without_fault(s, y_hat, l)

    return reconsider


def judged(
    begin: Step, steps: TrackerSteps, restart: Step = nothing, variance: Callable[..., float] = symmetric_product
) -> TrackerSteps:
    """Steps whose samples are judged, first together, then one by one.

    ``begin`` is the start in square-root form, ``steps`` what follows it, ``restart`` sets the fields of the tracker as
    before the first sample, and ``variance`` is phi' P phi after the time update.
    """

    @partial(kernel, inline=False)
    def one(s: State, l: int) -> None:
        begin(s, l)

    reconsider, predict, correct, report = reconsidering(one, restart), steps.predict, steps.correct, steps.report

    @kernel
    def sample(s: State, l: int) -> None:
        """A sample of the start: in square-root form until a covariance is accurate enough."""
        if s.root[l] > 0:
            one(s, l)
        else:
            predict(s, l)
            correct(s, l)
            report(s, l)

    @kernel
    def later(s: State, l: int) -> None:
        """A sample after the start: in square-root form, or not ordinary."""
        unusual = needs_judging(s, s.e[l], l)
        if s.root[l] > 0:
            y_hat, e = s.y_hat[l], s.e[l]
            if unusual:
                reform(s, l)  # gives the variance of the prediction
                judge_sample(s, y_hat, s.at_start[BEFORE, l] + s.r[l] * s.noise[l], l)
            one(s, l)
            add_to_block(s, e * e / (s.at_start[BEFORE, l] + s.r[l] * s.noise[l]), l)
            learn_inputs(s, l)
        else:
            predict(s, l)
            judge_sample(s, s.y_hat[l], variance(s, l) + s.r[l] * s.noise[l], l)
            correct(s, l)
            report(s, l)
        if unusual:
            close_block(s, l)

    @kernel
    def start(s: State, l: int) -> None:
        if s.start_over[l] > 0:
            later(s, l)
        else:
            keep(s, l)
            sample(s, l)
            spare, found = spare_samples(s, l), 0
            full = s.remembered[l] >= room(s, l)
            if (s.ok[l] > 0.0) & (spare >= RESIDUALS):
                found = doubtful_samples(s, 1 if full else 0, l)
            least = RESIDUALS if full else RESIDUALS_IN_DOUBT
            enough = spare - found >= least if found > 0 else s.remembered[l] >= FIRST
            ready = (spare >= RESIDUALS) & enough
            if found > 0:  # also before it is decided, because models compute later regressors with these estimates
                reconsider(s, found, l)
            if ready | full:
                settle(s, l)

    return steps._replace(begin=start, machines=START_MACHINES, apart=needs_begin)


def faults(field: Callable[[str], Any], phi: Array, y: Array, ok: Array) -> Array:
    """Which of the samples (T,) of a record were left out of its start, given the fields of the state after it."""
    found = np.zeros(len(y), bool)
    if field("start_faults") > 0.0:
        rows = np.flatnonzero(ok)[: int(field("remembered"))]
        found[rows] = doubtful(phi[rows], y[rows], y[rows])
    return found

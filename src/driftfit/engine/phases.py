"""What a driver does between the regression and the lags of a sample: the steps of a tracker, with a gate or without.

    without    predict, forecast, correct, report of all lanes
    with       predict and forecast of all lanes, the gate, and then correct and report

``tracker`` is a `driftfit.engine.drivers.TrackerSteps`. Lanes whose ``s.root`` is 1 take the steps of its ``start``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, Step, kernel, nothing
from driftfit.engine.outlined import outlined

WIDE = 1e9
"""A sample of which the variance h is this multiple of its noise is taken in on square roots: the covariance after it
would keep seven of sixteen digits."""


def forecasting(tracker: Any) -> Any:
    """predict, forecast, and the variance of the error, of one lane."""
    predict, forecast, variance = tracker.predict, tracker.forecast, tracker.variance

    @kernel
    def forecasts(s: State, l: int) -> None:
        predict(s, l)
        forecast(s, l)
        variance(s, l)

    return forecasts


@kernel
def keeps_digits(s: State, l: int) -> None:
    """Whether a covariance can take the sample in; otherwise it is ``late``, and not used before that."""
    wide = (s.h[l] > WIDE * (s.r[l] * s.noise[l])) & (s.h[l] < np.inf)
    s.late[l] = s.ok[l] if wide else 0.0
    s.ok[l] = 0.0 if wide else s.ok[l]


def _late(tracker: Any) -> Any:
    """The samples that `keeps_digits` found to be late, by the form of the start."""
    assert tracker.start is not None
    take_over, correct, report = tracker.start.take_over, tracker.start.correct, tracker.start.report
    assert take_over is not None
    forecast, variance = tracker.start.forecast, tracker.start.variance

    def late(s: State) -> None:
        for l in range(s.theta.shape[1]):
            if s.late[l] > 0.0:
                s.ok[l] = s.late[l]
                take_over(s, l)
                forecast(s, l)
                variance(s, l)
                correct(s, l)
                report(s, l)

    return kernel(late, inline=False)


@kernel
def none_late(s: State, l: int) -> None:
    """All samples are taken in at once."""


def _wide_samples(tracker: Any) -> tuple[bool, Step, Any]:
    """Whether the start takes in what a covariance cannot, the step that finds it, and the one that takes it in."""
    if tracker.start is None or tracker.start.take_over is None:
        return False, none_late, nothing
    return True, keeps_digits, _late(tracker)


def advancing(tracker: Any) -> Any:
    """One sample of all lanes of a tile; lanes whose ``s.root`` is 1 take the steps of the ``start``."""
    forecasts, correct, report = forecasting(tracker), tracker.correct, tracker.report
    both, check, late = _wide_samples(tracker)
    called = outlined(late, short=True) if both else late

    @kernel
    def advance(s: State) -> None:
        for l in range(s.theta.shape[1]):
            forecasts(s, l)
            check(s, l)
            correct(s, l)
        for l in range(s.theta.shape[1]):
            report(s, l)

    @kernel
    def advance_or_wait(s: State) -> None:
        advance(s)
        some = 0.0
        for l in range(s.theta.shape[1]):
            some = max(some, s.late[l])
        if some > 0.0:
            called(s)

    usual = advance_or_wait if both else advance
    if tracker.start is None:
        return advance
    first = tracker.start
    forecasts_first, correct_first, report_first = forecasting(first), first.correct, first.report

    def start(s: State) -> None:
        alone = s.theta.shape[1] == 1  # a constant, for which there is no code of the others
        for l in range(s.theta.shape[1]):
            s.late[l] = 0.0
            if alone or s.root[l] > 0:
                forecasts_first(s, l)
                correct_first(s, l)
                report_first(s, l)
            else:
                forecasts(s, l)
                check(s, l)
                correct(s, l)
                report(s, l)
        if both and not alone:
            late(s)

    started = outlined(kernel(start, inline=False), short=True)  # seldom run: the lane loop is better without it

    @kernel
    def advance_or_start(s: State) -> None:
        some = 0
        for l in range(s.theta.shape[1]):
            some = max(some, s.root[l])
        if some > 0:
            started(s)
        else:
            usual(s)

    return advance_or_start


def _of_lanes(usual: Step, first: Step | None) -> Any:
    """A step of all lanes; those whose ``s.root`` is 1 take the ``first``, if the tracker has a start."""

    @kernel
    def all_alike(s: State) -> None:
        for l in range(s.theta.shape[1]):
            usual(s, l)

    @kernel
    def by_root(s: State) -> None:
        for l in range(s.theta.shape[1]):
            if s.root[l] > 0:
                first(s, l)  # type: ignore[misc]
            else:
                usual(s, l)

    return all_alike if first is None else by_root


def looking(tracker: Any) -> Any:
    """Time update and forecast of all lanes, before a gate."""
    return _of_lanes(forecasting(tracker), None if tracker.start is None else forecasting(tracker.start))


@kernel
def floored(s: State, l: int) -> None:
    """A scale that was learned from readings of a coarse meter is not below the variance of their rounding."""
    s.scale[l] = max(s.scale[l], s.floor[l]) if s.floor[l] > 0.0 else s.scale[l]


@kernel
def taken_in(s: State, l: int) -> None:
    """The form of the start takes every sample in."""
    s.late[l] = 0.0


def _corrected(steps: Any, check: Step, bound_scale: Step) -> Step:
    """The correction of one lane, and its report."""
    variance, correct, report = steps.variance, steps.correct, steps.report

    @kernel
    def corrected(s: State, l: int) -> None:
        variance(s, l)
        check(s, l)
        correct(s, l)
        bound_scale(s, l)
        report(s, l)

    return corrected  # type: ignore[no-any-return]


def learning(tracker: Any) -> Any:
    """Correction of all lanes, and reports, after a gate, which may have raised the noise and the floor of r."""
    both, check, late = _wide_samples(tracker)
    bound_scale = floored if tracker.learns_scale else nothing
    first = None if tracker.start is None else _corrected(tracker.start, taken_in, bound_scale)
    corrected = _of_lanes(_corrected(tracker, check, bound_scale), first)
    if not both:
        return corrected

    @kernel
    def learn(s: State) -> None:
        corrected(s)
        late(s)

    return learn


def ungated(phases: tuple[Any, ...], part: Any) -> Any:
    """The steps of a tracker without a gate: all at once, or the two phases between which a gate would stand."""
    first, last, two = phases[0], phases[-1], len(phases) > 1

    @kernel
    def between(s: State) -> None:
        first(part(s))
        if two:  # a constant
            last(part(s))

    return between


def gated(look: Any, learn: Any, gate: Step, part: Any, model: Any) -> Any:
    """The steps of a tracker with a gate, which sees the inputs and the memory of the model too."""

    @partial(kernel, inline=False)
    def judge(s: State) -> None:
        for l in range(s.theta.shape[1]):
            s.raw_e[l] = s.e[l] if s.ok[l] > 0.0 else np.nan
            gate(s, l)

    judged = judge if model.foreseeing else outlined(judge)

    @kernel
    def between(s: State) -> None:
        look(part(s))
        judged(s)
        learn(part(s))

    return between


def raw_kept(regress: Step) -> Step:
    """``regress``, which may put a function of the reading in its place, with the reading in ``s.raw_y``."""

    @kernel
    def regress_and_keep(s: State, l: int) -> None:
        s.raw_y[l] = s.y[l]
        regress(s, l)

    return regress_and_keep  # type: ignore[no-any-return]

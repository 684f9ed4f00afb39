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


def _wide_samples(tracker: Any) -> tuple[bool, Step, Any, Any]:
    """Whether the start takes in what a covariance cannot, the step that finds it, the one that takes it in, and that
    one if any lane has such a sample."""
    if tracker.start is None or tracker.start.take_over is None:
        return False, nothing, nothing, nothing
    late = _late(tracker)
    called = late if tracker.outlined else outlined(late, short=True)

    @kernel
    def where_late(s: State) -> None:
        some = 0.0
        for l in range(s.theta.shape[1]):
            some = max(some, s.late[l])
        if some > 0.0:
            called(s)

    return True, keeps_digits, late, where_late


@kernel
def floored(s: State, l: int) -> None:
    """A scale that was learned from readings of a coarse meter is not below the variance of their rounding."""
    s.scale[l] = max(s.scale[l], s.floor[l]) if s.floor[l] > 0.0 else s.scale[l]


@kernel
def taken_in(s: State, l: int) -> None:
    """The form of the start takes every sample in."""
    s.late[l] = 0.0


def _corrected(before: Step, steps: Any, check: Step, bounded: bool = False) -> Step:
    """The correction of one lane and its report, after the step ``before``; ``bounded`` where a scale has a floor."""
    correct, report = steps.correct, steps.report

    @kernel
    def corrected(s: State, l: int) -> None:
        before(s, l)
        check(s, l)
        correct(s, l)
        if bounded:  # a constant
            floored(s, l)
        report(s, l)

    return corrected  # type: ignore[no-any-return]


def _with_start(usual: Any, tracker: Any, first: Step | None, other: Step, after: Any = None) -> Any:
    """``usual``, which does all lanes, if no lane's ``s.root`` is 1. Otherwise each takes the step ``first`` or
    ``other``, and all take what comes ``after``: seldom run, so the code is short and apart from the drivers', and of a
    single lane it is ``first`` alone.
    """
    if first is None:
        return usual
    more = after is not None

    @partial(kernel, inline=tracker.outlined)
    def mixed(s: State) -> None:
        for l in range(s.theta.shape[1]):
            if s.root[l] > 0:
                first(s, l)
            else:
                other(s, l)
        if more:  # a constant
            after(s)

    if tracker.outlined:
        return mixed

    @partial(kernel, inline=False)
    def alone(s: State) -> None:
        first(s, 0)

    started = outlined(alone, short=True, lanes=mixed)

    @kernel
    def usual_or_start(s: State) -> None:
        some = 0
        for l in range(s.theta.shape[1]):
            some = max(some, s.root[l])
        if some > 0:
            started(s)
        else:
            usual(s)

    return usual_or_start


def advancing(tracker: Any) -> Any:
    """One sample of all lanes of a tile; lanes whose ``s.root`` is 1 take the steps of the ``start``."""
    forecasts, correct, report = forecasting(tracker), tracker.correct, tracker.report
    both, check, late, where_late = _wide_samples(tracker)

    @kernel
    def advance(s: State) -> None:
        for l in range(s.theta.shape[1]):
            forecasts(s, l)
            check(s, l)
            correct(s, l)
        for l in range(s.theta.shape[1]):
            report(s, l)
        if both:  # a constant
            where_late(s)

    first = tracker.start and _corrected(forecasting(tracker.start), tracker.start, taken_in)
    other = _corrected(forecasts, tracker, check)
    return _with_start(advance, tracker, first, other, late if both else None)


def looking(tracker: Any) -> Any:
    """Time update and forecast of all lanes, before a gate."""
    forecasts = forecasting(tracker)

    @kernel
    def look(s: State) -> None:
        for l in range(s.theta.shape[1]):
            forecasts(s, l)

    return _with_start(look, tracker, tracker.start and forecasting(tracker.start), forecasts)


def learning(tracker: Any) -> Any:
    """Correction of all lanes, and reports, after a gate, which may have raised the noise and the floor of r."""
    both, check, late, where_late = _wide_samples(tracker)
    usual = _corrected(tracker.variance, tracker, check, tracker.learns_scale)

    @kernel
    def learn(s: State) -> None:
        for l in range(s.theta.shape[1]):
            usual(s, l)
        if both:  # a constant
            where_late(s)

    first = tracker.start and _corrected(tracker.start.variance, tracker.start, taken_in, tracker.learns_scale)
    return _with_start(learn, tracker, first, usual, late if both else None)

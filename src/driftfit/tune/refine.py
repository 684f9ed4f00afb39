"""Estimation off line: the record is run again and again, each time linearised at the last estimate of the run before.

A model whose prediction is not linear in theta (`PolynomialModel`, `ContinuousTransfer`) is linearised on line at an
estimate that is poor at first. With the linearisation held at theta' for a whole record (`Linearised.held_at`), it is a
linear regression, and the record is run until the estimate settles:

    theta'  <-  the estimate of the run that is linearised at theta',   until it moves by less than a share of its std

where a step is halved as long as the prediction error at the new point is larger.

`RLS(1.0)` is then the Gauss-Newton method of prediction errors (maximum likelihood for Gaussian noise), and
`InstrumentalVariables(1.0)` the iterative refined instrumental variable method (Young's RIV, SRIV and SRIVC). The
signals before the record are taken as 0, as in the source.

Source: Ljung, System Identification (1999), section 10.2; Young, Recursive Estimation and Time-Series Analysis (2011),
chapter 7. Cost: a run of the record for each pass, of which three to ten are usual.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TypeVar

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.run.result import Track
from driftfit.trackers.base import Tracker
from driftfit.trackers.instrumental import InstrumentalVariables
from driftfit.trackers.rls import RLS

R = TypeVar("R", bound=Track)

SETTLED_SHARE = 0.01
"""The passes end when every parameter moves by less than this share of its standard deviation."""

SMALLEST_STEP = 0.01
"""Least share of a step that is tried."""

HELD_VARIANCE = 1e-20
"""Covariance of parameters that are held."""


def refine(run: R, passes: int = 20, drifting: bool = False) -> R:
    """The run again, with its linearisation held where the estimate settles; see `driftfit.tune.refine`.

    Parameters
    ----------
    run : Track
        Of a model that is linearised.
    passes : int
        Largest number of runs. A warning is issued if the estimate still moves in the last one.
    drifting : bool
        Hold the linearisation at the mean of the second half of the path, and not at its end.

    Raises
    ------
    ValueError
        If the model is linear, or the run has not determined all parameters.
    """
    whole("refine", "passes", passes, 1)
    point = run.theta[len(run) // 2 :].mean(axis=0) if drifting else run.theta[-1]
    found, moved = run, np.inf
    for _ in range(passes):
        found = _at(run, point)
        goal = found.theta[len(found) // 2 :].mean(axis=0) if drifting else found.theta[-1]
        if not np.isfinite(found.std[-1]).all():
            raise ValueError(
                "refine: the record does not determine all parameters; give a longer one, or lower orders."
            )
        moved = float(np.max(np.abs(goal - point) / found.std[-1]))
        if moved < SETTLED_SHARE:
            return found
        step = _downhill(run, point, goal)
        if step is None:
            return found
        point = step
    warnings.warn(
        f"refine: after {passes} passes a parameter still moves by {moved:.2g} of its standard deviation; the orders "
        "may be too high for the record, or the run too far from the truth.",
        stacklevel=3,
    )
    return found


def _at(run: R, point: Array, tracker: Tracker | None = None) -> R:
    """The run linearised at a point."""
    linearised = run.program.model.linearised
    if linearised is None:
        raise ValueError(
            f"refine: {type(run.model).__name__} is not linearised, so there is nothing to refine; it is for OE, "
            "ARMAX, BoxJenkins, PolynomialModel and ContinuousTransfer."
        )
    return run.run_by(
        replace(run.program, model=linearised.held_at(point), tracker=run.tracker if tracker is None else tracker)
    )


def _downhill(run: Track, point: Array, goal: Array) -> Array | None:
    """The first point on the way back from the goal that predicts better; None if there is none.

    For a tracker of parameters that drift it is the goal itself, because no single point has a prediction error.
    """
    if not isinstance(run.tracker, RLS | InstrumentalVariables):
        return goal
    before, share = _error(run, run.tracker, point), 1.0
    while share > SMALLEST_STEP:
        step: Array = point + share * (goal - point)
        if _error(run, run.tracker, step) < before:
            return step
        share *= 0.5
    return None


def _error(run: Track, tracker: RLS | InstrumentalVariables, point: Array) -> float:
    """The mean squared prediction error at a point; infinite where the model is unstable."""
    known = replace(tracker, p0=HELD_VARIANCE, theta0=tuple(point.tolist()))
    held = _at(run, point, known)
    return float(np.nanmean(held.innovation**2)) if np.array_equal(held.state["point"], point) else np.inf

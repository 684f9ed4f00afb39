"""Estimation off line: the record is run again and again, each time linearised at the last estimate of the run before.

A model whose prediction is not linear in theta (`PolynomialModel`, `ContinuousTransfer`) is linearised on line at an
estimate that is poor at first. With the linearisation held at theta' for a whole record (`Model.held_at`), it is a
linear regression, and the record is run until the estimate settles:

    theta'  <-  the estimate of the run that is linearised at theta',   until it moves by less than a share of its std

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

from driftfit.engine.settings import whole
from driftfit.run.result import Track, track_record

R = TypeVar("R", bound=Track)

CLOSE = 0.01
"""Share of its standard deviation that no parameter may move by at the last pass."""


def refine(run: R, passes: int = 20, drifting: bool = False) -> R:
    """The run again, with its linearisation held where the estimate settles; see `driftfit.tune.refine`.

    Parameters
    ----------
    run : Track
        Of a model that is linearised.
    passes : int
        At most so many runs. If the estimate still moves at the last, a warning says so.
    drifting : bool
        Hold the linearisation at the mean of the second half of the path, and not at its end.

    Raises
    ------
    ValueError
        If the model is linear, or the run has not determined all parameters.
    """
    whole("refine", "passes", passes, 1)
    found, moved = run, np.inf
    for _ in range(passes):
        point = found.theta[len(found) // 2 :].mean(axis=0) if drifting else found.theta[-1]
        if not np.isfinite(found.std[-1]).all():
            raise ValueError(
                "refine: the run has not determined all parameters; give a longer record, or lower orders."
            )
        model = found.program.model.held_at(point)
        if model is None:
            raise ValueError(
                f"refine: {type(run.model).__name__} is not linearised, so there is nothing to refine; it is for OE, "
                "ARMAX, BoxJenkins, PolynomialModel and ContinuousTransfer."
            )
        last = found.theta[-1]
        once = track_record(replace(run.program, model=model), run.record, start=run.start)
        found = type(run)(once.program, once.record, once._lane, once.start)
        moved = float(np.max(np.abs(found.theta[-1] - last) / found.std[-1]))
        if moved < CLOSE:
            return found
    warnings.warn(
        f"refine: after {passes} passes a parameter still moves by {moved:.2g} of its standard deviation; the orders "
        "may be too high for the record, or the run too far from the truth.",
        stacklevel=3,
    )
    return found

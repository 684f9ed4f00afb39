"""A prediction f(theta) that is not linear in theta, as a regression: the part that models of this kind share.

With the gradient at a point theta',

    phi_t = d f / d theta (theta'),     y_t - shift_t = phi_t' theta_t + v_t,     shift_t = f(theta') - phi_t' theta'

``regress`` calls `subtract` once s.phi is known, and trackers see y_t - shift_t; ``push`` calls `restore`, after which
s.y_hat is a prediction of y_t again, and s.y of a missing output is -0, so that it can be told from a reading of 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import State, kernel

MEMORY: Mapping[str, Any] = {
    "shift": 0.0, "measured": np.nan, "without": 0.0, "usable": 0.0, "started": 0.0, "last_row": np.nan,
    "moved_on": 1.0,
}  # fmt: skip
"""The shift; y_t; successive samples without an output; usable samples with a regressor unlike the one before; whether
there was a complete regressor; a sum over the last regressor, and whether it was another one."""


@kernel
def along(s: State, l: int) -> float:
    """phi' theta'"""
    total = 0.0
    for i in range(s.phi.shape[0]):
        total += s.phi[i, l] * s.point[i, l]
    return total


@kernel
def subtract(s: State, shift: float, complete: bool, l: int) -> None:
    """y - shift takes the place of y; before the first complete regressor no time passes."""
    s.shift[l] = shift
    s.measured[l] = s.y[l]
    s.y[l] -= shift
    s.started[l] = 1.0 if complete else s.started[l]
    s.dt[l] = s.dt[l] if s.started[l] > 0.0 else 0.0


@kernel
def restore(s: State, observed: bool, l: int) -> None:
    """The prediction becomes one of y, and the sample is counted.

    A plant at rest repeats its regressor, and says nothing of most parameters however long it rests: the linearisation
    must not go to an estimate that is still the prior.
    """
    s.y_hat[l] += s.shift[l]
    s.y[l] = s.y[l] if abs(s.measured[l]) < LARGEST else -0.0
    s.without[l] = 0.0 if observed else s.without[l] + 1.0
    row = 0.0
    for i in range(s.phi.shape[0]):
        row += (i + 1.0) * s.phi[i, l]
    used = s.ok[l] > 0.0
    s.moved_on[l] = 0.0 if used & ((row == s.last_row[l]) | (row == 0.0)) else 1.0
    s.last_row[l] = row if used else s.last_row[l]
    s.usable[l] += s.ok[l] * s.moved_on[l]

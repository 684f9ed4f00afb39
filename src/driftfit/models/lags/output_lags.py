"""What the models with lags share: how inputs age, when a record begins, and which value an output has as a lag.

Cost: O(n) per sample.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import State, kernel
from driftfit.models.base import GAP


@kernel
def shift_inputs(s: State, m: int, l: int) -> None:
    """Inputs become lags, which a long interval breaks; the present input is lag 0."""
    broken = s.dt[l] > GAP
    for j in range(m):
        for i in range(s.u_lag.shape[1] - 1, 0, -1):
            lag = s.u_lag[j, i - 1, l]
            s.u_lag[j, i, l] = np.nan if broken else lag
        s.u_lag[j, 0, l] = s.u[j, l]


@kernel
def wait_for_lags(s: State, l: int) -> None:
    """No time passes for the tracker until every regressor has been there once: "drop" of `ARX`."""
    before, dt, complete = s.started[l], s.dt[l], 1.0
    for i in range(s.phi.shape[0]):
        complete = complete if abs(s.phi[i, l]) < LARGEST else 0.0
    started = 1.0 if complete > 0.0 else before
    s.started[l] = started
    s.dt[l] = dt if started > 0.0 else 0.0


@kernel
def take_output(s: State, na: int, l: int) -> None:
    """The output is its first lag; where it is missing its prediction, for na samples in a row.

    A prediction of infinite variance carries no information (a diffuse start) and must not become a lag.
    """
    y, y_hat, filled, observed = s.y[l], s.y_hat[l], s.filled[l], s.observed[l] > 0.0
    known = (s.valid[l] > 0.0) & ((s.s[l] != np.inf) | (s.noise[l] == np.inf)) & (filled < na)
    fill = y_hat if known else np.nan
    s.filled[l] = 0.0 if observed else filled + 1.0
    if na > 0:
        s.y_lag[0, l] = y if observed else fill

"""Extended Kalman filter on the minimal parameters of a Hammerstein-Wiener model.

    xi_t = xi_{t-1} + w_t,  w ~ N(0, q);     0 = phi_t' g(xi_t) - z_t + v_t,  v ~ N(0, r)

    predict   P <- P + q dt d
    correct   H = phi' J(xi);  e = z - phi' g(xi);  h = H P H';  s = (1 + inflation) h + r / w;  K = P H' / s
              xi <- xi + K e;  P <- (I - K H) P (I - K H)' + (s - h) K K' = P - s K K'

with phi, z of the model and g, J of `driftfit.models.hammerstein_wiener.products`. theta of the run is xi = (a, b, c_2
.., d_2 ..), n_x numbers instead of n products, each with its own drift. inflation = 1 takes smaller steps while errors
are large.

Use it if an initial value near the truth is known, as from `hand_off`; from a distant one it can fail where stage one
cannot. It is not iterated: the iterated filter failed in 17 % of the runs of example 1 of Feng and Hong (2021). A
reading out of all proportion is refused (`driftfit.models.fault_codes`,
`driftfit.models.hammerstein_wiener.readings`). After an input left its own range a sample is not used if its error is
`CONTRADICTED` times the usual one although the reading is within the range of earlier ones: a fault code of the input,
to which the output did not respond.

Source: the implicit-measurement form of Jazwinski (1970), section 8.3; inflation and hand-off are ours. Only one
triangle of P is kept. Cost per sample: O(n_x^2 + n).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import State, kernel
from driftfit.engine.settings import matrix, vector
from driftfit.models.base import Model
from driftfit.models.fault_codes import UNJUDGED, refused
from driftfit.models.hammerstein_wiener.products import Structure
from driftfit.models.hammerstein_wiener.step_memory import LEAST_Y, MOST_Y, RAW, RESPONDING
from driftfit.models.hammerstein_wiener.trackers.minimal import Minimal, minimal_memory, structure_of
from driftfit.trackers.kalman import drift, drift_matrix
from driftfit.trackers.parts.covariance import corrected, product_with
from driftfit.trackers.parts.faults.omissions import omissions
from driftfit.trackers.parts.varying_drift import read_drift

LATELY, CONTRADICTED = 0.3, 10.0
"""Widths by which an input must have left its range, of which some are forgotten with each sample; and the multiple of
the usual error from which on a sample contradicts the response to that."""
FIRST, MEMORY = 8.0, 100.0
"""Samples from which on there is a usual error, and its memory."""


@lru_cache
def linearised(structure: Structure) -> Any:
    """A kernel that fills ``s.h_row`` = phi' J(xi) and returns phi' g(xi)."""
    alone, pairs = structure.alone, structure.pairs
    lone, paired = len(alone), len(pairs)

    @kernel
    def row(s: State, l: int) -> float:
        for x in range(s.theta.shape[0]):
            s.h_row[x, l] = 0.0
        total = 0.0
        for k in range(lone):
            i, x = alone[k, 0], alone[k, 1]
            s.h_row[x, l] = s.phi[i, l]
            total += s.phi[i, l] * s.theta[x, l]
        for k in range(paired):
            i, x, z = pairs[k, 0], pairs[k, 1], pairs[k, 2]
            part = s.phi[i, l] * s.theta[z, l]
            s.h_row[x, l] += part
            s.h_row[z, l] += s.phi[i, l] * s.theta[x, l]
            total += part * s.theta[x, l]
        return total

    return row


@kernel
def slope(s: State, i: int, l: int) -> float:
    """Entry i of H."""
    return s.h_row[i, l]  # type: ignore[no-any-return]


spread_of = product_with(slope)
"""s.g = P H'; returns H P H'."""


@kernel
def leave_out_unmoved(s: State, e: float, l: int) -> None:
    """Leave out a sample after an input left its range, if the output did not respond: a fault code of the input."""
    square, y = e * e, s.blocks[RAW, l]
    unmoved = (y >= s.blocks[LEAST_Y, l]) & (y <= s.blocks[MOST_Y, l]) & (s.blocks[RESPONDING, l] > LATELY)
    left = unmoved & (square > CONTRADICTED * CONTRADICTED * s.usual_square[l]) & (s.squares[l] >= FIRST)
    used = s.ok[l] if not left else 0.0
    s.squares[l] += used
    s.usual_square[l] += used * (square - s.usual_square[l]) / min(max(s.squares[l], 1.0), MEMORY)
    s.inputs_out[l] += s.ok[l] - used
    s.ok[l] = used


@lru_cache
def _steps(structure: Structure, together: bool) -> TrackerSteps:
    row = linearised(structure)

    @kernel
    def correct(s: State, l: int) -> None:
        y_hat = row(s, l)
        if s.observed[l] > 0.0 and refused(s, y_hat, l):
            s.ok[l], s.observed[l] = 0.0, 0.0
        leave_out_unmoved(s, s.y[l] - y_hat, l)
        h = spread_of(s, l)
        corrected(s, y_hat, (1.0 + s.inflation[l]) * h + s.r[l] * s.noise[l], l)

    return TrackerSteps(drift_matrix if together else drift, correct, read_extra=read_drift)


@dataclass(frozen=True)
class ExtendedKalman(Minimal):
    """Extended Kalman filter on the minimal parameters of a `HammersteinWiener` model.

    Parameters
    ----------
    q : number, (n_x,), or (n_x, n_x)
        Drift covariance of xi per nominal sample. A number is that number times the identity.
    r : number
        Variance of the equation error; with ``output_noise`` in the model, a factor of its variance: 1.
    p0 : number, (n_x,) or (n_x, n_x)
        Covariance of xi before the first sample.
    theta0 : number or (n_x,)
        Its mean.
    inflation : number
        0 is the extended Kalman filter; 1 takes half-steps while the spread of H xi is all the uncertainty.

    Raises
    ------
    ValueError
        If q or p0 is not a covariance, r is not positive, or (when it runs) the model is no `HammersteinWiener`.
    """

    q: Any = None
    r: float | None = None
    p0: Any = 1.0
    theta0: Any = 0.01
    inflation: float = 0.0

    drift_per_parameter: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._check("inflation")

    def state(self, n: int) -> Mapping[str, Any]:
        """The state for n minimal parameters."""
        together = np.ndim(self.q) == 2
        return {
            "theta": vector("ExtendedKalman", "theta0", self.theta0, n),
            "P": matrix("ExtendedKalman", "p0", self.p0, n),
            "q": (matrix if together else vector)("ExtendedKalman", "q", self.q, n),
            "r": self.r,
            "inflation": self.inflation,
            "g": np.zeros(n),
            "drift_root": np.ones(n),
            "h_row": np.zeros(n),
            "var": np.zeros(n),
            "usual_square": 0.0,
            "squares": 0.0,
            "inputs_out": 0.0,
            **UNJUDGED,
        }

    def remarks(self, run: Any) -> tuple[tuple[str, str], ...]:
        return omissions(run.state)

    def state_for(self, model: Model) -> Mapping[str, Any]:
        structure = structure_of("ExtendedKalman", model)
        return {**self.state(structure.n_x), "blocks": minimal_memory(model)}

    def steps_for(self, model: Model) -> TrackerSteps:
        return _steps(structure_of("ExtendedKalman", model), np.ndim(self.q) == 2)

"""Extended Kalman filter on the minimal parameters of a Hammerstein-Wiener model.

    xi_t = xi_{t-1} + w_t,  w ~ N(0, q);     0 = phi_t' g(xi_t) - z_t + v_t,  v ~ N(0, r)

    predict   P <- P + q dt d
    correct   H = phi' J(xi);  e = z - phi' g(xi);  h = H P H';  s = (1 + inflation) h + r / w;  K = P H' / s
              xi <- xi + K e;  P <- (I - K H) P (I - K H)' + (s - h) K K' = P - s K K'

with phi, z of the model and g, J of `driftfit.models.hammerstein_wiener.products`. theta of the run is xi = (a, b, c_2
.., d_2 ..), n_x numbers instead of n products, each with its own drift. inflation = 1 takes smaller steps while errors
are large.

Use it if an initial value near the truth is known, as from `hand_off`; from a distant one it can fail where stage one
cannot. It is not iterated: the iterated filter failed in 17 % of the runs of example 1 of Feng and Hong (2021).

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
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.settings import covariance, matrix, numbers, vector
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.curves.basis import PiecewiseLinear
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.products import Structure
from driftfit.models.hammerstein_wiener.step_memory import MINIMAL
from driftfit.trackers.base import Tracker
from driftfit.trackers.kalman import drift, drift_matrix
from driftfit.trackers.parts.diffuse import LEFT, product_with
from driftfit.trackers.parts.varying_drift import told


def structure_of(owner: str, model: Model) -> Structure:
    """The structure of a Hammerstein-Wiener model; ValueError for any other model, and if xi is ambiguous."""
    if not isinstance(model, HammersteinWiener):
        raise ValueError(
            f"{owner}: works on the minimal parameters of a HammersteinWiener model; got {type(model).__name__}."
        )
    structure = model.structure
    if structure.n == structure.n_x and structure.names != structure.minimal_names:
        raise ValueError(
            f"{owner}: with na = {structure.na} and nb = {structure.nb} there are as many products as minimal "
            "parameters, so the two cannot be distinguished; track the products with Kalman and separate them."
        )
    return structure


def minimal_memory(model: Model) -> Array:
    """The memory of the model with the mark that theta is xi."""
    blocks = np.array(model.memory()["blocks"])
    blocks[MINIMAL] = 1.0
    return blocks


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


@lru_cache
def _steps(structure: Structure, together: bool) -> TrackerSteps:
    row = linearised(structure)

    @kernel
    def correct(s: State, l: int) -> None:
        y_hat = row(s, l)
        h = spread_of(s, l)
        v = (1.0 + s.inflation[l]) * h + s.r[l] * s.noise[l]
        e = s.y[l] - y_hat
        gain = s.ok[l] / v
        for i in range(s.theta.shape[0]):
            k = gain * s.g[i, l]
            s.theta[i, l] += k * e
            for j in range(i):
                s.P[i, j, l] -= k * s.g[j, l]
            s.P[i, i, l] = max(s.P[i, i, l] - k * s.g[i, l], LEFT * s.P[i, i, l])
        s.y_hat[l] = y_hat
        s.e[l] = e
        s.s[l] = v

    return TrackerSteps(drift_matrix if together else drift, correct, told=told)


@dataclass(frozen=True)
class ExtendedKalman(Tracker):
    """Extended Kalman filter on the minimal parameters of a `HammersteinWiener` model.

    Parameters
    ----------
    q : number, (n_x,), or (n_x, n_x)
        Drift covariance of xi per nominal sample. A number is that number times the identity.
    r : number
        Variance of the equation error; with ``output_noise`` in the model, a factor of what that gives: 1.
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

    required: ClassVar[tuple[str, ...]] = ("q", "r")
    replaces: ClassVar[tuple[str, ...]] = ("blocks",)
    drift_each: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.q is not None:
            self._set("q", covariance("ExtendedKalman", "q", self.q))
        if self.r is not None:
            self._set("r", numbers("ExtendedKalman", "r", self.r, ndim=0, low=0.0, strict=True))
        self._set("p0", covariance("ExtendedKalman", "p0", self.p0))
        self._set("theta0", numbers("ExtendedKalman", "theta0", self.theta0))
        self._set("inflation", numbers("ExtendedKalman", "inflation", self.inflation, ndim=0, low=0.0))

    @classmethod
    def own_model(cls, na: int, nb: int, nk: int) -> HammersteinWiener:
        """With a bend in the input block, whose c_2 is 0 on linear records, where there are lags to tell it from b."""
        return HammersteinWiener(na, nb, nk, input=PiecewiseLinear([0.0]) if nb > 1 else None)

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
            "each": np.ones(n),
            "h_row": np.zeros(n),
            "var": np.zeros(n),
        }

    @property
    def steps(self) -> TrackerSteps:
        raise ValueError("ExtendedKalman: the steps depend on the model; see steps_for.")

    def state_for(self, model: Model) -> Mapping[str, Any]:
        structure = structure_of("ExtendedKalman", model)
        return {**self.state(structure.n_x), "blocks": minimal_memory(model)}

    def steps_for(self, model: Model) -> TrackerSteps:
        return _steps(structure_of("ExtendedKalman", model), np.ndim(self.q) == 2)

    def names_for(self, model: Model) -> tuple[str, ...]:
        return structure_of("ExtendedKalman", model).minimal_names

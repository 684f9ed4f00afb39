"""Extended Kalman filter on the minimal parameters of a Hammerstein-Wiener model.

    xi_t = xi_{t-1} + w_t,  w ~ N(0, q);     0 = phi_t' g(xi_t) - z_t + v_t,  v ~ N(0, r)

    predict   P <- P + q dt d
    forecast  H = phi' J(xi);  e = z - phi' g(xi);  h = (1 + inflation) H P H';  s = h + r / w;  K = P H' / s
    correct   xi <- xi + K e;  P <- P - s K K'

with phi, z of the model and g, J of `driftfit.models.hammerstein_wiener.structure`. theta of the run is xi = (a, b, c_2
.., d_2 ..), n_x numbers instead of n products, each with its own drift. inflation = 1 takes smaller steps while errors
are large.

Use it if an initial value near the truth is known, as from the separation of stage one; from a distant one it can fail
where stage one cannot. It is not iterated: the iterated filter failed in 17 % of the runs of example 1 of Feng and Hong
(2021).

Source: the implicit-measurement form of Jazwinski (1970), section 8.3; the inflation is ours. Only one triangle of P is
kept. Cost per sample: O(n_x^2 + n).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import State, kernel
from driftfit.engine.settings import check_numbers, matrix, numbers, vector
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.basis import PiecewiseLinear
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.structure import Structure, positions
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.covariance import correct, product_with, read_drift
from driftfit.trackers.kalman import drift, drift_matrix


def structure_of(owner: str, model: Model) -> Structure:
    """The structure of a Hammerstein-Wiener model; ValueError for any other model, and if xi is ambiguous."""
    if not isinstance(model, HammersteinWiener):
        raise ValueError(
            f"{owner}: works on the minimal parameters of a HammersteinWiener model; got {type(model).__name__}."
        )
    structure = model.structure
    if structure.n == structure.n_x and structure.names != structure.minimal_names and structure.n_out > 1:
        raise ValueError(
            f"{owner}: without lags of y, and with nb = {structure.nb}, there are as many products as minimal "
            "parameters, so where those of the output block are is not known; track the products with Kalman and "
            "separate them."
        )
    return structure


class Minimal(Tracker):
    """A tracker whose theta is xi, the minimal parameters of a `HammersteinWiener` model."""

    q: Any
    r: float | None
    p0: Any
    theta0: Any

    required: ClassVar[tuple[str, ...]] = ("q", "r")
    replaces: ClassVar[tuple[str, ...]] = ("minimal",)

    def _check(self, *variances: str) -> None:
        """Check the settings that both have, and those named, which are nonnegative numbers."""
        owner = type(self).__name__
        check_numbers(self, ("q", "p0"), ("r",), ("theta0",))
        for name in variances:
            self._set(name, numbers(owner, name, getattr(self, name), ndim=0, low=0.0))

    @classmethod
    def own_model(cls, na: int, nb: int, nk: int) -> HammersteinWiener:
        """A model with a bend in the input block, if there are lags that distinguish c_2 from b; on linear records c_2
        is 0.
        """
        return HammersteinWiener(na, nb, nk, input=PiecewiseLinear([0.0]) if nb > 1 else None)

    def _of_parameters(self, n: int) -> dict[str, Any]:
        """The fields that depend only on the number n of minimal parameters."""
        owner, of_q = type(self).__name__, matrix if np.ndim(self.q) == 2 else vector
        return {
            "theta": vector(owner, "theta0", self.theta0, n), "P": matrix(owner, "p0", self.p0, n),
            "q": of_q(owner, "q", self.q, n), "r": self.r, "var": np.zeros(n), "minimal": 1.0,
        }  # fmt: skip

    @property
    def steps(self) -> TrackerSteps:
        raise ValueError(f"{type(self).__name__}: the steps depend on the model; see steps_for.")

    def names_for(self, model: Model) -> tuple[str, ...]:
        return structure_of(type(self).__name__, model).minimal_names


@lru_cache
def linearised(structure: Structure) -> Any:
    """A kernel that fills ``s.h_row`` = phi' J(xi) and returns phi' g(xi)."""
    alone, pairs = (np.ascontiguousarray(one.T) for one in positions(structure, False))
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
    def forecast(s: State, l: int) -> None:
        y_hat = row(s, l)
        s.y_hat[l], s.e[l] = y_hat, s.y[l] - y_hat
        s.h[l] = (1.0 + s.inflation[l]) * max(spread_of(s, l), 0.0)

    return TrackerSteps(drift_matrix if together else drift, forecast, correct, read_extra=read_drift)


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
        more = {"g": np.zeros(n), "drift_root": np.ones(n), "h_row": np.zeros(n)}
        return {**self._of_parameters(n), **more, "inflation": self.inflation}

    def state_for(self, model: Model) -> Mapping[str, Any]:
        return self.state(structure_of("ExtendedKalman", model).n_x)

    def steps_for(self, model: Model) -> TrackerSteps:
        return _steps(structure_of("ExtendedKalman", model), np.ndim(self.q) == 2)

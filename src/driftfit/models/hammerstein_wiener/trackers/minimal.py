"""The common part of the trackers of minimal parameters xi: their model, its structure, and their settings."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array
from driftfit.engine.settings import covariance, numbers
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.curves.basis import PiecewiseLinear
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.products import Structure
from driftfit.models.hammerstein_wiener.step_memory import MINIMAL
from driftfit.trackers.base import Tracker


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


def minimal_memory(model: Model) -> Array:
    """The memory of the model with the mark that theta is xi."""
    blocks = np.array(model.memory()["blocks"])
    blocks[MINIMAL] = 1.0
    return blocks


class Minimal(Tracker):
    """A tracker whose theta is xi, the minimal parameters of a `HammersteinWiener` model."""

    q: Any
    r: float | None
    p0: Any
    theta0: Any

    required: ClassVar[tuple[str, ...]] = ("q", "r")
    replaces: ClassVar[tuple[str, ...]] = ("blocks",)

    def _check(self, *variances: str) -> None:
        """Check the settings that both have, and those named, which are nonnegative numbers."""
        owner = type(self).__name__
        if self.q is not None:
            self._set("q", covariance(owner, "q", self.q))
        if self.r is not None:
            self._set("r", numbers(owner, "r", self.r, ndim=0, low=0.0, strict=True))
        self._set("p0", covariance(owner, "p0", self.p0))
        self._set("theta0", numbers(owner, "theta0", self.theta0))
        for name in variances:
            self._set(name, numbers(owner, name, getattr(self, name), ndim=0, low=0.0))

    @classmethod
    def own_model(cls, na: int, nb: int, nk: int) -> HammersteinWiener:
        """A model with a bend in the input block, if there are lags that distinguish c_2 from b; on linear records c_2
        is 0.
        """
        return HammersteinWiener(na, nb, nk, input=PiecewiseLinear([0.0]) if nb > 1 else None)

    @property
    def steps(self) -> TrackerSteps:
        raise ValueError(f"{type(self).__name__}: the steps depend on the model; see steps_for.")

    def names_for(self, model: Model) -> tuple[str, ...]:
        return structure_of(type(self).__name__, model).minimal_names

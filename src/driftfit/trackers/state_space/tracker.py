"""The common part of the trackers of parameters and hidden states: their model, and their settings."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array
from driftfit.engine.settings import check_numbers, covariance, matrix, near, numbers, vector
from driftfit.models.base import Model
from driftfit.models.state_space import StateSpace
from driftfit.trackers.base import Tracker


class StateSpaceTracker(Tracker):
    """A tracker whose theta is the parameters and hidden states of a `StateSpace` model."""

    q: Any
    r: float | None
    p0: Any
    theta0: Any

    required: ClassVar[tuple[str, ...]] = ("q", "r", "p0")
    drift_per_parameter: ClassVar[bool] = True
    follows_states: ClassVar[bool] = True

    @property
    def beyond(self) -> str:
        return "moves hidden states"

    def _check(self) -> None:
        """Check the settings that all have."""
        owner = type(self).__name__
        for name in ("q", "p0"):
            self._set(name, _named_variances(owner, name, getattr(self, name)))
        check_numbers(self, (), ("r",), ("theta0",))

    @classmethod
    def own_model(cls, na: int, nb: int, nk: int) -> Model | None:
        terms = [f"theta.a{i + 1} * (-y[-{i + 1}])" for i in range(na)]
        terms += [f"theta.b{i + 1} * " + (f"u[-{nk + i}]" if nk + i else "u") for i in range(nb)]
        return StateSpace(f"y = {' + '.join(terms)}", start=0.0)

    def state(self, n: int) -> Mapping[str, Any]:
        raise ValueError(f"{type(self).__name__} follows a StateSpace model.")

    @property
    def steps(self) -> TrackerSteps:
        raise ValueError(f"{type(self).__name__} follows a StateSpace model.")

    def state_for(self, model: Model) -> Mapping[str, Any]:
        owner, system, n = type(self).__name__, self._system(model), model.n
        p0 = matrix(owner, "p0", _variances_of(owner, "p0", self.p0, model), n)
        theta = system.begins if self.theta0 is None else vector(owner, "theta0", self.theta0, n)
        return self.state_of(system, {"theta": theta, "P": p0, "q": self.drift_of(system), "r": self.r})

    def steps_for(self, model: Model) -> TrackerSteps:
        return self.steps_of(self._system(model))

    def drift_of(self, model: StateSpace) -> Array:
        """q as a matrix (n, n)."""
        owner = type(self).__name__
        return matrix(owner, "q", _variances_of(owner, "q", self.q, model), model.n)

    @abstractmethod
    def state_of(self, model: StateSpace, prior: Mapping[str, Any]) -> Mapping[str, Any]:
        """The state, which begins with ``prior``: theta, P, q and r."""

    @abstractmethod
    def steps_of(self, model: StateSpace) -> TrackerSteps:
        """The compiled steps."""

    def _system(self, model: Model) -> StateSpace:
        if not isinstance(model, StateSpace):
            raise ValueError(f"{type(self).__name__} follows a StateSpace model; got {type(model).__name__}.")
        return model


def _named_variances(owner: str, name: str, given: Any) -> Any:
    """A covariance as a setting: numbers, or pairs of a name and a variance."""
    if isinstance(given, Mapping) or _pairs(given):
        return tuple((key, numbers(owner, name, one, ndim=0, low=0.0)) for key, one in dict(given).items())
    return None if given is None else covariance(owner, name, given)


def _variances_of(owner: str, name: str, given: Any, model: Model) -> Any:
    """Such a setting for a model: pairs become variances (n,), 0 for names that are not among them."""
    if not _pairs(given):
        return given
    for key, _ in given:
        if key not in model.names:
            raise ValueError(f"{owner}: {name} names {key!r}; {near(key, model.names)}")
    return np.asarray(np.array([dict(given).get(one, 0.0) for one in model.names]))


def _pairs(given: Any) -> bool:
    """Whether it is a mapping as plain data: pairs of a name and a number."""
    return isinstance(given, tuple | list) and all(
        isinstance(one, tuple | list) and len(one) == 2 and isinstance(one[0], str) for one in given
    )

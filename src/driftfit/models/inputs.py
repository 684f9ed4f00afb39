"""Models with inputs: how many there are, their names, and settings that may differ between them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self
from warnings import warn

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import input_names, numbers, whole
from driftfit.models.base import Linearised, Model

TAIL, DEVIATIONS = 0.02, 2.0
"""An input is far from 0 if all but the share `TAIL` of its values are, by `DEVIATIONS` times their usual deviation
from their median."""


class CountedInputs(Model):
    """A model whose inputs are given as a number or as names, or are as many as u has columns.

    A subclass has the setting `inputs` (or another, which `inputs_setting` names), a number, names or None, and calls
    `_check_inputs` when it is constructed.
    """

    inputs_setting: ClassVar[str] = "inputs"
    """The setting that holds the number or the names of the inputs."""
    per_input: ClassVar[tuple[str, ...]] = ()
    """Settings, such as orders and delays, that are one whole number or a sequence with one for each input."""
    fewest: ClassVar[int] = 0
    """The smallest number of inputs."""
    lowest: ClassVar[Mapping[str, int]] = {}
    """The smallest value of settings `per_input` for which it is not 0."""

    @property
    def _given(self) -> int | tuple[str, ...] | None:
        found: int | tuple[str, ...] | None = getattr(self, self.inputs_setting)
        return found

    def _check_inputs(self) -> None:
        """Normalise the inputs and the settings `per_input`; sequences among these determine how many inputs there are.

        Raises
        ------
        ValueError
            If one of these settings is not what it has to be, or they imply different numbers of inputs.
        """
        kind, setting, given = type(self).__name__, self.inputs_setting, getattr(self, self.inputs_setting)
        counts = {count for name in self.per_input if (count := self._check_per_input(name)) is not None}
        if isinstance(given, int | np.integer):
            self._set(setting, whole(kind, setting, given, self.fewest))
        elif given is not None:
            self._set(setting, input_names(kind, setting, (given,) if isinstance(given, str) else given))
        elif len(counts) == 1:
            self._set(setting, whole(kind, setting, next(iter(counts)), self.fewest))
        elif not counts and getattr(self, "nb", None) == 0:
            self._set(setting, 0)
        if len(counts | (set() if self._given is None else {self.m})) > 1:
            raise ValueError(f"{kind}: {self._numbers_of_inputs} imply different numbers of inputs.")

    def _check_per_input(self, name: str) -> int | None:
        """Normalise a setting that may have an entry for each input; returns how many it has."""
        kind, value, lowest = type(self).__name__, getattr(self, name), self.lowest.get(name, 0)
        if not isinstance(value, Sequence | np.ndarray):
            self._set(name, whole(kind, name, value, lowest))
            return None
        entries = (int(one) if isinstance(one, float) and one.is_integer() else one for one in value)
        self._set(name, tuple(whole(kind, name, one, lowest) for one in entries))
        return len(value)

    @property
    def _numbers_of_inputs(self) -> str:
        """The settings that say how many inputs there are, for messages."""
        last = f"{self.inputs_setting}={getattr(self, self.inputs_setting)!r}"
        others = ", ".join(f"{name}={getattr(self, name)!r}" for name in self.per_input)
        return f"{others} and {last}" if others else last

    def bind(self, inputs: int | Sequence[str]) -> Self:
        kind, setting, given = type(self).__name__, self.inputs_setting, self._given
        count = inputs if isinstance(inputs, int) else len(inputs)
        if given is None and count < (1 if self.per_input else self.fewest):
            without = ", or nb=0" if "nb" in self.per_input and "nb" not in self.lowest else ""
            raise ValueError(
                f"{kind}: a model with {self._numbers_of_inputs} needs at least 1 input, but there is no u; give "
                f"u{without}."
            )
        if given is not None and count != self.m:
            raise ValueError(
                f"{kind}: the model has {self.m} {setting} ({self._numbers_of_inputs}), but u has {count} columns."
            )
        if given is not None and (isinstance(inputs, int) or not isinstance(given, int)):
            return self
        bound = {setting: inputs if isinstance(inputs, int) else tuple(inputs)}
        return replace(self, **bound)  # type: ignore[type-var]

    @property
    def m(self) -> int:
        """Number of inputs, columns of u; 1 as long as it is not known."""
        return 1 if self._given is None else self._given if isinstance(self._given, int) else len(self._given)

    @property
    def input_names(self) -> tuple[str, ...]:
        return self._given if isinstance(self._given, tuple) else ()

    @property
    def suffixes(self) -> tuple[str, ...]:
        """What the names of its parameters end with, for every input: "[pump]", "[u2]"; "" if there is only one."""
        if self.input_names:
            return tuple(f"[{name}]" for name in self.input_names)
        return tuple(f"[u{j + 1}]" for j in range(self.m)) if self.m > 1 else ("",) * self.m

    def for_each_input(self, setting: str) -> tuple[Any, ...]:
        """A setting `per_input`, with an entry for every input."""
        value = getattr(self, setting)
        return value if isinstance(value, tuple) else (value,) * self.m


class LinearisedTransfer(CountedInputs, Linearised):
    """A transfer function whose regressors depend on theta; ``point`` holds them at one theta."""

    point: tuple[float, ...] | None
    constant = "offset"

    def _check_point(self) -> None:
        if self.point is None:
            return
        kind = type(self).__name__
        self._set("point", numbers(kind, "point", self.point, ndim=1))
        if self._given is not None and np.size(self.point) != self.n:
            raise ValueError(f"{kind}: point must have {self.n} entries, {', '.join(self.names)}; got {self.point!r}.")

    @property
    def linearised(self) -> Linearised:
        return self

    @property
    def simulated(self) -> tuple[bool, ...]:
        """Which inputs have a response that is simulated with theta."""
        return (True,) * self.m

    def inspect(self, y: Array, u: Array) -> None:
        """Warn of inputs far from 0 beside what they vary by: the simulated response to their mean bends with theta."""
        named = zip(self.input_names or self.suffixes, u.T, self.simulated, strict=True)
        for name, values in ((name, values) for name, values, far in named if far and self.point is None):
            known = values[np.abs(values) < LARGEST]
            low, middle, high = np.quantile(known, (TAIL, 0.5, 1.0 - TAIL)) if len(known) else (0.0, 0.0, 0.0)
            spread = float(np.median(np.abs(known - middle))) / 0.6745 if len(known) else 0.0
            if max(low, -high) > DEVIATIONS * spread > 0.0:
                warn(
                    f"{type(self).__name__}: {name.strip('[]') or 'u'} varies by {spread:.3g} about {middle:.4g}, and "
                    "the simulated response to a mean far from 0 spoils the estimates, also with an offset. Subtract "
                    "an operating point from the inputs and from the output.",
                    UserWarning,
                    stacklevel=2,
                )

    def held_at(self, theta: Array) -> Self:
        return replace(self, point=tuple(np.asarray(theta, dtype=float).tolist()))  # type: ignore[type-var]


class NamedInputs(Model):
    """A model of equations, which name its inputs; the setting ``inputs`` gives their order, unless it is None.

    ``start`` holds parameters and states before the first sample: one number for all, or (name, number) pairs.
    """

    inputs: Any
    start: Any

    @property
    @abstractmethod
    def remembers_outputs(self) -> bool:
        """Whether the equations use lags of the output."""

    @property
    def begins(self) -> Array:
        """``start`` as an array (n,), with 1 for parameters that are not named and 0 for states."""
        if not isinstance(self.start, tuple):
            return np.full(self.n, float(self.start))
        given = dict(self.start)
        return np.array([given.get(name, float(name not in (self.hidden or ()))) for name in self.names])

    def noise_response(self, theta: Array, h: int) -> Array:
        """1, then 0 without lags of the output; with them it depends on the operating point and is NaN."""
        response: Array = np.eye(1, h)[0]
        response[1:] = np.nan if self.remembers_outputs else 0.0
        return response

    def _check_inputs(self, used: Sequence[str]) -> None:
        """Take the inputs that the equations use, or check that the given ones contain them."""
        kind = type(self).__name__
        self._set("inputs", tuple(used) if self.inputs is None else input_names(kind, "inputs", self.inputs))
        if absent := [name for name in used if name not in self.input_names]:
            raise ValueError(f"{kind}: inputs must hold {', '.join(absent)}, which the equations use.")

    def bind(self, inputs: int | Sequence[str]) -> Self:
        count = inputs if isinstance(inputs, int) else len(inputs)
        if count != self.m:
            names = ", ".join(self.input_names)
            raise ValueError(f"{type(self).__name__}: {self.m} inputs ({names}), but u has {count} columns.")
        return self

    @property
    def m(self) -> int:
        return len(self.input_names)

    @property
    def input_names(self) -> tuple[str, ...]:
        return self.inputs or ()

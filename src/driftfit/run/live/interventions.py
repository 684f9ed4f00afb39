"""Interventions of an operator in a stream; `driftfit.run.live.live.Live` inherits it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import near, numbers, vector
from driftfit.run.live.fixed_lag import Window
from driftfit.run.program import Program

KNOWN = ("interval", "noise", "drift")
ORDINARY, HELD = (1.0, 1.0, 1.0), (0.0, np.inf, 1.0)
"""The known factors of a sample: the default, and those while the stream is held."""


class Operated(ABC):
    """Interventions of an operator: holding a stream, and resetting parameters."""

    programs: tuple[Program, ...]
    _state_tile: Callable[[], Array]
    _windows: list[Window]

    @abstractmethod
    def lane(self, lane: int = 0) -> dict[str, Array]:
        """The fields of the record, or of that of one of several outputs, as views."""

    def hold(self, on: bool = True) -> None:
        """Stop learning, or with ``hold(False)`` resume: for work on the plant, a test, or while a sensor is cleaned.

        While held, samples enter the lags and are predicted, but are not used (``ok`` is False), and no time passes
        for the parameters and their covariance. Being held is part of the state that `save` writes.
        """
        self._rest(HELD if on else ORDINARY)

    @property
    def held(self) -> bool:
        """Whether `hold` is on."""
        return bool(self._state_tile()["noise"][0, 0] == np.inf)

    @property
    def resting(self) -> tuple[float, float, float]:
        """Interval, noise and drift of a sample that gives none."""
        return HELD if self.held else ORDINARY

    def reset(self, which: str | int | Sequence[str | int] | None = None, p: Any = None, theta: Any = None) -> None:
        """Pass an operator's knowledge to the tracker: these parameters may have changed, or have new values.

        Parameters
        ----------
        which : name, index, several of them, or None
            The parameters; None is all. Indices count the parameters of all outputs, one output after the other.
        p : number or one per parameter
            Variance of the change, in squared units of theta; it is added to the present variance. After maintenance
            a large value lets the next samples decide.
        theta : number or one per parameter
            Their new values, if they are known.

        Raises
        ------
        ValueError
            For an unknown parameter, a negative or infinite p, or a tracker without a covariance to widen.
        """
        chosen = self._chosen(which)
        if p is None and theta is None:
            raise ValueError("Live.reset: give p= (the variance of their possible change), theta=, or both.")
        if self._windows:
            raise ValueError(
                "Live.reset: smoothing with lag= does not support resets; use a second stream without lag=."
            )
        count = len(chosen)
        if p is not None:
            moved = vector("Live.reset", "p", numbers("Live.reset", "p", p, low=0.0), count)
        if theta is not None:
            values = vector("Live.reset", "theta", numbers("Live.reset", "theta", theta), count)
        for number, program in enumerate(self.programs):
            places = [k for k, (lane, _) in enumerate(chosen) if lane == number]
            own = [chosen[k][1] for k in places]
            if own and p is not None:
                added = np.zeros(len(program.names))
                added[own] = moved[places]
                program.tracker.widen(self.lane(number), added)
            if own and theta is not None:
                program.tracker.place(self.lane(number), own, values[places])

    def _chosen(self, which: Any) -> list[tuple[int, int]]:
        """(output, index) of parameters."""
        named = [(lane, i, name) for lane, one in enumerate(self.programs) for i, name in enumerate(one.names)]
        if which is None:
            return [(lane, i) for lane, i, _ in named]
        chosen = []
        for one in [which] if isinstance(which, str | int) else which:
            found = [(lane, i) for k, (lane, i, name) in enumerate(named) if one in (name, k)]
            if not found:
                raise ValueError(f"Live.reset: no parameter {one!r}; {near(str(one), [name for *_, name in named])}")
            chosen.append(found[0])
        return chosen

    def _rest(self, known: tuple[float, float, float]) -> None:
        """Set the known factors of every sample that gives none."""
        for name, value in zip(KNOWN, known, strict=True):
            self._state_tile()[name] = value

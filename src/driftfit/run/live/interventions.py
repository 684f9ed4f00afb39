"""Interventions of an operator in a stream; `driftfit.run.live.live.Live` inherits it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import near, numbers, vector
from driftfit.run.live.fixed_lag import Window
from driftfit.trackers.base import Tracker

KNOWN = ("interval", "noise", "drift")
ORDINARY, HELD = (1.0, 1.0, 1.0), (0.0, np.inf, 1.0)
"""Known factors of a sample by default, and of one while the stream is held."""


class Operated(ABC):
    """The operator's hand on a stream: a hold, resets."""

    tracker: Tracker
    _tile: Array
    _windows: list[Window]

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""

    @abstractmethod
    def lane(self) -> dict[str, Array]:
        """The fields of the record, as views."""

    def hold(self, on: bool = True) -> None:
        """Stop learning, or with ``hold(False)`` resume: for work on the plant, a test, a sensor being cleaned.

        While held, samples enter the lags and are predicted, but are not used (``ok`` is False), and no time passes
        for the parameters and their covariance. Being held is part of the state that `save` writes.
        """
        self._rest(HELD if on else ORDINARY)

    @property
    def held(self) -> bool:
        """Whether `hold` is on."""
        return bool(self._tile["noise"][0, 0] == np.inf)

    def reset(self, which: str | int | Sequence[str | int] | None = None, p: Any = None, theta: Any = None) -> None:
        """Pass an operator's knowledge to the tracker: these parameters may have changed, or have new values.

        Parameters
        ----------
        which : name, index, several of them, or None
            The parameters; None is all.
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
                "Live.reset: smoothing with lag= does not support resets; keep a second stream without lag=."
            )
        count = len(chosen)
        if p is not None:
            moved = np.zeros(len(self.names))
            moved[chosen] = vector("Live.reset", "p", numbers("Live.reset", "p", p, low=0.0), count)
            self.tracker.widen(self.lane(), moved)
        if theta is not None:
            values = vector("Live.reset", "theta", numbers("Live.reset", "theta", theta), count)
            self.tracker.place(self.lane(), chosen, values)

    def _chosen(self, which: Any) -> list[int]:
        """Indices of parameters."""
        if which is None:
            return list(range(len(self.names)))
        chosen = []
        for one in [which] if isinstance(which, str | int) else which:
            if one not in self.names and not (isinstance(one, int) and 0 <= one < len(self.names)):
                raise ValueError(f"Live.reset: no parameter {one!r}; {near(str(one), self.names)}")
            chosen.append(one if isinstance(one, int) else self.names.index(one))
        return chosen

    def _rest(self, known: tuple[float, float, float]) -> None:
        """Set the known factors of every sample that gives none."""
        for name, value in zip(KNOWN, known, strict=True):
            self._tile[name] = value

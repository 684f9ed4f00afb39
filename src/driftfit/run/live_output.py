"""One output of a stream with several outputs: its present estimates."""

from __future__ import annotations

from typing import Any

from driftfit.engine.kernel import Array
from driftfit.run.program import Program


class LiveOutput:
    """A view of a stream, ``live["level"]``: it always shows the state after the last update.

    ``output`` is the name of the output, ``names`` are those of its parameters.
    """

    def __init__(self, stream: Any, lane: int) -> None:
        self._stream, self._lane = stream, lane
        self.output: str = stream.model.outputs[lane]

    def __repr__(self) -> str:
        return f"{self.output} of {self._stream!r}"

    @property
    def program(self) -> Program:
        """Its model and tracker."""
        found: Program = self._stream.programs[self._lane]
        return found

    @property
    def tracker(self) -> Any:
        """Its tracker."""
        return self.program.tracker

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its parameters."""
        return self.program.names

    @property
    def theta(self) -> Array:
        """Parameters now, (n,)."""
        found: Array = self._stream.theta[self._lane]
        return found

    @property
    def std(self) -> Array:
        """Their standard deviations (n,): inf for parameters that are not determined yet, NaN without a covariance."""
        found: Array = self._stream.std[self._lane]
        return found

    @property
    def cov(self) -> Array:
        """Their covariance, (n, n)."""
        found: Array = self._stream.cov[self._lane]
        return found

    @property
    def learning(self) -> Array:
        """Which of them are being learned now, (n,) bool."""
        found: Array = self._stream.learning[self._lane]
        return found

    @property
    def alarm(self) -> Any:
        """The alarm that watches this output, or None."""
        return self._stream.alarms.get(self.output)

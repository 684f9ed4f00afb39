"""The system behind a stream, now: poles, gains and responses with bands, as `Track` has them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.use import system
from driftfit.use.system import FrequencyResponse, LongRun, Response

if TYPE_CHECKING:
    from driftfit.run.live.live import Live


class LiveSystem:
    """The frozen system after the last sample of a stream; `Live.system` makes it.

    The methods are those of `Track` for one sample, without the time axis.
    """

    def __init__(self, live: Live) -> None:
        self.model, self.tracker, self.names = live.model, live.tracker, live.names
        self.theta = live.theta[None]
        self._cov = live.cov
        system.linear(self)

    def __len__(self) -> int:
        return 1

    def cov(self, t: int) -> Array:
        """Covariance of theta, (n, n)."""
        return self._cov

    def covariances(self) -> Array:
        """The same with a time axis, (1, n, n)."""
        return self._cov[None]

    def poles(self) -> Array:
        """Poles, (na,) complex, the largest first."""
        poles: Array = system.poles(self)[0]
        return poles

    def largest_pole(self) -> Response:
        """Magnitude of the largest pole, with its standard deviation; below 1 the system is stable."""
        return _now(system.largest_pole(self, -1))

    def dc_gain(self) -> Response:
        """Gain of every input for a constant signal, (m,), with its standard deviation."""
        return _now(system.dc_gain(self, -1))

    def step_response(self, h: int, input: int | str = 0) -> Response:
        """Response (h,) to a unit step of one input."""
        return _now(system.step_response(self, h, input))

    def impulse_response(self, h: int, input: int | str = 0) -> Response:
        """Response (h,) to a unit impulse of one input."""
        return _now(system.impulse_response(self, h, input))

    def frequency_response(self, w: Any = None, input: int | str = 0) -> FrequencyResponse:
        """Magnitude and phase at w (k,) radians per sample, (k,) each, with standard deviations."""
        found = system.frequency_response(self, w, input)
        return FrequencyResponse(found.w, *(np.asarray(part[0]) for part in found[1:]))

    def to_scipy(self, dt: float = 1.0, input: int | str = 0) -> Any:
        """The system from one input to y as `scipy.signal.dlti`."""
        return system.to_scipy(self, -1, dt, input)

    def long_run(self, level: float = 0.95) -> tuple[LongRun, ...]:
        """Long-run effect b / (1 - a) of every input, with standard error and Fieller's interval."""
        return system.long_run(self, -1, level)


def _now(response: Response) -> Response:
    """The response of one sample, without the time axis."""
    return Response(response.value[0], response.std[0])

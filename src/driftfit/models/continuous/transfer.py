"""Transfer functions in continuous time, from samples at any times: state-variable filters and refined estimates.

    y(t) = sum_j B_j(s) / A(s) u_j(t - delay) + (offset) + e

    A(s) = s^n + a_1 s^(n-1) + .. + a_n,      B_j(s) = b_1 s^nz + .. + b_(nz+1),   nz < n

for inputs that are held between samples. Parameters are in the unit of time of ``dt`` (seconds), also where samples are
uneven or jittered; the a_i are named A1, A2, .., since a1, a2 are coefficients of a regression, with the opposite sign.
With L = 1 / A', a filter at the point theta' of the linearisation, there is a regression for every sample without a
derivative of a measured signal,

    y - A' y_f = -sum_i a_i s^(n-i) y_f + sum_i b_i s^(nz+1-i) u_f + A y_f,      y_f = L y,  u_f = L u

The first samples have A' = (s + lambda)^n, the state-variable filter with the rate lambda (``cutoff``), which is least
squares and biased by noise. After them A' is A at the last estimate where that is stable, and

    phi = [-s^(n-i) x_f, s^(nz+1-i) u_f],     x_f = L x,  x = sum_j B_j / A u_j

is the gradient of the response x, so that every tracker is a prediction error method, `Kalman` the extended Kalman
filter for parameters that drift. With `InstrumentalVariables` phi has y_f and the instruments have x_f: refined
instrumental variables (SRIVC), which need no start near the truth. Both have x(theta') as the prediction, which is
exact for held inputs; only the slope depends on what y does between samples, for which a line is taken.

Without an offset signals are deviations from rest, where the record begins; with one it begins at rest at its first
input and output. A missing input is held, and its sample is not used; a missing output is replaced by its prediction.

The noise is taken as white at the samples. Noise that is coloured biases nothing, but bands are then too narrow.

Source: Young, Automatica 17 (1981); Young and Jakeman, Int. J. Control 31 (1980), for refined instruments; Garnier and
Wang (eds.), Identification of Continuous-time Models from Sampled Data (2008), chapters 4 and 9. Departures: numbers of
the filter in units of lambda; the prediction is that of the model and not of the regression; filters are scaled when
they change. Cost per sample: O(m n + n^2) times the steps of `driftfit.models.continuous.filters`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, whole
from driftfit.models.continuous.filters import STIFF, Orders, steps
from driftfit.models.continuous.sampling import sampled
from driftfit.models.inputs import LinearisedTransfer
from driftfit.models.linearised import MEMORY

POLE_LIMIT = 4
"""The largest number of poles."""

FORGOTTEN, TIMES = 40.0, 100.0
"""Samples for each parameter, and times 1 / lambda for each pole, that a tracker without drift should forget again. The
regressors are the gradient after 60; while the start is forgotten bands are those of a fading memory, too wide by up to
the root of two."""

PER_SAMPLE = 0.2
"""Rate of the first filter in inverse nominal samples, unless another one is given."""


@dataclass(frozen=True)
class ContinuousTransfer(LinearisedTransfer):
    """y(t) = sum_j B_j(s) / A(s) u_j(t - delay) + e, for samples at any times.

    Parameters
    ----------
    poles : int
        n, the degree of A, 1 to 4.
    zeros : int
        nz, the degree of each B, below n.
    delay : int
        Whole nominal samples between input and response, beyond the hold.
    dt : number
        Length of a nominal sample, in the unit of time of the parameters. With ``time=`` in that unit, and
        ``dt=`` of `track`, it is the same number.
    cutoff : number or None
        lambda, rate of the first filter, in radians per unit of time: somewhat above the fastest pole. None: 0.2 / dt.
    offset : bool
        Add a constant to the output, as the last parameter.
    inputs : int, names, or None
        How many inputs, or their names. None: as many as u has columns.
    point : (parameters,) or None
        Hold the filters at this theta; see `Track.refine`.

    Raises
    ------
    ValueError
        If there are not 1 to 4 poles, or as many zeros as poles; if dt or cutoff are not positive, or the delay is
        negative.
    """

    poles: int = 1
    zeros: int = 0
    delay: int = 0
    dt: float = 1.0
    cutoff: float | None = None
    offset: bool = False
    inputs: int | tuple[str, ...] | None = None
    point: tuple[float, ...] | None = None
    fewest = 1

    def __post_init__(self) -> None:
        kind = "ContinuousTransfer"
        for name, low in (("poles", 1), ("zeros", 0), ("delay", 0)):
            self._set(name, whole(kind, name, getattr(self, name), low))
        if self.poles > POLE_LIMIT or self.zeros >= self.poles:
            raise ValueError(
                f"{kind}: poles must be 1 to {POLE_LIMIT}, and zeros fewer than poles; got poles={self.poles!r}, "
                f"zeros={self.zeros!r}."
            )
        for name in ("dt", "cutoff"):
            if getattr(self, name) is not None:
                self._set(name, numbers(kind, name, getattr(self, name), ndim=0, low=0.0, strict=True))
        if self.cutoff is not None and 2.0 * self.poles * self.cutoff * self.dt > STIFF:
            raise ValueError(f"{kind}: cutoff * dt must be at most {STIFF / 2.0 / self.poles:g}; got {self.cutoff!r}.")
        self._check_inputs()
        self._check_point()

    @property
    def names(self) -> tuple[str, ...]:
        names = [f"A{i + 1}" for i in range(self.poles)]
        names += [f"b{i + 1}{u}" for u in self.suffixes for i in range(self.zeros + 1)]
        return (*names, "offset") if self.offset else tuple(names)

    @property
    def dimensions(self) -> tuple[tuple[int, int | None], ...]:
        gains = [(1, j) for j in range(self.m) for _ in range(self.zeros + 1)]
        return (*((0, None),) * self.poles, *gains, *([(1, None)] if self.offset else []))

    @property
    def rate(self) -> float:
        """lambda."""
        return PER_SAMPLE / self.dt if self.cutoff is None else float(self.cutoff)

    @property
    def first_point(self) -> Array:
        """The point (parameters,) of the state-variable filter: A = (s + lambda)^n, and no response."""
        found = np.zeros(self.n)
        found[: self.poles] = np.poly(np.full(self.poles, -self.rate))[1:]
        return found

    @property
    def settling(self) -> float:
        return 0.0 if self.point is not None else max(FORGOTTEN * self.n, TIMES * self.poles / (self.rate * self.dt))

    @property
    def instruments(self) -> bool:
        return True

    @property
    def na(self) -> int:
        """Its equation has no past outputs."""
        return 0

    def _steps(self, instruments: bool) -> ModelSteps:
        return steps(Orders(self.zeros, self.offset, self.point is not None, instruments), self.delay)

    def memory(self) -> Mapping[str, Any]:
        n, known = self.poles, self.first_point if self.point is None else np.array(self.point)
        stable = (np.roots(np.append(1.0, known[:n])).real < 0.0).all()
        point = known if stable else self.first_point
        scaled = np.append(1.0, point[:n]) / self.rate ** np.arange(n + 1)
        poly = np.zeros((2, 2 * n))
        poly[0], poly[1, :n] = np.convolve(scaled, scaled)[:0:-1], scaled[:0:-1]
        passed = LARGEST if self.point is not None else 0.0
        return {
            "chain": np.zeros((self.m + 2, 2 * n)), "poly": poly, "rate": np.zeros(2 * n), "p": scaled[1:],
            "unit": self.rate ** -np.arange(n + 1.0), "per_sample": self.rate * self.dt,
            "fastest": np.max(2.0 * scaled[1:] ** (1.0 / np.arange(1, n + 1))), "span": 0.0, "cuts": 0.0,
            "u_lag": np.full((self.m, self.delay + 1), np.nan), "last": np.zeros(self.m), "driven": np.zeros(self.m),
            "before": np.zeros((self.m, 2 * n + 1)), "last_y": 0.0, "expected": 0.0, "begun": 0.0,
            "point": point, "target": point, **MEMORY, "usable": passed, "elapsed": passed,
        }  # fmt: skip

    @property
    def steps(self) -> ModelSteps:
        return self._steps(False)

    def fitted_to(self, tracker: TrackerSteps) -> tuple[Mapping[str, Any], ModelSteps]:
        return self.memory(), self._steps(tracker.instruments)

    def transfers(self, theta: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        """As every model in powers of z^-1: those of the system sampled at nominal times."""
        theta, n, size = np.asarray(theta, dtype=float), self.poles, self.zeros + 1
        rows = theta.reshape(-1, self.n)
        found = []
        for j in range(self.m):
            b = np.zeros((len(rows), n))
            b[:, n - size :] = rows[:, n + j * size : n + (j + 1) * size]
            both = np.array([sampled(a, one, self.dt) for a, one in zip(rows[:, :n], b, strict=True)])
            A = np.concatenate([np.ones((len(rows), 1)), both[:, :n]], axis=1)
            B = np.concatenate([np.zeros((len(rows), 1 + self.delay)), both[:, n:]], axis=1)
            found.append(tuple(one.reshape(*theta.shape[:-1], -1) for one in (B, A)))
        return found[0][1], found  # type: ignore[return-value]

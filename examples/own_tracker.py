"""A complete tracker of your own: least mean squares in the sign of the error, and the result of the contract checks.

Run: python examples/own_tracker.py, or from a shell in this folder, over your own table,
driftfit track data.csv --y flow --u pressure --with own_tracker:SignLMS -p gain=0.02
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit import ARX, RLS, Live, Tracker, check_tracker, track
from driftfit.extend import State, TrackerSteps, kernel, no_variance, nothing, numbers, prediction, unknown


@kernel
def forecast(s: State, l: int) -> None:
    """y_hat = phi' theta,  e = y - y_hat"""
    s.y_hat[l] = prediction(s, l)
    s.e[l] = s.y[l] - s.y_hat[l]


@kernel
def correct(s: State, l: int) -> None:
    """theta <- theta + gain phi sign(e) / |phi|"""
    power = 1e-300  # no division by zero
    for i in range(s.theta.shape[0]):
        power += s.phi[i, l] * s.phi[i, l]
    step = s.ok[l] * s.gain[l] * np.sign(s.e[l]) / np.sqrt(power)
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += step * s.phi[i, l]


@dataclass(frozen=True)
class SignLMS(Tracker):
    """Least mean squares in the sign of the error: no output, however wrong, moves theta by more than ``gain``.

    Parameters
    ----------
    gain : number
        Length of a step of theta; positive.
    """

    gain: float = 0.02

    covariance: ClassVar[bool] = False

    def __post_init__(self) -> None:
        self._set("gain", numbers("SignLMS", "gain", self.gain, ndim=0, low=0.0, strict=True))

    def state(self, n: int) -> Mapping[str, Any]:
        return {"theta": np.zeros(n), "gain": self.gain}

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(nothing, forecast, correct, unknown, no_variance)


@kernel
def careless(s: State, l: int) -> None:
    """The same with two mistakes: s.ok is forgotten, and the size of the regressor is read from lane 0."""
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += s.gain[l] * s.phi[i, l] * np.sign(s.e[l]) / (1.0 + abs(s.phi[0, 0]))


class Careless(SignLMS):
    """A tracker that breaks two promises."""

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(nothing, forecast, careless, unknown, no_variance)


def simulate(T: int = 1000, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A first-order system with a decreasing gain, and one output in fifty far off."""
    rng = np.random.default_rng(seed)
    u, gain = rng.normal(size=T), np.linspace(2.0, 1.0, T)
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.5 * y[t - 1] + gain[t] * u[t - 1] + 0.1 * rng.normal()
    return y + np.where(rng.random(T) < 0.02, 20.0 * rng.normal(size=T), 0.0), u


def main() -> None:
    print("SignLMS breaks", check_tracker(SignLMS()) or "nothing")
    for sentence in check_tracker(Careless()):
        print("Careless:", sentence)
    y, u = simulate()
    for tracker in (SignLMS(), RLS(0.98)):
        run = track(ARX(1, 1), tracker, y, u)
        error = run.theta[100:, 1] - np.linspace(2.0, 1.0, 1000)[100:]
        print(f"{type(tracker).__name__}: error of the gain after 100 samples (rms) {np.sqrt(np.mean(error**2)):.3f}")
    live = Live(ARX(1, 1), SignLMS())
    for t in range(1000):
        live.update(y[t], u[t])
    print("Live ends where the record ends:", np.array_equal(live.theta, track(ARX(1, 1), SignLMS(), y, u).theta[-1]))


if __name__ == "__main__":
    main()

"""Speed of Hammerstein-Wiener tracking: stage one compared with a regression of its size, separation, streams.

    python -m benchmarks.hammerstein_wiener [--quick]

Targets: stage one at the rate of a regression with as many regressors, 1.1 times at most; separation of
a whole record at most 5 times the filter step; an update with blocks at n = 14 below 10 us.
"""

from __future__ import annotations

import sys
from functools import partial

import numpy as np

from driftfit import Kalman, Live, Regression, track
from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Legendre, Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.separation import METHODS, split
from driftfit.systems.hammerstein_wiener import CUBIC, example
from lab.reproduce.hammerstein_wiener.cost import least

T, QUICK = 5000, 500
MODELS = {
    "cubic": CUBIC,
    "Legendre": HammersteinWiener(3, 3, input=Legendre(3, (-4.0, 4.0)), output=Legendre(4, (-4.0, 4.0))),
    "Hammerstein": HammersteinWiener(2, 2, input=Polynomial(3)),
    "linear": HammersteinWiener(2, 2),
}
TURNS = 4
"""Number of turns in which a model and its regression are measured; the minimum counts."""


def beside_regression(name: str, model: HammersteinWiener, y: Array, u: Array, tracker: Kalman) -> float:
    """Print the time of stage one compared with a regression of its size; returns the nanoseconds per sample."""
    T = len(y)
    phi = np.random.default_rng(0).normal(size=(T, model.n))
    plain, stage = np.inf, np.inf
    for _ in range(TURNS):
        plain = min(plain, least(partial(track, Regression(model.n), tracker, y, phi), T))
        stage = min(stage, least(partial(track, model, tracker, y, u), T))
    print(f"{name:12s} n = {model.n:2d}: regression {plain:3.0f} ns a sample, stage one {stage:3.0f} ns, ", end="")
    print(f"{stage / plain:.2f} times")
    return stage


def stream(live: Live, y: list[float], u: list[float]) -> None:
    for output, drive in zip(y, u, strict=True):
        live.update(output, drive)
        live.blocks()


def main(T: int = T, names: tuple[str, ...] = tuple(MODELS)) -> None:
    s = example(1, 0, T=T)
    tracker = Kalman(q=10.0, r=0.01, p0=1e8, theta0=0.01)
    stage, *_ = [beside_regression(name, MODELS[name], s.y, s.u, tracker) for name in names]
    run = track(CUBIC, tracker, s.y, s.u)
    for method in METHODS[:3]:
        cost = least(partial(split, CUBIC, run.theta, method), T)
        print(f"{method:10s} {cost:5.0f} ns a sample, {cost / stage:.2f} filter steps")
    gls = least(lambda: run.blocks("gls"), T)
    print(f"gls        {gls:5.0f} ns a sample, with the replay for P")
    live = Live(CUBIC, tracker)
    y, u = s.y[:2000].tolist(), s.u[:2000].tolist()
    print(f"live update with blocks: {least(partial(stream, live, y, u), 2000) / 1000:.2f} us")


if __name__ == "__main__":
    main(*((QUICK, ("cubic",)) if "--quick" in sys.argv else ()))

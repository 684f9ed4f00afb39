"""Speed of Hammerstein-Wiener tracking: stage one beside a regression of its size, separation, a stream with blocks.

    python benchmarks/hammerstein_wiener.py

Targets: stage one at the rate of a regression with as many regressors, up to the lags and the prediction; separation of
a whole record at most 5 times the filter step; an update with blocks at n = 14 below 10 us.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from driftfit import Kalman, Live, Regression, track
from driftfit.blocks.paths import empty
from driftfit.blocks.separate import METHODS, separate
from driftfit.reproduce.hammerstein_wiener.cost import least
from driftfit.systems.hammerstein_wiener import CUBIC, example

T = 5000


def stream(live: Live, y: list[float], u: list[float]) -> None:
    for output, drive in zip(y, u, strict=True):
        live.update(output, drive)
        live.blocks()


def main() -> None:
    s = example(1, 0, T=T)
    tracker = Kalman(q=10.0, r=0.01, p0=1e8, theta0=0.01)
    phi = np.random.default_rng(0).normal(size=(T, CUBIC.n))
    plain = least(partial(track, Regression(CUBIC.n), tracker, s.y, phi), T)
    stage = least(partial(track, CUBIC, tracker, s.y, s.u), T)
    run = track(CUBIC, tracker, s.y, s.u)
    theta, parts = np.ascontiguousarray(run.theta), empty(CUBIC, T)
    print(f"regression, n = {CUBIC.n}: {plain:.0f} ns a sample; stage one: {stage:.0f} ns, {stage / plain:.2f} times")
    for place, method in enumerate(METHODS[:3]):
        cost = least(partial(separate, theta, tuple(CUBIC.structure[:4]), place, *parts), T)
        print(f"{method:10s} {cost:5.0f} ns a sample, {cost / stage:.2f} filter steps")
    gls = least(lambda: run.blocks("gls"), T)
    print(f"gls        {gls:5.0f} ns a sample, with the replay for P")
    live = Live(CUBIC, tracker)
    y, u = s.y[:2000].tolist(), s.u[:2000].tolist()
    print(f"live update with blocks: {least(partial(stream, live, y, u), 2000) / 1000:.2f} us")


if __name__ == "__main__":
    main()

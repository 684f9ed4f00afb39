"""Least squares, instruments, refined instruments and models of the noise, on the same records in coloured noise.

    python benchmarks/coloured_noise.py [--quick]

The plant is y = B/F u + v, F = 1 - 1.5 z + 0.7 z^2, B = z (1 + 0.5 z), with white u; v has one of four colours and one
of two powers. Printed in percent of the norm of the plant's parameters are the norm of the bias at the end of 1500
samples (the median error of all records), and the median of the error; then the share of 95 % bands that cover, and in
the last column how many records of all colours are astray: with an error above 30 % at the end. Constants are judged at
the end. In the records that drift B doubles and F slows down from sample 500 to 1000; error and bands are then those of
all samples after the 300th, and at the end nothing has moved for 500 samples.
"""

from __future__ import annotations

import sys
import warnings
from typing import Any

import numpy as np
from scipy import signal

from driftfit import ARX, OE, RLS, AdaptiveKalman, BoxJenkins, InstrumentalVariables, Kalman, track

T, SETTLED, ASTRAY = 1500, 300, 30.0
QUICK = "--quick" in sys.argv
RECORDS = 1 if QUICK else 40
PLANT = {"f1": (1.5, 1.6), "f2": (-0.7, -0.75), "b1": (1.0, 2.0), "b2": (0.5, 1.0)}
"""Before and after."""
COLOURS = {
    "white": ([1.0], [1.0]),
    "as ARX, 1 / F": ([1.0], [1.0, -1.5, 0.7]),
    "slow, 1 / (1 - .95 z)": ([1.0], [1.0, -0.95]),
    "hum, 1 / (1 - 1.6 z + .95 z^2)": ([1.0], [1.0, -1.6, 0.95]),
}
LEAST, BOX = ARX(2, 2), BoxJenkins(2, 2, 2, 2)
WALK = {"b": 1e-5, "f": 1e-6}
"""Drift that the Kalman filter is given; C and D have none."""
CONSTANT: tuple[tuple[str, Any, Any, bool], ...] = (
    ("ARX, RLS(1.0)", LEAST, RLS(1.0), False),
    ("ARX, InstrumentalVariables(1.0)", LEAST, InstrumentalVariables(1.0), False),
    ("OE, RLS(1.0)", OE(2, 2), RLS(1.0), False),
    ("OE, RLS(1.0), off line", OE(2, 2), RLS(1.0), True),
    ("OE, InstrumentalVariables(1.0)", OE(2, 2), InstrumentalVariables(1.0), False),
    ("BoxJenkins, RLS(1.0)", BOX, RLS(1.0), False),
    ("BoxJenkins, RLS(1.0), off line", BOX, RLS(1.0), True),
    ("BoxJenkins, InstrumentalV.(1.0)", BOX, InstrumentalVariables(1.0), False),
    ("  off line (RIVBJ)", BOX, InstrumentalVariables(1.0), True),
    ("BoxJenkins, AdaptiveKalman()", BOX, AdaptiveKalman(), False),
)
DRIFTING: tuple[tuple[str, Any, Any, bool], ...] = (
    ("ARX, RLS(.99)", LEAST, RLS(0.99), False),
    ("ARX, AdaptiveKalman()", LEAST, AdaptiveKalman(), False),
    ("ARX, InstrumentalVariables(.99)", LEAST, InstrumentalVariables(0.99), False),
    ("OE, RLS(.99)", OE(2, 2), RLS(0.99), False),
    ("OE, AdaptiveKalman()", OE(2, 2), AdaptiveKalman(), False),
    ("OE, InstrumentalVariables(.99)", OE(2, 2), InstrumentalVariables(0.99), False),
    ("BoxJenkins, RLS(.99)", BOX, RLS(0.99), False),
    ("BoxJenkins, InstrumentalV.(.99)", BOX, InstrumentalVariables(0.99), False),
    ("BoxJenkins, Kalman", BOX, Kalman, False),
    ("BoxJenkins, AdaptiveKalman()", BOX, AdaptiveKalman(), False),
)


def record(noise: Any, decibels: float, drifting: bool, seed: int) -> tuple[Any, Any, Any, float]:
    """y, u, the parameters (T, 4) in the order of `PLANT`, and the variance of the innovation of v."""
    rng = np.random.default_rng(seed)
    u, e, clean = rng.normal(size=T), rng.normal(size=T + 500), np.zeros(T)
    share = np.interp(np.arange(T), [500, 1000], [0.0, 1.0]) * drifting
    truth = np.array([a + share * (b - a) for a, b in PLANT.values()]).T
    for t in range(2, T):
        f1, f2, b1, b2 = truth[t]
        clean[t] = f1 * clean[t - 1] + f2 * clean[t - 2] + b1 * u[t - 1] + b2 * u[t - 2]
    v = signal.lfilter(*noise, e)[500:]
    first = signal.lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u)
    scale = np.std(first) / np.std(v) * 10.0 ** (-decibels / 20.0)
    return clean + scale * v, u, truth, float(scale**2)


def estimate(model: Any, tracker: Any, refined: bool, one: Any) -> tuple[Any, Any]:
    """theta and std (T, 4) of the plant."""
    y, u, _, r = one
    if tracker is Kalman:
        tracker = Kalman(q=[WALK.get(name[0], 0.0) for name in model.names], r=r)
    run = track(model, tracker, y, u)
    run = run.refine() if refined else run
    places = [run.names.index(name if name in run.names else name.replace("f", "a")) for name in PLANT]
    return run.theta[:, places], run.std[:, places]


def judged(way: Any, records: list[Any], drifting: bool) -> tuple[str, int]:
    """Bias, error and share in band, of one way; and how many records are astray."""
    _, model, tracker, refined = way
    late, misses, inside = slice(SETTLED if drifting else T - 1, None), [], []
    size = np.linalg.norm([before for before, _ in PLANT.values()]) / 100.0
    for one in records:
        theta, std = estimate(model, tracker, refined, one)
        misses.append((theta - one[2])[late] / size)
        inside.append(np.abs(misses[-1]) * size < 1.96 * std[late])
    last = np.array(misses)[:, -1]
    bias = np.linalg.norm(np.median(last, axis=0))
    error = np.median(np.sqrt(np.mean(np.sum(np.square(misses), axis=-1), axis=-1)))
    return f"{bias:9.1f}{error:6.1f}{np.mean(inside):6.2f}", int(np.sum(~(np.linalg.norm(last, axis=1) < ASTRAY)))


def main() -> None:
    """Print the tables."""
    warnings.simplefilter("ignore")
    for drifting, ways in ((False, CONSTANT), (True, DRIFTING)):
        for decibels in (20.0,) if QUICK else (20.0, 5.0):
            kind = "parameters that drift" if drifting else "constant parameters"
            print(f"{kind}, {decibels:g} dB: bias %, error %, in band")
            print(f"{'':32}" + "".join(f"{name:>21}" for name in ("white", "as ARX", "slow", "hum")) + "  astray")
            drawn = {
                name: [record(noise, decibels, drifting, s) for s in range(RECORDS)] for name, noise in COLOURS.items()
            }
            for way in ways[:4:3] if QUICK else ways:
                cells = [judged(way, one, drifting) for one in drawn.values()]
                print(f"{way[0]:32}" + "".join(cell for cell, _ in cells) + f"{sum(n for _, n in cells):8}", flush=True)


if __name__ == "__main__":
    main()

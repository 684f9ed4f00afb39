"""Particles after a dead sensor: whether `ParticleFilter` finds the parameters again, beside `JointKalman`.

    python benchmarks/dead_sensor.py [--quick]

x = a x[-1] + b u[-1] + w, y = x + v, with a = .8 and b = 1. From sample 400 to 600 the output or the input is missing,
holds its last value, or reads 0; or the output reads 0 for the first 200 samples. Printed are the root mean square
error of b 100 and 600 samples after the fault, and the share of 95 % bands of a and b that cover, over 12 records.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from driftfit import JointKalman, ParticleFilter, StateSpace, track

QUICK = "--quick" in sys.argv
RECORDS, T, FIRST, LAST = (1 if QUICK else 12), 1200, 400, 600
MODEL = StateSpace("x = theta.a * x[-1] + theta.b * u[-1] \n y = x", start={"a": 0.5, "b": 0.5})
GIVEN: dict[str, Any] = {"q": {"a": 1e-5, "b": 1e-5, "x": 1e-3}, "r": 0.01, "p0": {"a": 0.1, "b": 0.5, "x": 0.25}}
TRACKERS = {
    "JointKalman": lambda seed: JointKalman(**GIVEN),
    "50 particles": lambda seed: ParticleFilter(50, **GIVEN, seed=seed),
    "200 particles": lambda seed: ParticleFilter(200, **GIVEN, seed=seed),
    "50, a drawn too": lambda seed: ParticleFilter(50, **GIVEN, seed=seed, sampled=("x", "a")),
}
FAULTS = ("none", "y missing", "y held", "y zero", "u missing", "u held", "u zero", "y zero at first")


def record(seed: int, fault: str) -> tuple[Any, Any]:
    """y and u."""
    rng = np.random.default_rng(seed)
    u, x = rng.normal(size=T), np.zeros(T)
    for t in range(1, T):
        x[t] = 0.8 * x[t - 1] + u[t - 1] + np.sqrt(1e-3) * rng.normal()
    y = x + 0.1 * rng.normal(size=T)
    signal, dead = (y if fault[0] == "y" else u), slice(FIRST, LAST)
    if fault == "y zero at first":
        y[: LAST - FIRST] = 0.0
    elif fault != "none":
        signal[dead] = {"missing": np.nan, "held": signal[FIRST - 1], "zero": 0.0}[fault[2:]]
    return y, u


def judged(make: Any, fault: str) -> str:
    """The cells of a tracker."""
    end = LAST - FIRST if fault.endswith("first") else LAST
    at, truth, misses, inside = [end + 100, end + 599], np.array([0.8, 1.0]), [], []
    for seed in range(RECORDS):
        run = track(MODEL, make(seed), *record(seed, fault))
        misses.append(run.theta[at, :2] - truth)
        inside.append(np.abs(misses[-1]) < 1.96 * run.std[at, :2])
    error, share = np.sqrt(np.mean(np.square(misses), axis=0))[:, 1], np.mean(inside, axis=(0, 2))
    return f"{error[0]:8.3f}{share[0]:5.2f}{error[1]:8.3f}{share[1]:5.2f}"


def main() -> None:
    """Print the table."""
    shown = list(TRACKERS)[: 2 if QUICK else None]
    print(f"{'':16}" + "".join(f"{name:>26}" for name in shown))
    print(f"{'samples after':16}" + f"{100:8}{'':5}{600:8}{'':5}" * len(shown))
    for fault in FAULTS:
        print(f"{fault:16}" + "".join(judged(TRACKERS[name], fault) for name in shown), flush=True)


if __name__ == "__main__":
    main()

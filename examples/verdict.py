"""The verdict on three systems: constant parameters, constant parameters in changing noise, and a gain that doubles.

Prints the verdicts and saves the one-page diagnosis of the third.
Run: python examples/verdict.py [folder for pictures]
"""

import sys
from pathlib import Path

import numpy as np

from driftfit import ARX, Kalman, Track, track

T = 600


def simulate(gain: np.ndarray, noise: np.ndarray, seed: int = 1) -> Track:
    """y_t = 1.2 y_(t-1) - 0.5 y_(t-2) + gain_t u_(t-1) + 0.4 u_(t-2) + noise, tracked with a little drift."""
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=T), noise * rng.normal(size=T)
    y = np.zeros(T)
    for t in range(2, T):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + gain[t] * u[t - 1] + 0.4 * u[t - 2] + v[t]
    return track(ARX(2, 2), Kalman(q=1e-3, r=0.01), y, u)


def main(folder: str | None = None) -> None:
    steady, calm = np.ones(T), np.full(T, 0.1)
    late = np.where(np.arange(T) < 400, 0.1, 0.4)
    moved = np.where(np.arange(T) < 350, 1.0, 2.0)
    runs = {
        "nothing moves": simulate(steady, calm),
        "nothing moves, the noise is four times as large from 400 on": simulate(steady, late),
        "a gain doubles at 350": simulate(moved, calm),
    }
    for name, run in runs.items():
        print(f"{name}:")
        for sentence in run.verdict().sentences:
            print(f"  {sentence}")
    if folder:
        runs["a gain doubles at 350"].diagnose().plot().savefig(Path(folder) / "diagnosis.png", dpi=70)


if __name__ == "__main__":
    main(*sys.argv[1:2])

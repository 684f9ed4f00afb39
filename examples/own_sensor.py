"""A gauge that clips: a sensor hypothesis with a likelihood of one's own, in a bank.

The level of a tank follows its inflow; the gauge ends at 2, and shows 2 for all that is above. A bank that takes what
it shows for the level learns a gain that is too small. Prints mean absolute errors of the parameters, over twenty
records, for banks that know different sensors; saves a picture of one record.
Run: python examples/own_sensor.py [folder]
"""

import math
import sys
from pathlib import Path

import numpy as np

from driftfit import ARX, Bank, Change, Sensor, track

END, STEP, R = 2.0, 0.01, 0.01


def clipped(y, y_hat, h, r, last):
    """p(the end is shown) = p(the level is above it); nothing is learned, and the level is what the leaf expects."""
    if y < END:
        return -math.inf, math.inf, y
    above = 0.5 * math.erfc((END - y_hat) / math.sqrt(2.0 * (h + r)))
    return math.log(above / STEP + 1e-300), math.inf, max(y_hat, END)


def simulate(seed: int, T: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(y, u, level, theta): the gain goes from 0.3 to 0.5 in the middle."""
    rng = np.random.default_rng(seed)
    theta = np.column_stack([np.full(T, 0.8), np.where(np.arange(T) < T // 2, 0.3, 0.5)])
    u, level = rng.uniform(0.0, 1.6, T), np.zeros(T)
    for t in range(1, T):
        level[t] = theta[t, 0] * level[t - 1] + theta[t, 1] * u[t - 1] + math.sqrt(R) * rng.standard_normal()
    return np.minimum(level, END), u, level, theta


CHANGES = [Change(1e-6), Change(0.1, prob=0.01, which=[1], name="gain")]
BANKS = {
    "nominal alone": Bank(CHANGES, [Sensor.nominal(R)], p0=1.0),
    "nominal, additive outlier": Bank(CHANGES, [Sensor.nominal(R), Sensor.outlier(kind="additive")], p0=1.0),
    "nominal, clipped": Bank(CHANGES, [Sensor.nominal(R), Sensor.own(clipped, prob=0.2, cleans=True)], p0=1.0),
}


def main(folder: str | None = None) -> None:
    errors = {name: [] for name in BANKS}
    for seed in range(20):
        y, u, _, theta = simulate(seed)
        for name, bank in BANKS.items():
            run = track(ARX(1, 1), bank, y, u)
            errors[name].append(np.abs(run.theta - theta)[50:].mean(axis=0))
    print(f"{'':26} a1      b1")
    for name, found in errors.items():
        a, b = np.mean(found, axis=0)
        print(f"{name:26} {a:.3f}   {b:.3f}")
    if folder:
        picture(folder)


def picture(folder: str) -> None:
    import matplotlib.pyplot as plt

    y, u, level, theta = simulate(0)
    figure, (top, below) = plt.subplots(2, sharex=True, figsize=(8, 5), layout="constrained")
    top.plot(level, color="0.7", label="level")
    top.plot(y, lw=0.8, label="gauge")
    top.legend(loc="upper left")
    below.plot(theta[:, 1], "k--", lw=0.8, label="true gain")
    for name in ("nominal alone", "nominal, clipped"):
        below.plot(track(ARX(1, 1), BANKS[name], y, u).theta[:, 1], label=name)
    below.set_ylim(0.0, 0.8)
    below.legend(loc="lower right")
    figure.savefig(Path(folder) / "own_sensor.png", dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:2])

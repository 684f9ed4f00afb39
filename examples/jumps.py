"""Parameters that jump: the events that a bank of hypotheses detects, and their dates.

Prints the detected events and the segments between them; saves plots of the parameters with the probabilities of
events, of the segments, and of the tree while a jump is being decided.
Run: python examples/jumps.py [folder]
"""

import sys
from pathlib import Path

import numpy as np

from driftfit import ARX, Bank, Change, Decide, Live, Sensor, piecewise, plot_tree, track


def simulate(T: int = 400, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """y_t = a y_{t-1} + b u_{t-1} + noise: b doubles at 150, both change at 280; the sensor spikes at 90 and 210."""
    rng = np.random.default_rng(seed)
    u, x = rng.standard_normal(T), np.zeros(T)
    for t in range(1, T):
        a, b = (0.7, 1.0) if t < 150 else (0.7, 2.0) if t < 280 else (0.3, 1.2)
        x[t] = a * x[t - 1] + b * u[t - 1] + 0.2 * rng.standard_normal()
    y = x.copy()
    y[[90, 210]] += 3.0, -2.5
    return y, u


CHANGES = [
    Change(1e-6, name="drift"),
    Change(1.0, prob=0.005, which=[1], name="gain"),
    Change(0.5, prob=0.005, name="all"),
]
SENSORS = [Sensor.nominal(r=0.04), Sensor.outlier(10.0, kind="additive", prob=0.02)]


def main(folder: str | None = None) -> None:
    y, u = simulate()
    run = track(ARX(1, 1), Bank(CHANGES, SENSORS, p0=2.0), y, u)
    for event in run.hypotheses.events():
        moved = ", ".join(f"{name} {shift:+.2f} ({event.std[name]:.2f})" for name, shift in event.shift.items())
        print(
            f"{event.kind:<7}{event.date:>4} [{event.first}, {event.last}]  known {event.known}  {event.name:<9}{moved}"
        )
    segments = piecewise(run)
    for a, b, theta, std in zip(segments.bounds[:-1], segments.bounds[1:], segments.theta, segments.std, strict=True):
        values = "  ".join(f"{value:.3f} ({error:.3f})" for value, error in zip(theta, std, strict=True))
        print(f"{a:>4} to {b - 1:>3}   {values}")
    if folder:
        run.hypotheses.plot().savefig(Path(folder) / "bank.png", dpi=110)
        segments.plot().savefig(Path(folder) / "bank_segments.png", dpi=110)
        live = Live(ARX(1, 1), Bank(CHANGES, SENSORS[:1], reduce=Decide(3), p0=2.0))
        for t in range(152):
            live.update(y[t], float(u[t]))
        plot_tree(live).savefig(Path(folder) / "bank_tree.png", dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:2])

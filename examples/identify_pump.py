"""From a file to an answer: a pump whose pressure does less and less, in a file that driftfit ships.

Prints the answer of `driftfit.identify` and saves its picture. Run: python examples/identify_pump.py [picture.png]
"""

import csv
import sys
from contextlib import chdir
from datetime import datetime, timedelta
from importlib.resources import files
from pathlib import Path

import numpy as np

from driftfit import identify

PUMP = Path(str(files("driftfit.demo") / "pump.csv"))


def make(path: Path, T: int = 800, seed: int = 48) -> None:
    """Write the record: flow follows pressure after 70 s and speed after 20 s; a filter clogs from 01:15 to 01:31."""
    rng = np.random.default_rng(seed)
    pressure, speed = (rng.normal(size=T)[np.cumsum(rng.random(T) < 0.2)] for _ in range(2))
    temperature = 20.0 + np.cumsum(0.05 * rng.normal(size=T))
    humidity = 40.0 + 5.0 * rng.normal(size=T)
    gain = np.interp(np.arange(T), [450, 550], [0.5, 0.3])
    flow = np.zeros(T)
    for t in range(7, T):
        flow[t] = 0.6 * flow[t - 1] + gain[t] * pressure[t - 7] + 0.2 * speed[t - 2] + 0.15 * rng.normal()
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["time", "pressure", "speed", "temperature", "humidity", "pump", "flow"])
        for t in range(T):
            signals = (pressure[t] + 3.0, speed[t] + 8.0, temperature[t], humidity[t], 1.0, flow[t] + 12.0)
            cells = [f"{value:.3f}" for value in signals]
            rows.writerow([datetime(2026, 3, 3) + timedelta(seconds=10 * t), *cells])


def main(picture: str | None = None) -> None:
    target = Path(picture).absolute() if picture else None
    with chdir(PUMP.parent):  # so that the commands name the file alone
        answer = identify(PUMP.name, y="flow")
    print(answer)
    if target:
        answer.plot().savefig(target, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:2])

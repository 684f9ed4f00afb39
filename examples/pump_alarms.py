"""Alarms on a pump loop with labelled faults: an inlet valve that closes, a rotor out of balance.

The flow is a regression on pressure and motor current. The first part of each record, before the fault, is the
reference; each kind of alarm is then scored against the labels: which faults are found, after how long, and how many
alarms begin where nothing is wrong.

The record is not part of the project: SKAB by waico (GPL-3), as one CSV file with the columns experiment, current_A,
pressure_bar, flow_lpm and anomaly. Run: python examples/pump_alarms.py FILE [FOLDER FOR FIGURES]
"""

import sys
from pathlib import Path

import numpy as np
import polars as pl
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import Kalman, Regression, Track, track, tune

EVERY = 3600.0
"""One false alarm in an hour of samples."""
STEP = 1.0
"""Resolution of the flow meter, l/min."""
MODEL = Regression(["pressure", "current"], intercept=True)


def records(path: str) -> dict[str, pl.DataFrame]:
    """The experiments by name, in order."""
    data = pl.read_csv(path)
    return {str(name[0]): part for name, part in data.group_by("experiment", maintain_order=True)}


def followed(part: pl.DataFrame, reference: int) -> Track:
    """Flow (l/min) on pressure (bar) and current (A), each about its mean in the reference.

    Drift and noise are maximum-likelihood estimates from the reference; the noise is not below that of the steps.
    """
    y = part["flow_lpm"].to_numpy()
    u = part.select("pressure_bar", "current_A").to_numpy()
    u = u - u[:reference].mean(axis=0)
    found = tune(MODEL, Kalman(), y[:reference], u[:reference]).tracker
    return track(MODEL, Kalman(q=found.q, r=max(found.r, STEP**2 / 12.0)), y, u)


def main(path: str, figures: str | None = None) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"One false alarm in {EVERY:g} samples")
    heads = ("experiment", "alarm", "faults", "found", "delay, samples", "false", "expected", "normal samples")
    for head in heads:
        table.add_column(head, justify="left" if head in heads[:2] else "right")
    for name, part in records(path).items():
        labels = part["anomaly"].to_numpy() > 0.5
        reference = int(np.argmax(labels)) * 3 // 4
        run = followed(part, reference)
        for kind in ("glr", "band"):
            alarms = run.detect(kind, every=EVERY, reference=reference)
            got = alarms.score(labels)
            numbers = (got.events, got.found, f"{got.delay:g}", got.false, f"{got.normal / EVERY:.2f}", got.normal)
            table.add_row(name, kind, *map(str, numbers))
            if figures:
                alarms.plot(labels).savefig(Path(figures) / f"{name}_{kind}.png", dpi=70)
    Console(width=110).print(table)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(*sys.argv[1:3])

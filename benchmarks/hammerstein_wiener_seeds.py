"""How often estimates of a Hammerstein-Wiener system go astray: quantiles over a thousand records of example 1.

The worst of a few records says little about failures that are rare. Printed are quantiles over the records of the root
mean square error of the eight minimal parameters, over 5000 samples but the first 200; the largest, and how many are
above 0.1, which is five times what is usual.

Run: python -m benchmarks.hammerstein_wiener_seeds [records, 1000 by default] [--quick]
"""

import sys

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track as progress
from rich.table import Table

from driftfit.systems.hammerstein_wiener import example
from driftfit.tracking import track
from lab.reproduce.hammerstein_wiener import runs

QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
ASTRAY = 0.1
METHODS = ('two-stage, "average"', 'two-stage, "svd-joint"', "EKF on minimal parameters")


def errors(seed: int, T: int) -> list[float]:
    """Rms error of each method on one record."""
    s = example(1, seed, T=T)
    run = track(s.model, runs.PAPER, s.y, s.u)
    paths = run.blocks("average").xi, run.blocks().xi, track(s.model, runs.FAST, s.y, s.u).theta
    return [runs.late(runs.off(xi, s)).rms for xi in paths]


def main(records: int = 1000, T: int = 5000) -> None:
    found = np.array([errors(s, T) for s in progress(range(records), "records", console=Console(stderr=True))])
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"Rms error over {records} records", title_justify="left")
    for head in ("", *(f"{100 * q:g} %" for q in QUANTILES[:-1]), "largest", f"above {ASTRAY:g}"):
        table.add_column(head, justify="right" if head else "left")
    for name, column in zip(METHODS, found.T, strict=True):
        cells = (f"{value:.3g}" for value in np.quantile(column, QUANTILES))
        table.add_row(name, *cells, str(int(np.sum(column > ASTRAY))))
    Console(width=110, highlight=False).print(table)


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(2, 600)
    else:
        main(*map(int, sys.argv[1:2]))

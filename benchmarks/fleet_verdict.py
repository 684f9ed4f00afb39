"""From a table of twenty thousand series to their verdicts: seconds and memory.

Pumps, y of one lag, the pressure before and an intercept, 300 samples each; the gain of one in ten falls by 15 %
half-way. "elapsed" is the clock, which other work on the machine lengthens; "processor" the time of all cores that the
process and those that it started used, so that half of it is the least that two cores can take. Of it the tracker takes
"of track". Memory is the largest that the process had, with the records and the results of the tracker, and what of it
the verdicts added; each process that it starts has 240 MB besides.

Run: python benchmarks/fleet_verdict.py [--quick]
"""

from __future__ import annotations

import os
import resource
import sys
import time

import numpy as np
import polars as pl
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, Kalman, track
from driftfit.run.fleet import Fleet
from driftfit.run.parallel_lanes import cores

T, DRIFTING = 300, 0.1


def pumps(units: int) -> pl.DataFrame:
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(units, T)), np.zeros((units, T))
    gain = np.ones((units, T))
    gain[: int(DRIFTING * units), T // 2 :] = 0.85
    for t in range(1, T):
        y[:, t] = 0.7 * y[:, t - 1] + gain[:, t] * u[:, t - 1] + 0.1 * rng.normal(size=units)
    return pl.DataFrame({"pump": np.repeat(np.arange(units), T), "flow": y.ravel(), "pressure": u.ravel()})


def tracked(data: pl.DataFrame) -> Fleet:
    model = ARX(1, 1, intercept=True)
    return track(model, Kalman(q=1e-5, r=0.01), y="flow", u="pressure", data=data, by="pump")


def peak() -> float:
    """Megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def processor() -> float:
    """Seconds of processor time, also of the processes that were started and have ended."""
    return sum(os.times()[:4])


def main(units: int) -> None:
    tracked(pumps(8)).verdict()  # compiles
    data = pumps(units)
    elapsed, begun = time.perf_counter(), processor()
    fleet = tracked(data)
    before, followed = peak(), processor() - begun
    result = fleet.verdict()
    elapsed, spent = time.perf_counter() - elapsed, processor() - begun
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"{units} series of {T} samples on {cores()} cores")
    heads = (
        "elapsed, s",
        "processor, s",
        "of track, s",
        "a series, ms",
        "peak, MB",
        "of the verdicts, MB",
        "drifting found",
    )
    for head in heads:
        table.add_column(head, justify="right")
    table.add_row(
        f"{elapsed:.1f}", f"{spent:.1f}", f"{followed:.1f}", f"{1e3 * spent / units:.2f}", f"{peak():.0f}",
        f"{peak() - before:.0f}", f"{len(result.drifting)}",
    )  # fmt: skip
    Console(width=110).print(table)


if __name__ == "__main__":
    main(60 if "--quick" in sys.argv else 20_000)

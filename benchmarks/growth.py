"""How cost grows: processor time against samples, parameters, series, leaves, outputs and candidates, with slopes.

    python -m benchmarks.growth                       about ten minutes, most of it compiling new sizes
    python -m benchmarks.growth --quick
    python -m benchmarks.growth "written series" --full

With --full there are up to 4,000,000 samples and 1,000,000 series, which need 5 GB of memory and 10 GB for temporary
files. Slopes are least squares on log axes over the larger half of the sizes. Costs in proportion have slope 1; in n
the filter costs n^2 per sample. Figures are the least processor time of several turns, all threads together. Each line
is measured by a process of its own, whose peak of memory includes the signals, and 0.22 GB of the library; with
--quick all by this one.
"""

import os

for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from time import process_time_ns
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from benchmarks.end_to_end import signals
from driftfit import ARX, Bank, Beam, Change, Kalman, Regression, Sensor, select, track
from driftfit.run.program import lanes_of

TRACKER = Kalman(q=1e-4, r=0.01)

LEAST = 1e4
"""Nanoseconds that are shown at least: the system may count user time in steps, and find none in a short job."""

Clock = Callable[[], float]
Case = tuple[str, str, float, list[int], Callable[[int], Callable[[], Any]], Clock]
"""(against, of, slope that the mathematics says, sizes, the job of a size, nanoseconds of which time)."""


def user_time_ns() -> float:
    """Processor time of this process without that of the system."""
    return 1e9 * getrusage(RUSAGE_SELF).ru_utime


def spent(job: Callable[[], Any], turns: int, clock: Clock) -> float:
    """The least nanoseconds of processor time of some turns."""
    best = np.inf
    for _ in range(turns):
        begun = clock()
        result = job()
        best = min(best, clock() - begun)
        del result
    return max(best, LEAST)


def by_samples(T: int) -> Callable[[], Any]:
    y, u = signals(T)
    return lambda: track(ARX(2, 2), TRACKER, y, u)


def into_used_memory(T: int) -> Callable[[], Any]:
    """The same loop without new memory for its results, which the process would touch for the first time."""
    y, u = signals(T)
    run = track(ARX(2, 2), TRACKER, y, u)
    program, given = run.program, lanes_of(run.record)
    out = program.written(program.tile(), T)
    return lambda: program.fill(program.tile(), *given, out)


def by_parameters(n: int) -> Callable[[], Any]:
    T = max(2000, 200_000 // n)
    y, u = np.random.default_rng(0).standard_normal((2, T))
    known = Kalman(q=1e-4, r=0.01, p0=10.0)  # the diffuse start takes n steps of n^3
    return lambda: track(ARX(n // 2, n - n // 2), known, y, u)


def by_series(count: int) -> Callable[[], Any]:
    y, u = np.random.default_rng(0).standard_normal((2, count, 100))
    return lambda: track(ARX(2, 2), TRACKER, y, u, by="row", keep="theta", dtype="float32")


def to_parquet(count: int) -> Callable[[], Any]:
    y, u = np.random.default_rng(0).standard_normal((2, count, 100))

    def job() -> Any:
        with tempfile.TemporaryDirectory() as folder:
            return track(ARX(2, 2), TRACKER, y, u, by="row", to=Path(folder) / "fleet")

    return job


def by_leaves(leaves: int) -> Callable[[], Any]:
    y, u = signals(1000)
    changes = [Change(0.0, prob=0.98), Change(1e-2, prob=0.01), Change(1.0, prob=0.01)]
    bank = Bank(changes, [Sensor.nominal(0.01)], reduce=Beam(leaves), p0=10.0)
    return lambda: track(ARX(2, 2), bank, np.nan_to_num(y), u)


def by_outputs(ny: int) -> Callable[[], Any]:
    rng = np.random.default_rng(0)
    y, u = rng.standard_normal((20_000, ny)), rng.standard_normal(20_000)
    return lambda: track(Regression(1, ny=ny), TRACKER, y, u)


def by_candidates(count: int) -> Callable[[], Any]:
    y, u = signals(1000)
    models = [ARX(na, nb, nk) for nk in (1, 2, 3) for nb in (1, 2, 3) for na in (1, 2, 3)][:count]
    return lambda: select(models, np.nan_to_num(y), u, tracker=TRACKER)


def cases(quick: bool, full: bool) -> Iterator[Case]:
    few = slice(0, 2) if quick else slice(None)
    lengths = [1000, 10_000, 100_000, 1_000_000, 4_000_000][: None if full else -1][few]
    both = process_time_ns
    yield "T", "track, n = 4", 1.0, lengths, by_samples, both
    yield "T", "its loop, into memory used before", 1.0, lengths, into_used_memory, both
    yield "n", "one sample", 2.0, [2, 4, 12, 24, 48, 100][few], by_parameters, both
    counts = [100, 1000, 10_000, 100_000, 1_000_000][: None if full else -1][few]
    yield "series", "fleet of 100 rows each, theta in float32", 1.0, counts, by_series, both
    yield "series", "without the system's time, which is for new memory", 1.0, counts, by_series, user_time_ns
    yield "written series", "the same in float64 to Parquet", 1.0, counts, to_parquet, both
    yield "leaves", "Bank with Beam, n = 4, T = 1000", 1.0, [8, 16, 32, 64, 128][few], by_leaves, both
    yield "outputs", "Regression(1), T = 20,000", 1.0, [2, 4, 8, 16, 32][few], by_outputs, both
    yield "candidates", "select among ARX models, T = 1000", 1.0, [3, 9, 18, 27][few], by_candidates, both


def measured(place: int, quick: bool, full: bool) -> tuple[list[float], float]:
    """Nanoseconds of each size of a case (of n: per sample), and the peak of memory of this process in GB."""
    name, _, _, sizes, make, clock = list(cases(quick, full))[place]
    ns = [spent(make(size), 1 if "series" in name and size >= 100_000 else 4, clock) for size in sizes]
    if name == "n":
        ns = [total / max(2000, 200_000 // n) for total, n in zip(ns, sizes, strict=True)]
    return ns, getrusage(RUSAGE_SELF).ru_maxrss / 1e6


def main(
    against: Annotated[list[str] | None, typer.Argument(help="Some of the quantities; all by default.")] = None,
    quick: Annotated[bool, typer.Option(help="Small sizes, to see that it works.")] = False,
    full: Annotated[bool, typer.Option(help="The largest sizes too.")] = False,
) -> None:
    """Print the table."""
    console = Console(width=120)
    table = Table(title="How cost grows", title_justify="left")
    for k, head in enumerate(("against", "of", "sizes", "ms, processor time", "slope", "expected", "peak, GB")):
        table.add_column(head, justify="right" if k > 2 else "left")
    for place, (name, what, expected, sizes, *_) in enumerate(cases(quick, full)):
        if against and name not in against:
            continue
        if quick:
            ns, peak = measured(place, quick, full)
        else:
            with ProcessPoolExecutor(1, get_context("spawn")) as process:
                ns, peak = process.submit(measured, place, quick, full).result()
        half = slice(len(sizes) // 2 - (len(sizes) < 4), None)
        slope = np.polyfit(np.log(sizes[half]), np.log(ns[half]), 1)[0]
        shown = ", ".join(f"{one / 1e6:.3g}" for one in ns)
        table.add_row(
            name, what, f"{sizes[0]:,} to {sizes[-1]:,}", shown, f"{slope:.2f}", f"{expected:g}", f"{peak:.2f}"
        )
    console.print(table)


if __name__ == "__main__":
    typer.run(main)

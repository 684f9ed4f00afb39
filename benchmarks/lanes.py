"""Where vectorisation over lanes stops: nanoseconds per series and step at one and at 32 lanes, as n grows.

Random-walk Kalman filter on ARX(n/2, n/2), missing-data rule and all results included, one thread, a block of 256
samples that stays in cache; the median of 200 blocks. Run: python benchmarks/lanes.py [--quick]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, Kalman
from driftfit.engine.drivers import drivers
from driftfit.engine.tiles import WIDTH, make_tile, output_type
from driftfit.run.parallel_lanes import BLOCK_SAMPLES, width_of
from driftfit.run.program import Program

TRACKER = Kalman(q=1e-4, r=0.01)


def step_time(n: int, L: int) -> float:
    """Nanoseconds per series and step."""
    rng = np.random.default_rng(0)
    model = ARX(n - n // 2, n // 2).bind(1)
    tile = make_tile(model.n, 1, model.memory(), [TRACKER.state_for(model)] * L)
    y, u, known = rng.normal(size=(BLOCK_SAMPLES, L)), rng.normal(size=(BLOCK_SAMPLES, 1, L)), np.ones((1, 3, L))
    out = np.empty(BLOCK_SAMPLES, output_type(tile))
    run = drivers(model.steps, TRACKER.steps).run
    run(tile, y, u, known, out)
    seconds = []
    for _ in range(200):
        start = time.perf_counter()
        run(tile, y, u, known, out)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)) / BLOCK_SAMPLES / L * 1e9


def main(quick: bool) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False)
    for head in ("n", "1 lane, ns", f"{WIDTH} lanes, ns", "ratio", "a fleet uses"):
        table.add_column(head, justify="right")
    for n in (2, 4) if quick else (2, 4, 6, 8, 10, 12, 14, 16):
        one, many = step_time(n, 1), step_time(n, WIDTH)
        used = width_of(Program(ARX(n - n // 2, n // 2).bind(1), TRACKER), 1000)
        table.add_row(str(n), f"{one:.1f}", f"{many:.1f}", f"{many / one:.2f}", f"{used} lane{'s' * (used > 1)}")
    Console(width=96).print(table)


if __name__ == "__main__":
    main("--quick" in sys.argv)

"""Memory per compiled configuration in a process: MB, as the number of configurations grows.

ARX(na, nb) of different orders, each with its own record type, tracked by a Kalman filter; first compiled, then found
on disk, in separate processes with separate caches. "all kept": nothing is freed, including llvmlite's pass managers,
as it was before there was a bound. With --quick both use the cache that is there already.
Run: python benchmarks/compiled_memory.py [--quick]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

WAYS = ("all kept", "bounded", "from disk")


def worker(way: str, count: int) -> None:
    """Print megabytes for each configuration after a third, two thirds and all of them."""
    import gc

    import numpy as np
    from llvmlite.binding import newpassmanagers as passes

    from driftfit import ARX, Kalman, track
    from driftfit.engine import kernel

    if way == "all kept":
        kernel.KEPT = kernel.MOST_ENTRIES = 10**9
        for manager in (passes.ModulePassManager, passes.FunctionPassManager):
            manager._dispose = passes.ffi.ObjectRef._dispose
    y, u = np.random.default_rng(0).normal(size=(2, 60))
    tracker = Kalman(q=1e-4, r=0.1)
    track(ARX(1, 0), tracker, y)
    start = resident()
    for k in range(count):
        track(ARX(1 + k % 8, 1 + k // 8), tracker, y, u)
        if k + 1 in {count // 3, 2 * count // 3, count}:
            gc.collect()
            print(f"{(resident() - start) / (k + 1):.2f}", flush=True)


def resident() -> float:
    """Memory of this process, MB."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main(quick: bool) -> None:
    count = 3 if quick else 12
    table = Table(box=SIMPLE_HEAD, show_edge=False)
    for head in ("MB for each of", *(str(n) for n in (count // 3, 2 * count // 3, count)), "configurations"):
        table.add_column(head, justify="right")
    with tempfile.TemporaryDirectory() as cache:
        for way in WAYS[1:] if quick else WAYS:
            place = cache if way != "all kept" else os.path.join(cache, "apart")
            environment = {**os.environ} if quick else {**os.environ, "NUMBA_CACHE_DIR": place}
            command = [sys.executable, __file__, "--worker", way, str(count)]
            result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
            table.add_row(way, *result.split(), "")
    Console(width=96).print(table)


if __name__ == "__main__":
    if "--worker" in sys.argv:
        worker(sys.argv[-2], int(sys.argv[-1]))
    else:
        main("--quick" in sys.argv)

"""Two floors for the record filter: a loop in C with fixed n, and streaming the same bytes.

Both come from ``benchmarks/`` (`kernel.py`, `filter.c`).
Only the driver is timed, without the work that `track` does once per call.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from lab.bench.contest import Contest, Job


def c_loop(module: Any, tile: Any, T: int) -> Job:
    """The loop in C, compiled for this size, its state copied from ours; it must give the same numbers."""
    if shutil.which("gcc") is None:
        raise ImportError("there is no gcc", name="gcc")
    with tempfile.TemporaryDirectory() as folder:
        loop = module.CFilter(tile, folder)
    return Job("C, fixed n", loop.run, T, lambda: np.asarray(loop.out["theta"][..., 0]))


def streaming(module: Any, tile: Any, steps: int) -> Job:
    """Read y and u and write as many numbers as the driver."""
    lanes = tile.y.shape[1]
    copy = tile.out.view(np.float64).reshape(len(tile.y), -1, lanes).copy()
    return Job("streaming the bytes", lambda: module.stream(tile.y, tile.u, copy), steps)


def bound(n: int, lanes: int, T: int) -> Contest:
    """The driver on ``lanes`` series of an ARX(n/2, n/2) against both floors."""
    module: Any = import_module("benchmarks.kernel")
    tile = module.Tile(n, lanes, T // lanes)
    steps = T // lanes * lanes
    ours = Job(
        f"driver, {lanes} lane{'s' * (lanes > 1)}", tile.run, steps, lambda: np.asarray(tile.out["theta"][..., 0])
    )
    others: list[Callable[[], Job]] = [partial(streaming, module, tile, steps)]
    if lanes == 1:
        others.insert(0, partial(c_loop, module, tile, T))
    return Contest(
        f"Floors, n = {n}, {lanes} lane{'s' * (lanes > 1)}",
        "the compiled loop alone, including the ARX memory",
        ours,
        others,
    )

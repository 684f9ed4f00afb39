"""Two floors for the record filter: a loop in C with fixed n, and streaming the same bytes.

Both come from ``benchmarks/`` of the source tree (`kernel.py`, `filter.c`), which an installed package does not have.
What is timed is the driver alone, without what `track` does once per call.
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import driftfit
from driftfit.bench.contest import Contest, Job


def source_benchmark(name: str) -> Any:
    """A script of ``benchmarks/`` as a module; ImportError where the source tree is not there."""
    path = Path(driftfit.__file__).parents[2] / "benchmarks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"driftfit_benchmarks_{name}", path)
    if spec is None or spec.loader is None or not path.exists():
        raise ImportError(f"there is no {path}", name=f"benchmarks/{name}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


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


def floor(n: int, lanes: int, T: int) -> Contest:
    """The driver on ``lanes`` series of an ARX(n/2, n/2) against both floors."""
    module = source_benchmark("kernel")
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
        "the compiled loop alone, ARX memory included",
        ours,
        others,
    )

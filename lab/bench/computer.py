"""The computer that a benchmark ran on, and medians of jobs that take turns."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter

import numpy as np

LIBRARIES = ("driftfit", "numba", "numpy", "scipy")
PACKAGES = (
    "filterpy", "padasip", "river", "statsmodels", "pykalman", "simdkalman", "dynamax", "polars-ols", "linearmodels",
)  # fmt: skip
"""The extra ``peers``."""


def installed(package: str) -> str | None:
    """Version of a package; None when it is absent."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def computer() -> str:
    """Processor, cores and Python."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores; Python {platform.python_version()}"


def versions() -> str:
    """Versions of ours and of every peer; absent ones are marked."""
    return ", ".join(f"{name} {installed(name) or 'absent'}" for name in (*LIBRARIES, *PACKAGES))


def times(repeats: int, jobs: Sequence[Callable[[], object]]) -> list[float]:
    """Median seconds of each job over interleaved repeats, after one turn that is not counted."""
    for job in jobs:
        job()
    seconds = np.empty((repeats, len(jobs)))
    for i in range(repeats):
        for j, job in enumerate(jobs):
            start = perf_counter()
            job()
            seconds[i, j] = perf_counter() - start
    return [float(median) for median in np.median(seconds, axis=0)]


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of a page; the first column is text, the others are numbers."""
    rule = [":--", *["--:"] * (len(heads) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, rule, *rows))

"""Time and memory of `driftfit identify` with its page on 10,000 rows and six inputs, as a new user meets them.

The command runs twice in a process of its own: with an empty cache of compiled code, and again. "seconds" are those of
the clock, "processor" those of all its processes together, which other programs change less: two share the first call.
"memory" is the peak of the largest process. The code of Python itself is compiled before, as by an installation.

Run: python benchmarks/identify_time.py    # --quick: a short record, and the cache as it is
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
import polars as pl
from scipy import signal

ROWS, INPUTS = 10_000, 6


def record(rows: int) -> pl.DataFrame:
    """Two of six inputs matter; the gain of one jumps by 1.8."""
    rng = np.random.default_rng(7)
    U = rng.normal(size=(rows, INPUTS))
    U[:, ::2] = signal.lfilter([np.sqrt(1.0 - 0.81)], [1.0, -0.9], U[:, ::2], axis=0)
    gain, y = np.where(np.arange(rows) > 0.6 * rows, 1.8, 1.0), rng.normal(size=rows)
    for t in range(5, rows):
        y[t] += 0.7 * y[t - 1] + 0.6 * gain[t] * U[t - 5, 2] + 0.5 * U[t - 2, 5]
    return pl.DataFrame({"time": np.arange(rows), "flow": y, **{f"u{j + 1}": u for j, u in enumerate(U.T)}})


def main() -> None:
    """Print a row for an empty cache and one for the next call."""
    quick = "--quick" in sys.argv
    with TemporaryDirectory() as folder:
        record(500 if quick else ROWS).write_csv(Path(folder) / "plant.csv")
        own = {"NUMBA_CACHE_DIR": f"{folder}/code", "PYTHONPYCACHEPREFIX": f"{folder}/python"}
        env = {key: text for key, text in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        env |= {} if quick else own
        command = [sys.executable, "-m", "driftfit", "identify", "plant.csv", "--y", "flow", "--page", "page.html"]
        drawn = "import driftfit.cli, matplotlib.figure, matplotlib.backends.backend_svg"
        subprocess.run([sys.executable, "-c", drawn], cwd=folder, env=env, check=True)
        print(f"{'cache':14}{'seconds':>9}{'processor':>11}{'memory, MB':>12}")
        for cache in ("filled",) if quick else ("empty", "filled"):
            before, began = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter()
            subprocess.run([*command, "--quiet"], cwd=folder, env=env, check=True, stdout=subprocess.DEVNULL)
            after, seconds = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter() - began
            used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            print(f"{cache:14}{seconds:9.1f}{used:11.1f}{after.ru_maxrss / 1024:12.0f}", flush=True)


if __name__ == "__main__":
    main()

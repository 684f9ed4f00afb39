"""The cost of a package before it runs: import, first result, disk space.

Each figure is the time of a separate process in which numpy is already imported; processes take turns and medians are
reported. The first result is the last estimate from a thousand samples of a regression with four parameters, by the
package's Kalman filter if it has one. Ours is shown with an empty cache of compiled code, which happens once per
computer, and with a warm one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, distribution
from statistics import median
from typing import NamedTuple

from lab.bench.computer import installed
from lab.bench.contest import need

HEAD = """
import numpy as np, time
rng = np.random.default_rng(1)
phi, y, I = rng.normal(size=(1000, 4)), rng.normal(size=1000), np.eye(4)
start = time.perf_counter()
{importing}
imported = time.perf_counter()
{work}
print(imported - start, time.perf_counter() - start)
"""

PROGRAMS: dict[str, tuple[str, str]] = {
    "driftfit": (
        "from driftfit import Kalman, Regression, track",
        "track(Regression(4), Kalman(q=1e-4, r=0.01, p0=10.0), y, phi)",
    ),
    "filterpy": (
        "from filterpy.kalman import KalmanFilter",
        "f = KalmanFilter(4, 1); f.F, f.Q = I, 1e-4 * I\n"
        "for a, h in zip(y, phi[:, None]): f.predict(); f.update(a, H=h)",
    ),
    "padasip": (
        "from padasip.filters import FilterRLS",
        "f = FilterRLS(4, mu=0.99, w='zeros')\nfor a, h in zip(y, phi): f.adapt(a, h)",
    ),
    "river": (
        "from river.linear_model import LinearRegression",
        "f = LinearRegression()\nfor a, h in zip(y.tolist(), phi.tolist()): f.learn_one(dict(enumerate(h)), a)",
    ),
    "statsmodels": ("import statsmodels.api as sm", "sm.RecursiveLS(y, phi).fit()"),
    "pykalman": ("from pykalman import KalmanFilter", "KalmanFilter(I, phi[:, None], 1e-4 * I).filter(y[:, None])"),
    "simdkalman": (
        "from simdkalman.primitives import predict, update",
        "m, P = np.zeros((4, 1)), I\nfor a, h in zip(y[:, None, None], phi[:, None]):\n"
        "    m, P = update(*predict(m, P, I, 1e-4 * I), h, np.eye(1), a)",
    ),
    "dynamax": (
        "import jax.numpy as jnp\nfrom dynamax.linear_gaussian_ssm import lgssm_filter\n"
        "from dynamax.linear_gaussian_ssm.inference import make_lgssm_params",
        "J = jnp.eye(4); p = make_lgssm_params(jnp.zeros(4), J, J, 1e-4 * J, jnp.asarray(phi[:, None]), jnp.eye(1))\n"
        "lgssm_filter(p, jnp.asarray(y[:, None])).filtered_means.block_until_ready()",
    ),
    "polars-ols": (
        "import polars as pl, polars_ols as ols",
        "d = pl.DataFrame({'y': y} | {f'x{i}': phi[:, i].copy() for i in range(4)})\n"
        "d.select(ols.compute_recursive_least_squares('y', 'x0', 'x1', 'x2', 'x3', mode='coefficients'))",
    ),
}
"""(imports, work) of each package."""


class Start(NamedTuple):
    """Seconds to import, and to the first result; MB on disk alone, and with everything that it needs besides numpy."""

    name: str
    seconds_import: float
    seconds_first: float
    own: float
    closure: float


def started(package: str, cache: str) -> tuple[float, float]:
    """(seconds to import, seconds to the first result) of a fresh process that has its compiled code in ``cache``."""
    importing, work = PROGRAMS[package]
    code = HEAD.format(importing=importing, work=work)
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], check=True, capture_output=True, text=True, env=environment
    )
    seconds = [float(value) for value in done.stdout.split()[-2:]]
    return seconds[0], seconds[1]


def starts(repeats: int) -> tuple[list[Start], list[str]]:
    """Every package that is installed, and the names of those that are not."""
    there = [package for package in PROGRAMS if installed(package)]
    with tempfile.TemporaryDirectory() as warm:
        cold = []
        for _ in range(min(repeats, 3)):
            with tempfile.TemporaryDirectory() as empty:
                cold.append(started("driftfit", empty))
        turns = [{package: started(package, warm) for package in there} for _ in range(repeats + 1)][1:]
    rows = [_row("driftfit, nothing compiled yet", "driftfit", cold)]
    rows += [_row(package, package, [turn[package] for turn in turns]) for package in there]
    return rows, [package for package in PROGRAMS if not installed(package)]


def _row(name: str, package: str, seconds: list[tuple[float, float]]) -> Start:
    imports, firsts = zip(*seconds, strict=True)
    return Start(name, median(imports), median(firsts), megabytes({package}), megabytes(needed(package)))


def needed(package: str) -> set[str]:
    """A package and all its requirements, by the metadata of installed packages; numpy left out."""
    Requirement = need("packaging.requirements", "Requirement")
    found: set[str] = set()
    waiting = [package]
    while waiting:
        name = waiting.pop().lower().replace("_", "-")
        if name in found or name == "numpy":
            continue
        try:
            requires = distribution(name).requires or []
        except PackageNotFoundError:  # an optional one that is not here
            continue
        found.add(name)
        parsed = [Requirement(line) for line in requires]
        waiting += [each.name for each in parsed if each.marker is None or each.marker.evaluate({"extra": ""})]
    return found


def megabytes(packages: set[str]) -> float:
    """Size of the files of installed packages, in MB; for a source tree that is linked in, of the tree's package."""
    total = 0
    for package in packages:
        files = [file for file in distribution(package).files or [] if not str(file).endswith(".pyc")]
        total += sum(
            os.path.getsize(str(path)) for path in (file.locate() for file in files) if os.path.exists(str(path))
        )
        if package == "driftfit" and total < 100_000:
            total += _tree(os.path.dirname(os.path.dirname(__file__)))
    return total / 1e6


def _tree(folder: str) -> int:
    """Bytes of the files below a folder, compiled ones left out."""
    return sum(
        os.path.getsize(os.path.join(place, name))
        for place, _, names in os.walk(folder)
        for name in names
        if not name.endswith((".pyc", ".nbi", ".nbc"))
    )

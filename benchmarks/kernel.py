"""Speed of the kernel against a loop in C, against streaming its bytes, against peers, and of a second process.

    python -m benchmarks.kernel                every part, about two minutes
    python -m benchmarks.kernel --part record --part lanes --quick

Every figure is a ratio of medians: what is compared takes turns within one run, so that a busy machine slows both. No
accuracy is measured here, except that the loop in C must give the same numbers before it is timed.
"""

import os

for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import ctypes
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import llvmlite.binding as llvm
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from driftfit import ARX, Kalman, Live
from driftfit.data.record import Known
from driftfit.engine.drivers import drivers
from driftfit.engine.kernel import Driver
from driftfit.engine.tiles import make_tile, output_type
from lab.bench.computer import computer, installed, times

HERE = Path(__file__).parent
SEED = 1
WIDTH = 32
PARTS = ("record", "lanes", "live", "process")


class Row(NamedTuple):
    """One comparison: times in nanoseconds, ``ratio`` and the bound that it must keep."""

    what: str
    ours: str
    other: str
    ratio: float
    target: float
    least: bool = False  # the target is a least, not a most

    @property
    def met(self) -> bool:
        return self.ratio >= self.target if self.least else self.ratio <= self.target


def signals(T: int, *lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """A stable ARX(1, 1) driven by noise, every hundredth output missing."""
    rng = np.random.default_rng(SEED)
    u, y = rng.normal(size=(T, *lanes)), 0.1 * rng.normal(size=(T, *lanes))
    for t in range(1, T):
        y[t] += 0.7 * y[t - 1] + u[t - 1]
    y[rng.random(y.shape) < 0.01] = np.nan
    return y, u


class Tile:
    """`drivers(...).run` on L series of T samples, past the start."""

    def __init__(self, n: int, L: int, T: int) -> None:
        model, tracker = ARX(n // 2, n - n // 2).bind(1), Kalman(q=1e-4, r=0.01)
        self.y, self.u = signals(T, L)
        self.known = np.ascontiguousarray(np.broadcast_to(Known.of().columns[:, :, None], (1, 3, L)))
        self.tile = make_tile(n, 1, model.memory(), [tracker.state_for(model)] * L)
        self.out = np.empty(T, output_type(self.tile))
        self._run = drivers(model.steps, tracker.steps_for(model)).run
        self.run()
        assert (self.tile["rank"] == n).all()

    def run(self) -> None:
        self._run(self.tile, self.y, self.u[:, None], self.known, self.out)


class CFilter:
    """The loop of filter.c, its state copied from a tile of one lane."""

    def __init__(self, tile: Tile, folder: str) -> None:
        self.tile = tile
        n = tile.tile["theta"].shape[1]
        na, nb = n // 2, n - n // 2
        target = Path(folder) / f"filter{n}.so"
        flags = ["-O3", "-march=native", "-shared", "-fPIC", f"-DNA={na}", f"-DNB={nb}"]
        subprocess.run(["gcc", *flags, str(HERE / "filter.c"), "-o", str(target), "-lm"], check=True)
        self._run = ctypes.CDLL(str(target)).run
        names = ("theta", "P", "q", "r", "y_lag", "u_lag", "filled")
        parts = {name: tile.tile[name][0, ..., 0] for name in names}
        parts["u_lag"] = parts["u_lag"][0, :nb]  # the tile keeps one place more, for a present input
        self.state = np.concatenate([np.ravel(parts[name]) for name in names])
        self.out = np.empty_like(tile.out)

    def run(self) -> None:
        t = self.tile
        self._run(*(p if isinstance(p, ctypes.c_long) else ctypes.c_void_p(p.ctypes.data)
                    for p in (self.state, ctypes.c_long(len(t.y)), t.y, t.u, self.out)))  # fmt: skip

    def check(self) -> None:
        """Raise unless both give the same numbers."""
        self.tile.run()
        self.run()
        for name in self.out.dtype.names or ():
            np.testing.assert_allclose(self.out[name], self.tile.out[name], rtol=1e-9, atol=1e-9, err_msg=name)


def record(quick: bool) -> Iterator[Row]:
    """One series against a loop in C with fixed n."""
    T, repeats = (2_000, 3) if quick else (20_000, 41)
    if shutil.which("gcc") is None:
        print("record: skipped, there is no gcc to compile the loop in C.")
        return
    with tempfile.TemporaryDirectory() as folder:
        for n in (2, 4) if quick else (2, 4, 6, 10):
            tile = Tile(n, 1, T)
            loop = CFilter(tile, folder)
            loop.check()
            ours, other = (1e9 * seconds / T for seconds in times(repeats, (tile.run, loop.run)))
            yield Row(f"n = {n}, L = 1, against C", f"{ours:.1f} ns", f"{other:.1f} ns", ours / other, 1.5)


@Driver
def stream(y: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
    """Read y and u and write as many numbers as the driver does, and nothing else."""
    for t in range(out.shape[0]):
        for k in range(out.shape[1]):
            for l in range(out.shape[2]):
                out[t, k, l] = y[t, l] + u[t, l]


def lanes(quick: bool) -> Iterator[Row]:
    """Thirty-two series in a tile against streaming the same bytes, and against one series."""
    T, repeats = (100, 3) if quick else (2_000, 41)
    for n in (2, 4) if quick else (2, 4, 6, 8, 10):
        tile, single = Tile(n, WIDTH, T), Tile(n, 1, T * WIDTH)
        copy = tile.out.view(np.float64).reshape(T, -1, WIDTH).copy()
        seconds = times(repeats, (tile.run, single.run, lambda: stream(tile.y, tile.u, copy)))  # noqa: B023
        ours, one, floor = (1e9 * s / (T * WIDTH) for s in seconds)
        if n == 4:
            yield Row(f"n = {n}, L = 32, against its bytes", f"{ours:.2f} ns", f"{floor:.2f} ns", ours / floor, 3.0)
        bound = 0.5 if n <= 8 else np.inf
        yield Row(f"n = {n}, L = 32, against L = 1", f"{ours:.2f} ns", f"{one:.2f} ns", ours / one, bound)


def live(quick: bool) -> Iterator[Row]:
    """One update from Python at n = 4 against padasip and filterpy, which are handed the regressors."""
    try:
        from filterpy.kalman import KalmanFilter
        from padasip.filters import FilterRLS
    except ImportError as missing:
        print(f"live: skipped, {missing.name} is not installed (pip install 'driftfit[peers]').")
        return
    T, repeats = (200, 3) if quick else (2_000, 21)
    y, u = signals(T)
    y = np.nan_to_num(y)
    phi = np.column_stack([np.roll(y, 1), np.roll(y, 2), np.roll(u, 1), np.roll(u, 2)])
    outputs, floats, arrays = y.tolist(), u.tolist(), list(u[:, None])
    ours, rls, filterpy = Live(ARX(2, 2), Kalman(q=1e-4, r=0.01)), FilterRLS(4, mu=0.99), KalmanFilter(4, 1)
    filterpy.F, filterpy.Q, filterpy.R = np.eye(4), 1e-4 * np.eye(4), np.array([[0.01]])

    def through(inputs: list[object]) -> Callable[[], None]:
        def job() -> None:
            for value, present in zip(outputs, inputs, strict=True):
                ours.update(value, present)

        return job

    def padasip_job() -> None:
        for value, row in zip(outputs, phi, strict=True):
            rls.predict(row)
            rls.adapt(value, row)

    def filterpy_job() -> None:
        for value, row in zip(outputs, phi[:, None, :], strict=True):
            filterpy.predict()
            filterpy.update(value, H=row)

    jobs = through(arrays), through(floats), padasip_job, filterpy_job
    ns = [1e9 * s / T for s in times(repeats, jobs)]
    for name, other in (("padasip FilterRLS", ns[2]), ("filterpy KalmanFilter", ns[3])):
        for kind, mine, least in (("an array", ns[0], 15.0), ("a float", ns[1], 20.0)):
            yield Row(
                f"update, u {kind}, against {name}", f"{mine:.0f} ns", f"{other:.0f} ns", other / mine, least, True
            )


def fresh(T: int, cache: dict[str, str]) -> dict[str, float]:
    """What benchmarks/fresh.py measured in a process of its own."""
    environment = os.environ | cache
    command = [sys.executable, str(HERE / "fresh.py"), str(T)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    result: dict[str, float] = json.loads(done.stdout)
    return result


def process(quick: bool) -> Iterator[Row]:
    """A second process, and memory."""
    short, long = (1_000, 10_000) if quick else (100_000, 1_000_000)
    with tempfile.TemporaryDirectory() as empty:
        cache = {} if quick else {"NUMBA_CACHE_DIR": empty}
        first, second, large = fresh(short, cache), fresh(short, cache), fresh(long, cache)
    counts = [f"{run['compiled']:.0f}" for run in (second, first)]
    share = second["compiled"] / max(1.0, first["compiled"])
    yield Row("functions compiled, second process against first", *counts, share, 0.0)
    seconds = [f"{run['seconds']:.2f} s" for run in (second, first)]
    yield Row("imports and first result, second against first", *seconds, second["seconds"] / first["seconds"], np.inf)
    loads = second["seconds"] / second["numba"]
    yield Row("second process against importing Numba", seconds[0], f"{second['numba']:.2f} s", loads, np.inf)
    growth = (large["extra"] - second["extra"]) / (long - short)
    held = [f"{run['extra'] / 2**20:.1f} MiB" for run in (large, second)]
    yield Row(f"memory beyond in and out, T = {long:,} against {short:,}; bytes a sample", *held, growth, 0.5)


def setting() -> str:
    """What this ran on."""
    packages = ("driftfit", "numba", "llvmlite", "numpy", "padasip", "filterpy")
    versions = ", ".join(f"{name} {installed(name) or 'absent'}" for name in packages)
    return f"{computer()}, {llvm.get_host_cpu_name()}; {versions}; seed {SEED}"


def table(title: str, rows: Iterator[Row]) -> Table:
    """One part as a table."""
    shown = Table(title=title, title_justify="left")
    for heading in ("what", "ours", "other", "ratio", "target", "met"):
        shown.add_column(heading, justify="left" if heading == "what" else "right")
    for row in rows:
        guarded = np.isfinite(row.target)
        target = f"{'>=' if row.least else '<='} {row.target:g}" if guarded else ""
        met = ("yes" if row.met else "NO") if guarded else ""
        shown.add_row(row.what, row.ours, row.other, f"{row.ratio:.2f}", target, met)
    return shown


def main(
    part: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(PARTS)}; all by default.")] = None,
    quick: Annotated[bool, typer.Option(help="Small sizes and the cache that is there, to see that it works.")] = False,
) -> None:
    """Print one table per part."""
    console = Console(width=120)
    console.print(setting())
    measure = {"record": record, "lanes": lanes, "live": live, "process": process}
    for name in part or PARTS:
        console.print(table((measure[name].__doc__ or "").strip(), measure[name](quick)))


if __name__ == "__main__":
    typer.run(main)

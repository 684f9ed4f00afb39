"""What a user waits for: records, streams and batches through public calls, against loops in C and against peers.

    python -m benchmarks.end_to_end                  records, live, the default tracker at several sizes
    python -m benchmarks.end_to_end live --quick

The model is ARX(2, 2), n = 4, tracked by Kalman(q=1e-4, r=0.01); one thread. The loop in C (benchmarks/filter.c) writes
the same results into memory that it allocates at every call, as `track` does. What is compared takes turns; figures are
the processor time that one turn in twenty needs at most, so that other programs on the machine disturb them as little
as possible.
"""

import os

for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import ctypes
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import process_time_ns
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from driftfit import ARX, AdaptiveKalman, Kalman, Live, track

HERE = Path(__file__).parent
MODEL, TRACKER = ARX(2, 2), Kalman(q=1e-4, r=0.01)
N = 4
BUDGET = 1_000_000
"""Samples over which the turns of one comparison are spread, at least five turns."""


def undisturbed(jobs: Sequence[Callable[[], object]], turns: int) -> list[float]:
    """Nanoseconds of processor time of each job, all taking turns: those that one turn in twenty needs at most.

    The very least may be wrong by a third, because the clock is corrected while a turn runs.
    """
    taken = np.empty((len(jobs), turns))
    for job in jobs:
        job()
    for turn in range(turns):
        for k, job in enumerate(jobs):
            begun = process_time_ns()
            result = job()
            taken[k, turn] = process_time_ns() - begun
            del result
    return np.quantile(taken, 0.05, axis=1).tolist()  # type: ignore[no-any-return]


def signals(T: int) -> tuple[np.ndarray, np.ndarray]:
    """A stable ARX(1, 1) driven by noise, every hundredth output missing."""
    rng = np.random.default_rng(1)
    u, v = rng.standard_normal(T), 0.1 * rng.standard_normal(T)
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + u[t - 1] + v[t]
    y[rng.random(T) < 0.01] = np.nan
    return y, u


class Loop:
    """The loop of filter.c from a diffuse start, in memory of its own."""

    def __init__(self, folder: str, name: str, fields: int, real: type, *flags: str) -> None:
        target = Path(folder) / f"{name}.so"
        options = ["-O3", "-march=native", "-shared", "-fPIC", "-DNA=2", "-DNB=2", *flags]
        subprocess.run(["gcc", *options, str(HERE / "filter.c"), "-o", str(target), "-lm"], check=True)
        self._run = ctypes.CDLL(str(target)).run
        self._fields, self._real = fields, real
        start = np.concatenate([np.zeros(N), 1e6 * np.eye(N).ravel(), np.full(N, 1e-4), [0.01], np.full(4, np.nan)])
        self._start = np.append(start, 0.0)

    def over(self, y: np.ndarray, u: np.ndarray) -> Callable[[], np.ndarray]:
        """The loop over these signals: only what a program in C does at every call is left to the call."""
        run, T, size = self._run, len(y), len(y) * self._fields * np.dtype(self._real).itemsize
        state, memory = ctypes.c_char * self._start.nbytes, ctypes.c_char * size
        samples, *signals = ctypes.c_long(T), ctypes.c_void_p(y.ctypes.data), ctypes.c_void_p(u.ctypes.data)

        def job() -> np.ndarray:
            out = np.empty((T, self._fields), self._real)
            run(state.from_buffer_copy(self._start), samples, *signals, memory.from_buffer(out))
            return out

        return job


def records(quick: bool) -> Iterator[tuple[str, ...]]:
    """Records: one call of `track`, everything included, and the loop in C with the same results."""
    yield "T", "kept", "us", "ns a sample", "bytes a sample", "C, ns a sample", "times C"
    kinds = {
        "std": ({}, 12, np.float64, ()),
        "std, float32": ({"dtype": "float32"}, 12, np.float32, ("-DREAL=float",)),
        "theta": ({"keep": "theta"}, 4, np.float64, ("-DTHETA_ALONE",)),
        "theta, float32": ({"keep": "theta", "dtype": "float32"}, 4, np.float32, ("-DTHETA_ALONE", "-DREAL=float")),
    }
    with tempfile.TemporaryDirectory() as folder:
        loops = {name: Loop(folder, f"loop{k}", *kind[1:3], *kind[3]) for k, (name, kind) in enumerate(kinds.items())}
        for T in (500, 1000) if quick else (500, 1000, 10_000, 100_000, 1_000_000, 10_000_000):
            y, u = signals(T)
            for name, (options, fields, real, _) in kinds.items():
                if T < 100_000 and name != "std":
                    continue
                found, loop = track(MODEL, TRACKER, y, u, **options), loops[name].over(y, u)
                # the loop begins with a variance of 1e6, which half of its digits do not survive
                np.testing.assert_allclose(found.theta[-1], loop()[-1, :N], rtol=1e-2, atol=1e-3)
                ours, c = undisturbed(
                    (lambda: track(MODEL, TRACKER, y, u, **options), loop),  # noqa: B023
                    10 if quick else max(5, min(2000, 3 * BUDGET // T)),
                )
                size = fields * np.dtype(real).itemsize
                yield (f"{T:,}", name, f"{ours / 1e3:,.1f}", f"{ours / T:.1f}", f"{size}", f"{c / T:.1f}",
                       f"{ours / c:.2f}")  # fmt: skip


def peers(y: list[float], phi: np.ndarray) -> dict[str, Callable[[], None]]:
    """A pass over the samples by padasip and filterpy, where they are installed; they are handed the regressors."""
    try:
        from filterpy.kalman import KalmanFilter
        from padasip.filters import FilterRLS
    except ModuleNotFoundError:
        return {}
    rls, kalman = FilterRLS(N, mu=0.99), KalmanFilter(N, 1)
    kalman.F, kalman.Q, kalman.R = np.eye(N), 1e-4 * np.eye(N), np.array([[0.01]])

    def by_padasip() -> None:
        for value, row in zip(y, phi, strict=True):
            rls.predict(row)
            rls.adapt(value, row)

    def by_filterpy() -> None:
        for value, row in zip(y, phi[:, None, :], strict=True):
            kalman.predict()
            kalman.update(value, H=row)

    return {"padasip FilterRLS": by_padasip, "filterpy KalmanFilter": by_filterpy}


def live(quick: bool) -> Iterator[tuple[str, ...]]:
    """Streams: one call of `update` for each sample, and batches."""
    T, turns = (100, 3) if quick else (1000, 150)
    y, u = signals(T)
    y = np.nan_to_num(y)
    phi = np.column_stack([np.roll(y, 1), np.roll(y, 2), np.roll(u, 1), np.roll(u, 2)])
    outputs, floats, clock = y.tolist(), u.tolist(), [0.0]
    arrays = list(u[:50, None]) * (T // 50)  # few, so that they are in the cache, as an array that was just made
    stream = {name: Live(MODEL, TRACKER) for name in ("float", "array", "time", "batch", "timed")}
    adaptive = Live(MODEL, AdaptiveKalman())

    def each(one: Live, inputs: list[object]) -> Callable[[], None]:
        def job() -> None:
            update = one.update
            for value, present in zip(outputs, inputs, strict=True):
                update(value, present)

        return job

    def timed() -> None:
        update, at = stream["time"].update, clock[0]
        for value, present in zip(outputs, floats, strict=True):
            at += 1.0
            update(value, present, at)
        clock[0] = at

    def std() -> None:
        for _ in outputs:
            stream["float"].std  # noqa: B018

    def batches(size: int) -> Callable[[], None]:
        def job() -> None:
            for k in range(0, T, size):
                stream["batch"].update_many(y[k : k + size], u[k : k + size])

        return job

    jobs = {
        "update, u a float": each(stream["float"], floats),
        "update, u an array": each(stream["array"], arrays),
        "update, u a float, with its time": timed,
        "update of AdaptiveKalman, u a float": each(adaptive, floats),
        "reading live.std": std,
        "update_many, batches of 10": batches(10),
        "update_many, batches of 100": batches(100),
        "update_many, batches of 1000": batches(1000),
    }
    others = peers(outputs, phi)
    yield "a sample by", "ns", *(f"{name.split()[0]}, times" for name in others)
    taken = [ns / T for ns in undisturbed((*jobs.values(), *others.values()), turns)]
    beside = taken[len(jobs) :]
    for name, ns in zip((*jobs, *others), taken, strict=True):
        yield name, f"{ns:.0f}", *(f"{peer / ns:.1f}" for peer in beside)


def default(quick: bool) -> Iterator[tuple[str, ...]]:
    """One update of AdaptiveKalman from Python, u a float."""
    T, turns = (100, 3) if quick else (1000, 60)
    y, u = (part.tolist() for part in signals(T))
    yield "parameters", "us"
    for n in (4,) if quick else (2, 4, 8, 12):
        one = Live(ARX(n // 2, n // 2), AdaptiveKalman())

        def job(one: Live = one) -> None:
            for value, present in zip(y, u, strict=True):
                one.update(value, present)

        yield str(n), f"{undisturbed([job], turns)[0] / T / 1e3:.1f}"


PARTS = {"records": records, "live": live, "default": default}


def main(
    part: Annotated[list[str] | None, typer.Argument(help=f"Of {', '.join(PARTS)}; all by default.")] = None,
    quick: Annotated[bool, typer.Option(help="Small sizes, to see that it works.")] = False,
) -> None:
    """Print one table per part."""
    console = Console(width=110)
    for name in part or PARTS:
        heads, *rows = PARTS[name](quick)
        table = Table(title=(PARTS[name].__doc__ or "").strip(), title_justify="left")
        for k, head in enumerate(heads):
            table.add_column(head, justify="right" if k else "left")
        for row in rows:
            table.add_row(*row)
        console.print(table)


if __name__ == "__main__":
    typer.run(main)

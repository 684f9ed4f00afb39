"""Size and speed of exported trackers: code, state, instructions on a Cortex-M4F, and time next to hand-written C.

    python -m benchmarks.embedded            four minutes
    python -m benchmarks.embedded --quick    one size, few samples, one tracker

The emulator reports what it executes, if it and the cross compiler are installed; `benchmarks/cortex_cycles.py` turns
that into cycles. The filter of filter.c is compiled with the same flags, for the controller and for this computer.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from benchmarks.cortex_cycles import counted
from driftfit import ARX, FLS, RLS, AdaptiveKalman, AugmentedFLS, Kalman
from driftfit.embedded import export_c

HERE = Path(__file__).parent
CORTEX = HERE.parent / "tests" / "cortex"
FLAGS = ["-std=c99", "-O3", "-fno-tree-vectorize", "-ffp-contract=off", "-shared", "-fPIC"]
"""Vectorisation makes both slower: numbers stored one by one are read four at once, before the stores have finished."""
M4F = ["-std=c99", "-O2", "-ffp-contract=off", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]

LOOP = """
#include "tracker.c"
typedef struct { double theta[TRACKER_PARAMETERS], var[TRACKER_PARAMETERS], y_hat, e, s, ok; } row;
static tracker_state state;
void bench_begin(void) { tracker_init(&state); }
void bench_run(long T, const double *y, const double *u, row *out) {
    for (long t = 0; t < T; t++) {
        tracker_step step = tracker_update(&state, y[t], u + t);
        for (int i = 0; i < TRACKER_PARAMETERS; i++) {
            out[t].theta[i] = state.theta[i];
            out[t].var[i] = state.var[i];
        }
        out[t].y_hat = step.y_hat; out[t].e = step.e; out[t].s = step.variance; out[t].ok = step.ok;
    }
}
"""

COUNT = """
#ifdef BY_HAND
#include <math.h>
#ifdef TRACKER_SINGLE
#define double float
#define fabs fabsf
#endif
#include "filter.c"
typedef double tracker_real;
static filter state;
static row result;
#define UPDATE(y, u) run(&state, 1, &(y), (u), &result)
static void begin(void) {
    for (int i = 0; i < N; i++) { state.P[i][i] = 1; state.q[i] = (double)1e-4; }
    state.r = (double)0.01;
}
#else
#include "tracker.h"
static tracker_state state;
#define UPDATE(y, u) tracker_update(&state, (y), (u))
static void begin(void) { tracker_init(&state); }
#endif
static tracker_real noise(void) {
    static unsigned long seed = 1;
    seed = (seed * 1664525ul + 1013904223ul) & 0xfffffffful;
    return (tracker_real)(seed >> 16) / (tracker_real)65536 - (tracker_real)0.5;
}
int main(void) {
    static tracker_real y[LAST], u[LAST];
    for (int t = 0; t < LAST; t++) { y[t] = noise(); u[t] = noise(); }
    begin();
    for (int t = 0; t < SAMPLES; t++) UPDATE(y[t], u + t);
    return 0;
}
"""
KALMAN = Kalman(q=1e-4, r=0.01, p0=1.0)
FIRST, LAST = 32, 36
"""The samples between are counted, as the difference of two programs; those before are judged one by one."""


def emulated(folder: Path, sources: list[str], flags: list[str]) -> tuple[int, int] | None:
    """(instructions, cycles at most) per update on the emulated controller; None if there is no emulator."""
    if shutil.which("arm-none-eabi-gcc") is None or shutil.which("qemu-system-arm") is None:
        return None
    (folder / "count.c").write_text(COUNT)
    start = ["-nostartfiles", "--specs=rdimon.specs", "-T", str(CORTEX / "memory.ld"), str(CORTEX / "start.c")]
    elf = str(folder / "count.elf")
    command = ["arm-none-eabi-gcc", *M4F, *flags, *start, "-Wl,--no-warn-rwx-segments", "-o", elf, f"-DLAST={LAST}"]
    runs = []
    for samples in (FIRST, LAST):
        more = [f"-DSAMPLES={samples}", *sources, str(folder / "count.c"), "-lm"]
        subprocess.run([*command, *more], check=True)
        runs.append(counted(elf))
    before, after = runs
    return (after[0] - before[0]) // (LAST - FIRST), (after[1] - before[1]) // (LAST - FIRST)


def by_hand(folder: Path, n: int, single: bool) -> tuple[int, int] | None:
    """(instructions, cycles at most) of filter.c."""
    size = [f"-DNA={n // 2}", f"-DNB={n - n // 2}", "-DBY_HAND", f"-I{HERE}", "-w"]
    return emulated(folder, [], [*size, *(["-DTRACKER_SINGLE", "-fsingle-precision-constant"] if single else [])])


def exported(folder: Path, single: bool) -> list[str]:
    """Bytes of code and constants, instructions and cycles per update, of the tracker in a folder."""
    flags = ["-DTRACKER_SINGLE"] if single else []
    count = emulated(folder, [str(folder / "tracker.c")], flags)
    if count is None:
        return ["-"] * 3
    target = str(folder / "tracker.o")
    command = ["arm-none-eabi-gcc", *M4F, *flags, "-c", "-o", target, str(folder / "tracker.c")]
    subprocess.run(command, check=True)
    sizes = subprocess.run(["arm-none-eabi-size", target], check=True, capture_output=True, text=True)
    return [sizes.stdout.splitlines()[1].split()[0], *map(str, count)]


def against_hand_written(folder: Path, n: int, T: int, repeats: int) -> tuple[float, float]:
    """Nanoseconds per update, the best of the repeats: exported, and filter.c; both must give the same numbers."""
    (folder / "loop.c").write_text(LOOP)
    ours, other = str(folder / "ours.so"), str(folder / "other.so")
    subprocess.run(["gcc", *FLAGS, "-o", ours, str(folder / "loop.c"), "-lm"], check=True, cwd=folder)
    half = [f"-DNA={n // 2}", f"-DNB={n - n // 2}"]
    subprocess.run(["gcc", *FLAGS, *half, "-o", other, str(HERE / "filter.c"), "-lm"], check=True)
    rng = np.random.default_rng(1)
    y, u = rng.normal(size=T), rng.normal(size=T)
    rows = [np.zeros((T, 2 * n + 4)) for _ in range(2)]
    tracker, written = ctypes.CDLL(ours), ctypes.CDLL(other)
    na, nb = n // 2, n - n // 2
    start = np.concatenate([np.zeros(n), np.eye(n).ravel(), np.full(n, 1e-4), [0.01], np.full(na, np.nan),
                            np.full(nb, np.nan), [0.0]])  # fmt: skip

    def first() -> None:
        tracker.bench_begin()
        tracker.bench_run(ctypes.c_long(T), pointer(y), pointer(u), pointer(rows[0]))

    def second() -> None:
        state = start.copy()
        written.run(pointer(state), ctypes.c_long(T), pointer(y), pointer(u), pointer(rows[1]))

    times: list[list[float]] = [[], []]
    for _ in range(repeats):
        for job, taken in zip((first, second), times, strict=True):
            taken.append(timed(job) / T)
    np.testing.assert_allclose(rows[0][50:, :n], rows[1][50:, :n], atol=0.02)  # the start differs a little
    return min(times[0]), min(times[1])


def pointer(array: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def timed(job: Any) -> float:
    """Nanoseconds."""
    from time import perf_counter_ns

    begin = perf_counter_ns()
    job()
    return float(perf_counter_ns() - begin)


def state_and_cost(model: ARX, tracker: Any) -> list[str]:
    """Bytes of state, bytes of code, instructions and cycles per update, in double and in single precision."""
    row = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        export_c(model, tracker, folder)
        result = (folder / "README.md").read_text().split("State: ")[1].split(" with")[0]
        states = [word for word in result.replace(",", "").split() if word.isdigit()]
        for single in (False, True):
            row += [states[single], *exported(folder, single)]
    return row


def against_filter(n: int) -> list[str]:
    """Cycles of filter.c, then those of the exported Kalman and their ratio, with and without the fixed rate."""
    row = [str(n)]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for single in (False, True):
            hand = by_hand(folder, n, single)
            row.append("-" if hand is None else str(hand[1]))
            for fixed_rate in (False, True):
                export_c(ARX(n // 2, n - n // 2), KALMAN, folder, fixed_rate=fixed_rate)
                cycles = exported(folder, single)[2]
                row += [cycles, "-" if hand is None else f"{int(cycles) / hand[1]:.2f}"]
    return row


def main(quick: Annotated[bool, typer.Option(help="One size, few samples, one tracker.")] = False) -> None:
    """Print the three tables."""
    out = Console(width=120)
    sizes = (4,) if quick else (2, 4, 6, 8)
    T, repeats = (2_000, 3) if quick else (20_000, 31)
    trackers = {"Kalman": KALMAN}
    if not quick:
        trackers |= {
            "AugmentedFLS": AugmentedFLS(10.0),
            "Kalman, sqrt": Kalman(q=1e-4, r=0.01, p0=1.0, form="sqrt"), "RLS": RLS(0.98), "FLS": FLS(100.0),
            "AdaptiveKalman": AdaptiveKalman(),
        }  # fmt: skip
    table = Table(title="On a Cortex-M4F, -O2", show_edge=False, box=SIMPLE_HEAD)
    numbers = ("state", "code", "instr.", "cycles")
    for head in ("tracker", "n", *numbers, *numbers):
        table.add_column(head, justify="left" if head == "tracker" else "right", no_wrap=True)
    for name, tracker in trackers.items():
        for n in sizes if name == "Kalman" else (4,):
            table.add_row(name, str(n), *state_and_cost(ARX(n // 2, n - n // 2), tracker))
    out.print(table)
    out.print("bytes of state and code, and per update; first in double precision, then in single (-DTRACKER_SINGLE)")
    ratios = Table(
        title="\nCycles per update on a Cortex-M4F, compared with filter.c", show_edge=False, box=SIMPLE_HEAD
    )
    for head in ("n", *("by hand", "Kalman", "ratio", "fixed rate", "ratio") * 2):
        ratios.add_column(head, justify="right", no_wrap=True)
    for n in sizes if quick else range(2, 9):
        ratios.add_row(*against_filter(n))
    out.print(ratios)
    timed = Table(title="\nOn this computer, compared with filter.c", show_edge=False, box=SIMPLE_HEAD)
    for head in ("n", "exported, ns", "by hand, ns", "ratio", "at most 1.3"):
        timed.add_column(head, justify="right")
    for n in sizes:
        with tempfile.TemporaryDirectory() as place:
            export_c(ARX(n // 2, n - n // 2), KALMAN, place)
            ours, other = against_hand_written(Path(place), n, T, repeats)
        kept = "yes" if ours <= 1.3 * other else "no"
        timed.add_row(str(n), f"{ours:.1f}", f"{other:.1f}", f"{ours / other:.2f}", kept)
    out.print(timed)


if __name__ == "__main__":
    typer.run(main)

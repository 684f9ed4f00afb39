"""Single against double precision of exported trackers, over simulated records.

    python -m benchmarks.embedded_single            a minute
    python -m benchmarks.embedded_single --quick    two records of 500 samples, of two trackers

The records are those of the self-test: a system whose gain doubles, with missing data, an outage and constant inputs.
The second table asks whether a difference comes from the precision or from the start: an `OutputError` is given outputs
in other units, once from its default start and once from estimates in these units, and the double-precision build also
gets readings that are wrong by one part in ten million.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import (
    ARX,
    FLS,
    RLS,
    AdaptiveKalman,
    AugmentedFLS,
    ExtendedKalman,
    HammersteinWiener,
    Kalman,
    OutputError,
    track,
)
from driftfit.embedded import export_c
from driftfit.embedded.project import record
from driftfit.models.hammerstein_wiener.basis import Polynomial

LOOP = """
#include "tracker.c"
void loop(long T, const double *y, const double *u, double *out) {
    static tracker_state state;
    tracker_init(&state);
    for (long t = 0; t < T; t++) {
        const tracker_real now[1] = {(tracker_real)u[t]};
        tracker_step step = tracker_update(&state, (tracker_real)y[t], now);
        *out++ = (double)step.y_hat;
        for (int i = 0; i < TRACKER_PARAMETERS; i++) *out++ = (double)state.theta[i];
        for (int i = 0; i < TRACKER_PARAMETERS; i++) *out++ = (double)state.var[i];
    }
}
"""

LINEAR, CURVED = ARX(2, 2), HammersteinWiener(2, 2, input=Polynomial(2), output=Polynomial(2))
TRACKERS = {
    "Kalman, p0": (LINEAR, Kalman(q=1e-3, r=0.1, p0=1.0)),
    "Kalman": (LINEAR, Kalman(q=1e-3, r=0.1)),
    "Kalman, sqrt": (LINEAR, Kalman(q=1e-3, r=0.1, form="sqrt")),
    "RLS": (LINEAR, RLS(0.98)),
    "RLS, directional": (LINEAR, RLS(0.98, kind="directional")),
    "FLS": (LINEAR, FLS(100.0)),
    "AugmentedFLS": (LINEAR, AugmentedFLS(1.0)),
    "AdaptiveKalman": (LINEAR, AdaptiveKalman()),
    "Kalman, HammersteinWiener": (CURVED, Kalman(q=1e-3, r=0.1)),
    "RLS, HammersteinWiener": (CURVED, RLS(0.98)),
    "ExtendedKalman": (CURVED, ExtendedKalman(q=1e-3, r=0.1)),
    "OutputError": (CURVED, OutputError(q=1e-3, r=0.1)),
}


def pointer(array: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def rows(folder: Path, n: int, y: Any, u: Any, single: bool) -> Any:
    """(T, 1 + 2 n): prediction, theta and variances of every sample."""
    target = folder / f"loop{int(single)}.so"
    if not target.exists():
        flags = ["-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC", *(["-DTRACKER_SINGLE"] if single else [])]
        (folder / "loop.c").write_text(LOOP)
        subprocess.run(["gcc", *flags, "-o", str(target), str(folder / "loop.c"), "-lm"], check=True)
    out = np.empty((len(y), 1 + 2 * n))
    ctypes.CDLL(str(target)).loop(ctypes.c_long(len(y)), pointer(y), pointer(u), pointer(out))
    return out


def differences(folder: Path, n: int, T: int, seed: int) -> tuple[float, float, float]:
    """Largest differences: of predictions to the std of y, of theta to the largest of theta, and to its std."""
    y, inputs = record(LINEAR.bind(1), T, seed)
    u = np.ascontiguousarray(inputs[:, 0])
    double, single = (rows(folder, n, y, u, narrow) for narrow in (False, True))
    assert np.array_equal(np.isnan(double[:, 0]), np.isnan(single[:, 0])), "the same samples are predicted"
    with np.errstate(invalid="ignore"):  # variances that are infinite in both
        theta, away = double[:, 1 : 1 + n], np.abs(double - single)
    std = np.sqrt(double[:, 1 + n :])
    relative = away[:, 1 : 1 + n][np.isfinite(std) & (std > 0.0)] / std[np.isfinite(std) & (std > 0.0)]
    predicted = float(np.nanmax(away[:, 0]) / np.std(y[np.isfinite(y)]))
    largest = float(np.max(relative)) if relative.size else np.nan
    return predicted, float(np.max(away[:, 1 : 1 + n]) / np.max(np.abs(theta))), largest


def of_scaled_outputs(T: int, scales: tuple[float, ...]) -> Table:
    """`OutputError` on outputs in other units."""
    model = HammersteinWiener(2, 2, input=Polynomial(2)).bind(1)
    names = OutputError().names_for(model)
    clean, inputs = record(LINEAR.bind(1), T)
    u = np.ascontiguousarray(inputs[:, 0])
    learned = track(model, OutputError(q=1e-3, r=0.1), clean, u).theta[-1]
    table = Table(title="\nOutputError, predictions / std of y", show_edge=False, box=SIMPLE_HEAD)
    for head in ("outputs times", "start", "single - double", "double - double of y (1 + 1e-7)", "error in double"):
        table.add_column(head, justify="left" if head == "start" else "right")
    rng = np.random.default_rng(0)
    for scale in scales:
        y, factors = clean * scale, np.array([scale if name.startswith("b") else 1.0 for name in names])
        moved = y * (1.0 + 1e-7 * rng.standard_normal(T))
        starts = {"default": {"q": 1e-3}, "in these units": {"q": 1e-3 * factors**2, "theta0": learned * factors}}
        for start, settings in starts.items():
            with tempfile.TemporaryDirectory() as place:
                export_c(model, OutputError(r=0.1 * scale**2, **settings), place)
                told = ((y, False), (y, True), (moved, False))
                double, single, other = (rows(Path(place), len(names), v, u, narrow)[:, 0] for v, narrow in told)
            std, error = np.std(y[np.isfinite(y)]), y - double
            error = error[np.isfinite(error)][T // 10 :]
            away = [np.nanmax(np.abs(double - one)) / std for one in (single, other)]
            table.add_row(
                f"{scale:g}", start, *(f"{one:.0e}" for one in away), f"{np.sqrt(np.mean(error**2)) / std:.2f}"
            )
    return table


def main(quick: Annotated[bool, typer.Option(help="Two records of 500 samples, of two trackers.")] = False) -> None:
    """Print both tables."""
    records, T = (2, 500) if quick else (20, 2_000)
    table = Table(
        title=f"Single against double precision, the largest of {records} x {T} samples",
        show_edge=False,
        box=SIMPLE_HEAD,
    )
    table.add_column("tracker")
    for head in ("predictions / std of y", "theta / largest theta", "theta / its std"):
        table.add_column(head, justify="right")
    for name, (model, tracker) in list(TRACKERS.items())[: 2 if quick else None]:
        bound = model.bind(1)
        with tempfile.TemporaryDirectory() as place:
            export_c(bound, tracker, place)
            n = len(tracker.names_for(bound))
            worst = np.max([differences(Path(place), n, T, seed) for seed in range(records)], axis=0)
        table.add_row(name, *("-" if np.isnan(one) else f"{one:.0e}" for one in worst))
    out = Console(width=110)
    out.print(table)
    out.print(of_scaled_outputs(T, (30.0,) if quick else (1.0, 30.0, 1000.0)))


if __name__ == "__main__":
    typer.run(main)

"""Single against double precision of exported trackers, over simulated records.

    python -m benchmarks.embedded_single            a minute
    python -m benchmarks.embedded_single --quick    two records of 500 samples

The records are those of the self-test: a system whose gain doubles, with missing data, an outage and constant inputs.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from driftfit import ARX, FLS, RLS, AdaptiveKalman, AugmentedFLS, ExtendedKalman, HammersteinWiener, Kalman, OutputError
from driftfit.embedded import export_c
from driftfit.embedded.selftest import record
from driftfit.models.hammerstein_wiener.curves.basis import Polynomial

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


def main(quick: Annotated[bool, typer.Option(help="Two records of 500 samples.")] = False) -> None:
    """Print the table."""
    records, T = (2, 500) if quick else (20, 2_000)
    table = Table(title=f"Single against double precision, the largest of {records} x {T} samples", show_edge=False)
    table.add_column("tracker")
    for head in ("predictions / std of y", "theta / largest theta", "theta / its std"):
        table.add_column(head, justify="right")
    for name, (model, tracker) in TRACKERS.items():
        bound = model.bind(1)
        with tempfile.TemporaryDirectory() as place:
            export_c(bound, tracker, place)
            n = len(tracker.names_for(bound))
            worst = np.max([differences(Path(place), n, T, seed) for seed in range(records)], axis=0)
        table.add_row(name, *("-" if np.isnan(one) else f"{one:.0e}" for one in worst))
    Console(width=110).print(table)


if __name__ == "__main__":
    typer.run(main)

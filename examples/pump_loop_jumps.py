"""The pump loop: valves that close, an unbalanced rotor, and the results of a bank of hypotheses.

flow_t on pressure, current and a constant; settings are fixed beforehand (`Bank()` without arguments). Prints for every
experiment the one-step errors, and those of persistence, a Kalman filter tuned on the first 200 samples, and RLS;
the coverage of the 95 % band; and alarms against the labels: by the probability of a jump at one instant, which is a
poor alarm for valves that take a minute to close, and by the window. The record (SKAB, GPL-3) is not in this project.
Run: python examples/pump_loop_jumps.py pump_loop_skab.csv [folder]
"""

import sys
from pathlib import Path

import numpy as np
import polars as pl

from driftfit import RLS, Bank, Beam, Kalman, Regression, Track, track, tune

REGRESSORS = ["pressure_bar", "current_A"]
TUNING, REACH = 200, 60
"""Samples for tuning, and the time after a label in which an alarm still belongs to it."""


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def detection(on: np.ndarray, anomaly: np.ndarray) -> tuple[int, int, float]:
    """(intervals found, intervals, false alarms per 1000 samples outside of them)."""
    edges = np.flatnonzero(np.diff(np.r_[0, anomaly, 0]))
    stretches = edges.reshape(-1, 2)
    onset = np.flatnonzero(on & ~np.r_[False, on[:-1]])
    onset = onset[onset >= TUNING]
    found = sum(bool(((onset >= a) & (onset < b)).any()) for a, b in stretches)
    caused = np.zeros(len(on), bool)
    for a, b in stretches:
        caused[a : b + REACH] = True
    free = ~caused
    return found, len(stretches), 1000.0 * int((~caused[onset]).sum()) / max(int(free[TUNING:].sum()), 1)


def main(path: str, folder: str | None = None) -> None:
    table = pl.read_csv(path)
    for name in table["experiment"].unique(maintain_order=True):
        part = table.filter(pl.col("experiment") == name)
        y, u = part["flow_lpm"].to_numpy(), part.select(REGRESSORS).to_numpy()
        anomaly = (part["anomaly"].fill_null(0.0).to_numpy() > 0.5).astype(int)
        model = Regression(REGRESSORS, intercept=True)
        tuned = tune(model, Kalman(), y[:TUNING], u[:TUNING]).tracker
        runs: dict[str, Track] = {
            "Bank()": track(model, Bank(reduce=Beam(9, window=8)), y, u),
            "Kalman, tuned": track(model, tuned, y, u),
            "RLS(0.98)": track(model, RLS(0.98), y, u),
        }
        rest = slice(TUNING, None)
        print(f"{name}: {len(y)} samples, {anomaly.mean():.0%} labelled")
        print(f"  persistence          one-step error {rms(np.diff(y)[TUNING - 1 :]):.3f}")
        for label, run in runs.items():
            inside = np.abs(run.innovation[rest]) < 1.96 * run.innovation_std[rest]
            print(f"  {label:<21}one-step error {rms(run.innovation[rest]):.3f}   band covers {inside.mean():.1%}")
        told = runs["Bank()"].hypotheses
        for label, on in (("one instant", told.change_prob > 0.5), ("window of 8", told.window > 0.5)):
            found, of, false = detection(np.nan_to_num(on).astype(bool), anomaly)
            print(f"  alarm, {label:<14}found {found} of {of}, {false:.1f} false per 1000 samples")
        if folder:
            runs["Bank()"].hypotheses.plot().savefig(Path(folder) / f"pump_{name}.png", dpi=110)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(*sys.argv[1:3])

"""The table of the reproduction: measured medians and worst seeds, with the reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.progress import track as progress
from rich.table import Table

from driftfit.engine.kernel import Array
from driftfit.systems.arc_furnace import furnace
from lab.reproduce.hammerstein_wiener import runs
from lab.reproduce.hammerstein_wiener.runs import Errors, FurnaceRun

ORDERS = (4, 5, 6)
CHECKED_UP_TO = 1.0
"""Medians above this are spikes or failures, and are not compared."""


@dataclass(frozen=True)
class Found:
    """Measured values, by example and by seed."""

    first: list[dict[str, Any]]
    second: list[dict[tuple[str, float], float]]
    third: list[dict[str, Any]]
    raw: dict[int, list[FurnaceRun]]
    legendre: list[FurnaceRun]
    bias: dict[str, float]
    fixes: dict[str, float]
    choices: dict[str, float]


ROWS: tuple[tuple[str, str, str, float | None, str], ...] = (
    ("1", "average", 'two-stage, "average"', 0.021, "11 to 37"),
    ("1", "svd", '"svd"', 0.020, "0.035"),
    ("1", "svd-joint", '"svd-joint"', 0.019, "0.033"),
    ("1", "gls", '"gls"', 0.017, "0.031"),
    ("1", "structured", 'Q of the shape of products, "gls"', 0.0153, "0.026"),
    ("1", "ekf", "EKF on minimal parameters", 0.0150, "0.0235"),
    ("1", "printed", "SVD as printed, no scale", 2.4, ""),
    ("1", "one-step", "one-step rms", 0.016, ""),
    ("1", "free run", 'free run rms, "gls"', 0.014, ""),
    ("3", "clean svd-joint", 'noise-free, "svd-joint"', 0.012, ""),
    ("3", "clean ekf", "noise-free, EKF", 0.009, ""),
    ("3", "noisy average", '20 dB, Q = 10, "average"', 0.55, "238"),
    ("3", "noisy svd-joint", '20 dB, Q = 10, "svd-joint"', 0.41, "3.4"),
    ("3", "noisy start", "20 dB, the start for ever", 0.38, ""),
    ("3", "slow svd-joint", '20 dB, Q/R = 1e-3, "svd-joint"', 0.096, "0.15"),
    ("3", "aware gls", '20 dB, noise-aware, "gls"', 0.078, ""),
    ("3", "aware ekf", "20 dB, noise-aware, EKF", 0.075, ""),
    ("3", "output error", "20 dB, output-error EKF from 300", 0.056, "0.074"),
    ("3", "nis", "20 dB, its mean NIS", 0.98, ""),
    ("3", "noisy one-step", "20 dB, one-step rms, clean output, Q/R = 1e3", 0.60, ""),
    ("3", "slow one-step", "20 dB, one-step rms, clean output, Q/R = 1e-3", 0.076, ""),
    ("3", "slow free run", "20 dB, free run rms, clean output", 0.060, ""),
)
"""(example, key, what, reference of the median, reference of the worst seed)."""
ARRIVALS = {
    ("two-stage", 0.01): "14", ("two-stage", 10.0): "14", ("two-stage", 1000.0): "16 (most 19)",
    ("ekf", 0.01): "94 (96 % of runs)", ("ekf", 10.0): "204", ("ekf", 1000.0): "fails in 92 % of runs",
    ("inflated", 0.01): "67", ("inflated", 10.0): "139", ("inflated", 1000.0): "370 (83 % of runs)",
}  # fmt: skip
BIAS = {"40 dB": 0.002, "30 dB": 0.018, "20 dB": 0.167, "10 dB": 0.82, "equation 0.05": 0.005, "equation 0.2": 0.089}
FIXES = {"least squares": 0.18, "output_error": 0.0}
CHOICES = {"noise-free": "10", "30 dB": "0.01", "20 dB": "0.001"}
RAW = {4: 0.36, 5: 0.43, 6: 0.47}


def measure(seeds: int, quick: bool = False) -> Found:
    """Run everything, or a part that costs little."""
    numbers = range(seeds)
    furnaces = [furnace(s) for s in range(min(seeds, 20))]
    return Found(
        [runs.first_example(s, quick) for s in progress(numbers, "example 1", transient=True)],
        [runs.second_example(s, quick) for s in progress(numbers, "example 2", transient=True)],
        [{} if quick else runs.third_example(s) for s in progress(numbers, "example 3", transient=True)],
        {q: [runs.fourth_example(f, q, True, "average") for f in furnaces] for q in (() if quick else ORDERS)},
        [runs.fourth_example(f, 4, False, "svd") for f in furnaces],
        _bias(seeds, list(BIAS)[:1] if quick else list(BIAS)),
        {} if quick else _fixes(min(seeds, 8)),
        {
            name: float(np.median([runs.choice(name, s) for s in range(min(seeds, 3))]))
            for name in (() if quick else CHOICES)
        },
    )


def _fixes(seeds: int) -> dict[str, float]:
    """Median over the seeds of the error by each way of fitting a constant system."""
    rows = [runs.fixes(s) for s in progress(range(seeds), "constant systems", transient=True)]
    return {name: float(np.median([row[name] for row in rows])) for name in FIXES}


def _bias(seeds: int, names: list[str]) -> dict[str, float]:
    """Bias of batch least squares: the size of its mean error over the seeds."""
    settings: dict[str, tuple[float | None, float]] = {f"{db} dB": (float(db), 0.0) for db in (40, 30, 20, 10)}
    settings |= {f"equation {e}": (None, e) for e in (0.05, 0.2)}
    return {
        name: float(np.linalg.norm(np.mean([runs.misfit(*settings[name], s) for s in range(seeds)], axis=0)))
        for name in names
    }


def values(found: Found, example: str, key: str) -> tuple[float, float]:
    """Median over the seeds of the median, and the worst rms (NaN for plain numbers)."""
    rows = [seed[key] for seed in (found.first if example == "1" else found.third)]
    if isinstance(rows[0], Errors):
        return float(np.median([row.median for row in rows])), float(max(row.rms for row in rows))
    return float(np.median(rows)), float("nan")


def arrivals(found: Found, key: tuple[str, float]) -> tuple[float, float]:
    """Median of the samples to arrive over the runs that did, and the share that did."""
    rows = np.array([seed[key] for seed in found.second])
    there = np.isfinite(rows)
    return (float(np.median(rows[there])) if there.any() else float("inf")), float(there.mean())


def end(paths: list[Array]) -> float:
    """Median over the records of the median of the last samples."""
    return float(np.median([np.median(path[-runs.LAST :]) for path in paths]))


def total(paths: list[FurnaceRun]) -> float:
    """Er of (67) over the last samples."""
    return end([run.a + run.b + run.p for run in paths])


def gains(found: Found) -> list[float]:
    """Median local gain over the true one near samples 500, 1500, 3000 and 4800."""
    at = (500, 1500, 3000, 4800)
    return [float(np.median([np.median(run.gain[t - 50 : t + 50]) for run in found.legendre])) for t in at]


def table(found: Found) -> Table:
    """Measured values and the reference."""
    shown = Table(box=SIMPLE_HEAD, show_edge=False, title="Errors of the parameters", title_justify="left")
    for head, justify in (("", "left"), ("what", "left"), ("median", "right"), ("(reference)", "right"),
                          ("worst rms", "right"), ("(reference)", "right")):  # fmt: skip
        shown.add_column(head, justify=justify)  # type: ignore[arg-type]
    for example, key, what, median, worst in ROWS:
        if key not in (found.first if example == "1" else found.third)[0]:
            continue
        now, most = values(found, example, key)
        cells = (f"{now:.4g}", f"{median:g}", "" if np.isnan(most) else f"{most:.3g}", worst)
        shown.add_row(example, what, *cells)
    shown.add_section()
    for run, reference in ARRIVALS.items():
        if run not in found.second[0]:
            continue
        samples, share = arrivals(found, run)
        what = f"samples to arrive, {run[0]}, theta0 = {run[1]:g}"
        cell = f"{samples:.0f} ({100 * share:.0f} %)" if share else "never"
        shown.add_row("2", what, cell, reference, "", "")
    shown.add_section()
    for name, bias in found.bias.items():
        shown.add_row("", f"bias of batch least squares, {name}", f"{bias:.3g}", f"{BIAS[name]:g}", "", "")
    for name, fixed in found.fixes.items():
        what = f"constant system, 20 dB, 20,000 samples, {name}"
        shown.add_row("", what, f"{fixed:.3g}", f"{FIXES[name]:g}" if FIXES[name] else "", "", "")
    for name, choice in found.choices.items():
        shown.add_row("", f"Q/R of the largest likelihood, {name}", f"{choice:g}", CHOICES[name], "", "")
    shown.add_section()
    for q, paths in found.raw.items():
        shown.add_row("4", f'raw powers, "average", Er, q = {q}', f"{total(paths):.2f}", f"{RAW[q]:g}", "", "")
    for name, reference in (("a", "7e-5"), ("p", "6e-4")):
        ends: list[Array] = [getattr(run, name) for run in found.legendre]
        what = f'Legendre q = 4, "svd", squared error of {name}'
        shown.add_row("4", what, f"{end(ends):.2g}", reference, "", "")
    ratios = " ".join(f"{g:.2f}" for g in gains(found))
    shown.add_row("4", "Legendre, local gain at 500, 1500, 3000, 4800", ratios, "0.6 0.97 1.00 1.00", "", "")
    return shown


def worst_ratio(found: Found) -> tuple[float, str]:
    """The largest relative deviation of a median from its reference, half a unit of its last digit allowed."""
    pairs = [(values(found, e, key)[0], median, f"example {e}, {what}") for e, key, what, median, _ in ROWS if median]
    pairs += [(found.bias[name], reference, f"bias, {name}") for name, reference in BIAS.items()]
    pairs += [
        (found.fixes[name], reference, f"constant system, {name}") for name, reference in FIXES.items() if reference
    ]
    pairs += [(total(paths), RAW[q], f"example 4, raw powers, q = {q}") for q, paths in found.raw.items()]
    worst = (0.0, "")
    for measured, reference, where in pairs:
        if reference < CHECKED_UP_TO:
            digits = len(f"{reference:g}".partition(".")[2])
            off = max(abs(measured - reference) - 0.5 * 10.0**-digits, 0.0) / reference
            worst = max(worst, (float(off), where))
    return worst

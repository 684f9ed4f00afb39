"""Alarms: real rates of false alarms, delays beside other detectors, and the cause and size of a change.

    y_t = 2 u_t + 1 + v_t,    u_t ~ N(0, 1), v_t of standard deviation 1

Rates: records without a fault, one alarm in EVERY samples set; the share of that rate, with two standard errors.
Delays: faults that begin 200 samples after the reference of 1000, one false alarm in 1000 samples; the median delay in
samples, and the share found within 1000. "GLR, textbook" is the likelihood ratio of the one parameter that changes,
over windows of 8 to 256 samples, which does not allow for errors of the reference; its limit, and those of river, are
fitted to records without a fault.
Causes: the share of records whose alarm names the parameter that moved when it first names one, and 10 and 50 samples
after it began, and the share whose interval of 95 % then holds the true size.

Run: python benchmarks/alarms.py [records, 24 by default] [--quick]
"""

import sys
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy import signal

from driftfit import ARX, Kalman, Regression, Track, track

Array = np.ndarray[Any, Any]
HELD = Kalman(q=0.0, r=1.0)
EVERY, LATER = 300.0, 5000
NORMAL, START, FAULT = 1000, 200, 1000
"""Samples of the reference, before the fault, and of the fault."""
FRESH = 90_000
"""First seed of the records, on which nothing was chosen."""
NOISES = (
    "normal", "t3", "GARCH(.1, .85)", "AR(.6)", "input regimes", "held input", "rounded", "8 regressors",
    "ARX(2, 2)", "ARX(1, 1), .95",
)  # fmt: skip
FAULTS = ("jump .3", "jump .6", "jump 1.2", "ramp to 1", "noise x 1.5", "1 of 8, .6")


def noise(kind: str, T: int, rng: np.random.Generator) -> Array:
    """Noise (T,) of standard deviation 1."""
    z = rng.standard_t(3, size=T) / np.sqrt(3.0) if kind == "t3" else rng.normal(size=T)
    if kind == "AR(.6)":
        return np.asarray(signal.lfilter([0.8], [1.0, -0.6], z))
    if "GARCH" in kind:
        h = 1.0
        for t in range(T):
            z[t] *= np.sqrt(h)
            h = 0.05 + 0.1 * z[t] ** 2 + 0.85 * h
    return z


def constant(kind: str, T: int, rng: np.random.Generator) -> Track:
    """A run over a record without a fault."""
    v = noise(kind, T, rng)
    if "ARX" in kind:
        u = rng.normal(size=T)
        b, a, model = (
            ([0.0, 1.0, 0.4], [1.0, -1.2, 0.5], ARX(2, 2)) if "2" in kind else ([0.0, 0.5], [1.0, -0.95], ARX(1, 1))
        )
        return track(model, HELD, signal.lfilter(b, a, u) + signal.lfilter([0.3], a, v), u)
    u = rng.normal(size=(T, 7 if kind == "8 regressors" else 1))
    if kind == "input regimes":
        u *= np.where(np.arange(T) // 300 % 2, 3.0, 1.0)[:, None]
    if kind == "held input":
        u = np.repeat(u[: T // 20 + 1], 20, axis=0)[:T]
    y = 2.0 * u.sum(axis=1) + 1.0 + v
    return track(Regression(u.shape[1], intercept=True), HELD, np.round(y) if kind == "rounded" else y, u)


def rates(records: int, lengths: tuple[int, ...], kinds: tuple[str, ...] = NOISES) -> Table:
    """For references of some lengths."""
    title = f"Measured over set rate of false alarms, {LATER} samples after the reference, {records} records"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    for head in ("noise", *(f"reference of {N}" for N in lengths)):
        table.add_column(head, justify="left" if head == "noise" else "right")
    for kind in kinds:
        cells = []
        for N in lengths:
            each = []
            for seed in range(FRESH, FRESH + records):
                run = constant(kind, N + LATER, np.random.default_rng([seed, N]))
                alarms = run.detect(every=EVERY, reference=N, seed=seed)
                each.append(len(alarms.onsets) * EVERY / LATER)
            cells.append(f"{np.mean(each):.2f} +- {2.0 * np.std(each) / np.sqrt(records):.2f}")
        table.add_row(kind, *cells)
    return table


def faulty(fault: str, seed: int) -> tuple[Array, Array]:
    """y (T,) and regressors (T, n) with a fault; with "none" without one."""
    rng = np.random.default_rng([seed, 99])
    T, at = NORMAL + START + FAULT, NORMAL + START
    phi = np.column_stack([rng.normal(size=(T, 7 if "1 of 8" in fault else 1)), np.ones(T)])
    v, theta, after = rng.normal(size=T), np.ones(T), np.arange(T) - at
    size = {"jump .3": 0.3, "jump .6": 0.6, "jump 1.2": 1.2, "1 of 8, .6": 0.6}.get(fault, 0.0)
    theta += size * (after >= 0) if "ramp" not in fault else np.clip(after / 500.0, 0.0, 1.0)
    v *= np.where((after >= 0) & ("noise x" in fault), 1.5, 1.0)
    return phi[:, 0] * theta + phi[:, 1:].sum(axis=1) + v, phi


@lru_cache(maxsize=1000)
def rule(seed: int, n: int) -> Any:
    """The rule of the reference, which is the same for all faults of n regressors."""
    y, phi = faulty("1 of 8, none" if n > 2 else "none", seed)
    return track(Regression(n), HELD, y, phi).detect(every=1000.0, reference=NORMAL, seed=seed).rule


def ours(fault: str, seed: int) -> float:
    """The delay."""
    y, phi = faulty(fault, seed)
    detected = track(Regression(phi.shape[1]), HELD, y, phi).detect(rule(seed, phi.shape[1]), start=NORMAL)
    return first_of(detected.onsets[detected.onsets >= NORMAL + START])


def first_of(places: Array) -> float:
    return float(places[0] - NORMAL - START) if len(places) else np.inf


def stream(fault: str, seed: int) -> tuple[Array, Array]:
    """(scores, their squared regressors) after the reference, as rivals get them, of unit variance in the reference."""
    y, phi = faulty(fault, seed)
    e = y - phi @ np.linalg.lstsq(phi[:NORMAL], y[:NORMAL], rcond=None)[0]
    e /= e[:NORMAL].std()
    x, power = (e * e, np.ones(len(e))) if "noise" in fault else (e * phi[:, 0], phi[:, 0] ** 2)
    mean = x[:NORMAL].mean() if "noise" in fault else 0.0
    return ((x - mean) / x[:NORMAL].std())[NORMAL:], power[NORMAL:]


def begun(active: Array) -> Array:
    """Samples at which an alarm begins."""
    return np.flatnonzero(active & ~np.append(False, active[:-1]))


def textbook(x: Array, power: Array, limit: float) -> Iterator[int]:
    """Onsets of the windowed likelihood ratio."""
    S, G = (np.concatenate([[0.0], np.cumsum(part)]) for part in (x, power))
    best = np.zeros(len(x))
    for L in (8, 16, 32, 64, 128, 256):
        best[L - 1 :] = np.maximum(best[L - 1 :], (S[L:] - S[:-L]) ** 2 / np.maximum(G[L:] - G[:-L], 1e-9))
    return iter(begun(best > limit).tolist())


def of_river(make: Callable[[float], Any], x: Array, power: Array, limit: float) -> Iterator[int]:
    """Drifts that a detector of river reports."""
    detector = make(limit)
    for t, value in enumerate(x):
        detector.update(value)
        if detector.drift_detected:
            yield t


Rival = Callable[[Array, Array, float], Iterator[int]]


def rivals() -> dict[str, tuple[Rival, float, float, int]]:
    """Onsets at a limit, the range of limits, and records for its calibration."""
    found: dict[str, tuple[Rival, float, float, int]] = {"GLR, textbook": (textbook, 3.0, 500.0, 100)}
    if find_spec("river"):
        from river import drift

        found["Page-Hinkley (river)"] = (
            partial(of_river, lambda limit: drift.PageHinkley(delta=0.1, threshold=limit)), 2.0, 300.0, 40
        )  # fmt: skip
        found["ADWIN (river)"] = (partial(of_river, lambda limit: drift.ADWIN(delta=10.0**-limit)), 0.1, 8.0, 30)
    return found


@lru_cache
def calibrated(rival: Rival, kind: str, low: float, high: float, records: int) -> float:
    """The limit with one onset in 1000 samples, by bisection over records without a fault."""
    made = [stream(kind, 10_000 + seed) for seed in range(records)]
    allowed = sum(len(x) for x, _ in made) / 1000.0
    for _ in range(7 if records > 2 else 1):  # two records are no calibration: to see that it works
        middle = np.sqrt(low * high)
        often = sum(len(list(rival(x, power, middle))) for x, power in made) > allowed
        low, high = (middle, high) if often else (low, middle)
    return float(high)


def told(delays: list[float]) -> str:
    found = np.isfinite(delays)
    late = f"{np.median(np.array(delays)[found]):.0f}" if np.mean(found) >= 0.5 else "-"
    return late if found.all() else f"{late} ({100.0 * np.mean(found):.0f} %)"


def delays(records: int, faults: tuple[str, ...]) -> Table:
    title = f"Median delay in samples (share found), one false alarm in 1000, {records} records"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    for head in ("alarm", *faults):
        table.add_column(head, justify="left" if head == "alarm" else "right")
    seeds = range(FRESH, FRESH + records)
    table.add_row("glr", *(told([ours(fault, seed) for seed in seeds]) for fault in faults))
    for name, (rival, low, high, many) in rivals().items():
        cells = []
        for fault in faults:
            without = "noise, none" if "noise" in fault else "none, 1 of 8" if "1 of 8" in fault else "none"
            limit = calibrated(rival, without, low, high, many if records > 5 else 2)
            found = [np.array(list(rival(*stream(fault, seed), limit)), int) for seed in seeds]
            cells.append(told([first_of(one[one >= START] + NORMAL) for one in found]))
        table.add_row(name, *cells)
    return table


CAUSES: dict[str, tuple[str, float]] = {
    "ARX: level by 4": ("offset", 4.0),
    "ARX: level by 1": ("offset", 1.0),
    "ARX: gain by .6": ("b1", 0.6),
    "ARX: lag by -.3": ("a1", -0.3),
    "gain by .6": ("theta1", 0.6),
    "gain by 3": ("theta1", 3.0),
    "level by 1": ("intercept", 1.0),
    "noise x 2": ("noise", 2.0),
}
"""What changes: the parameter and the size of its change, in deviations of the noise."""


def changed(cause: str, seed: int) -> Track:
    """A run whose parameter changes after NORMAL + START samples."""
    name, size = CAUSES.get(cause, ("", 0.0))
    rng, T, at = np.random.default_rng([seed, 7]), NORMAL + START + 200, NORMAL + START
    u, v = rng.normal(size=(2, T))
    after = (np.arange(T) >= at) * size
    if "ARX" not in cause:
        y = (1.0 + after * (name == "theta1")) * u + 1.0 + after * (name == "intercept")
        return track(Regression(1, intercept=True), HELD, y + v * np.where(after * (name == "noise"), size, 1.0), u)
    a, b, c = (k + after * (name == own) for k, own in ((0.7, "a1"), (0.5, "b1"), (0.0, "offset")))
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = a[t] * y[t - 1] + b[t] * u[t - 1] + c[t] + v[t]
    return track(ARX(1, 1), HELD, y, u)


@lru_cache(maxsize=1000)
def of_reference(model: str, seed: int) -> Any:
    """The rule of the reference, which is the same for all changes."""
    return changed(model, seed).detect(every=1000.0, reference=NORMAL, seed=seed).rule


def causes(records: int, cells: tuple[str, ...] = tuple(CAUSES)) -> Table:
    title = f"Cause and size, one false alarm in 1000, {records} records"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    for head in ("change", "delay", "first", "after 10", "after 50", "size, first", "after 10", "after 50"):
        table.add_column(head, justify="left" if head == "change" else "right")
    for cell in cells:
        name, size = CAUSES[cell]
        late, right, held = [], [], []
        for seed in range(FRESH, FRESH + records):
            alarms = changed(cell, seed).detect(of_reference(cell[:3], seed), start=NORMAL)
            begun = alarms.onsets[alarms.onsets >= NORMAL + START]
            if not len(begun):
                continue
            t = int(begun[0])
            late.append(t - NORMAL - START)
            last = len(alarms.active) - 1
            known = [s for s in range(t, min(t + 10, last)) if (one := alarms.change(s)) and np.isfinite(one.size)]
            found = [alarms.change(s) for s in ((known or [t])[0], min(t + 10, last), min(t + 50, last))]
            right.append([one is not None and one.name == name for one in found])
            held.append([one is not None and one.name == name and one.low <= size <= one.high for one in found])
        cells_ = [f"{100.0 * one:.0f} %" for one in (*np.mean(right, axis=0), *np.mean(held, axis=0))]
        table.add_row(cell, f"{np.median(late):.0f} ({100.0 * len(late) / records:.0f} %)", *cells_)
    return table


def main(records: int, quick: bool = False) -> None:
    console = Console(width=120)
    console.print(causes(records, ("ARX: level by 4", "noise x 2") if quick else tuple(CAUSES)))
    console.print(delays(records, FAULTS[1:2] if quick else FAULTS))
    console.print(rates(2 if quick else records // 2, (300,), NOISES[::6] if quick else NOISES))


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(2, quick=True)
    else:
        main(int(sys.argv[1]) if sys.argv[1:] else 24)

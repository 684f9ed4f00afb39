"""Set and measured rates of false alarms.

Systems without a fault, records of 20,000 samples; "set" is one false alarm in so many samples, "measured" the samples
per alarm, with two standard errors. ARX(2, 2) with Gaussian noise, with outliers (5 % are ten times as large),
and one parameter, a random walk, at the very edge of its band, which is the worst case of a band alarm.

The second table is for fleets of 50 series, 10 of which have a fault, watched together: false alarms of all series in
"every" samples, and the share of series without a fault among those that are reported.

Run: python benchmarks/alarm_rates.py [records per line, 20; 0: only fleets] [fleets, 20] [--quick]
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy import signal

from driftfit import ARX, Bank, Change, Kalman, Regression, Sensor, Track, track
from driftfit.judge.alarms.onsets import onsets

T, QUICK = 20_000, 6000
"""Samples per record."""
A, B = [1.0, -1.2, 0.5], [0.0, 1.0, 0.4]


def system(seed: int, outliers: bool, T: int) -> Track:
    """A constant ARX(2, 2), tracked by a filter that allows a little drift."""
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=T), 0.1 * rng.normal(size=T)
    v *= np.where(rng.random(T) < 0.05, 10.0, 1.0) if outliers else 1.0
    y = signal.lfilter(B, A, u) + signal.lfilter([1.0], A, v)
    return track(ARX(2, 2), Kalman(q=0.0, r=0.01 * (5.95 if outliers else 1.0)), y, u)


def at_the_edge(seed: int, every: float, T: int) -> tuple[int, int]:
    """Onsets of "outside the band" for a band that ends exactly at the drifting parameter."""
    rng = np.random.default_rng(seed)
    u, theta = rng.normal(size=T), 1.0 + np.cumsum(0.03 * rng.normal(size=T))
    y = theta * u + 0.5 * rng.normal(size=T)
    run = track(Regression(1), Kalman(q=9e-4, r=0.25), y, u)
    # the band (-inf, theta) moves with the truth: the alarm's own statistic with high = theta_t
    z = (run.theta[:, 0] - theta) / run.std[:, 0]
    detected = run.detect("band", every=every, reference={"theta1": (-1e9, 1e9)})
    return len(onsets(z[50:] > detected.limits[0])), T - 50


def watched(kind: str, outliers: bool, **settings: object) -> Callable[[int, float, int], tuple[int, int]]:
    def count(seed: int, every: float, T: int) -> tuple[int, int]:
        detected = system(seed, outliers, T).detect(kind, every=every, **settings)  # type: ignore[arg-type]
        return len(detected.onsets), T - detected.start

    return count


def jumps(seed: int, every: float, T: int) -> tuple[int, int]:
    """Onsets of the change probability of a bank that expects jumps, where there are none."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=T)
    y = 2.0 * u + 0.1 * rng.normal(size=T)
    changes = [Change(1e-6), Change(1.0, prob=0.005)]
    run = track(Regression(1), Bank(changes, [Sensor.nominal(r=0.01)], p0=1.0), y, u)
    detected = run.detect("probability", every=every)
    return len(detected.onsets), T - detected.start


LINES: list[tuple[str, Callable[[int, float, int], tuple[int, int]]]] = [
    ("band, parameter at its edge", at_the_edge),
    ("band, first 5000 as reference", watched("band", False, reference=5000)),
    ("innovation, window 10", watched("innovation", False, window=10)),
    ("innovation, window 50", watched("innovation", False, window=50)),
    ("innovation, window 50, first 5000 as reference", watched("innovation", False, window=50, reference=5000)),
    ("change probability of a Bank", jumps),
    ("outliers: innovation, window 50", watched("innovation", True, window=50)),
    ("outliers: the same, first 5000 as reference", watched("innovation", True, window=50, reference=5000)),
    ("outliers: the same, calibrated by simulation", watched("innovation", True, window=50, calibrate=True)),
]


SERIES, FAULTY, LONG = 50, 10, 1500


def noises(rng: np.random.Generator, mixed: bool) -> np.ndarray:
    """Noise of variance 1 for every series: normal, or a third each normal, Student t (4) and GARCH."""
    v = rng.normal(size=(SERIES, LONG))
    if mixed:
        v[::3] = rng.standard_t(4, size=v[::3].shape) / np.sqrt(2.0)
        h = np.ones(len(v[1::3]))
        for t in range(LONG):
            v[1::3, t] *= np.sqrt(h)
            h = 0.05 + 0.1 * v[1::3, t] ** 2 + 0.85 * h
    return v


def watched_fleet(
    seed: int, kind: str, every: float, mixed: bool = False, **settings: int
) -> tuple[float, float, float, float]:
    """(false alarms in samples without a fault, those expected, false discovery proportion, share of faults found)."""
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=(SERIES, LONG)), noises(rng, mixed)
    gain, faulty = np.ones((SERIES, LONG)), rng.permutation(SERIES)[:FAULTY]
    gain[faulty, 1000:] += rng.choice([-1.0, 1.0], FAULTY)[:, None] * rng.uniform(0.2, 1.2, FAULTY)[:, None]
    held = Kalman(q=1e-4 if kind == "band" else 0.0, r=1.0, p0=10.0)
    fleet = track(Regression(1), held, gain * u + v, u, by="row")
    detected = fleet.detect(kind, every=every, reference=500, **settings)
    begun = sum(sum(t < (1000 if row.key in faulty else LONG) for t in row.onsets) for row in detected.rows)
    judged = FAULTY * 500 + (SERIES - FAULTY) * 1000
    wrong = sum(key not in faulty for key in detected.faulty)
    found = len(detected.faulty) - wrong
    return begun, judged / (every * SERIES), wrong / max(len(detected.faulty), 1), found / FAULTY


WATCHED: dict[str, dict[str, Any]] = {
    "innovation": {"kind": "innovation"},
    "band": {"kind": "band"},
    "glr": {"kind": "glr"},
    "glr, each with limits of its own": {"kind": "glr", "records": 64},
    "glr, noise of three kinds": {"kind": "glr", "mixed": True},
    "the same, each with limits of its own": {"kind": "glr", "mixed": True, "records": 64},
}


def fleets(count: int, watched: Mapping[str, Mapping[str, Any]], rates: Sequence[float] = (100.0, 1000.0)) -> Table:
    """Fleets watched together."""
    title = f"{count} fleets of {SERIES} series of {LONG} samples, {FAULTY} with a fault, false discovery rate 0.05"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    for head in ("alarm, first 500 as reference", "set", "false alarms", "expected", "wrong, share", "faults found"):
        table.add_column(head, justify="left" if head.startswith("alarm") else "right")
    for name, settings in watched.items():
        for every in rates:
            runs = [watched_fleet(s, every=every, **settings) for s in range(count)]
            begun, expected, wrong, found = np.sum(runs, axis=0)
            cells = (f"{begun:.0f}", f"{expected:.0f}", f"{wrong / count:.3f}", f"{100.0 * found / count:.0f} %")
            table.add_row(name, f"{every:g}", *cells)
    return table


def main(records: int = 20, of_fleets: int = 20) -> None:
    if records:
        Console(width=110).print(alone(records))
    Console(width=120).print(fleets(of_fleets, WATCHED))


def alone(records: int, T: int = T, rates: Sequence[float] = (500.0, 5000.0)) -> Table:
    """Records watched one by one."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"Samples for one false alarm, {records} records of {T}")
    for head in ("alarm", "set", "measured", "from", "to"):
        table.add_column(head, justify="left" if head == "alarm" else "right")
    for name, alarms in LINES:
        for every in rates:
            found = np.array([alarms(seed, every, T) for seed in range(records)])
            begun, samples = found.sum(axis=0)
            spread = 2.0 * found[:, 0].std() * np.sqrt(records)
            ends = (f"{samples / max(begun + spread, 0.5):.0f}", f"{samples / max(begun - spread, 0.5):.0f}")
            table.add_row(name, f"{every:g}", f"{samples / max(begun, 0.5):.0f}", *ends)
    return table


if __name__ == "__main__":
    if "--quick" in sys.argv:
        Console(width=110).print(alone(1, QUICK, (500.0,)))
        Console(width=120).print(fleets(1, {name: WATCHED[name] for name in ("band", "glr")}, (100.0,)))
    else:
        main(*map(int, sys.argv[1:3]))

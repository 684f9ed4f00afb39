"""Do the intervals of event dates hold their level, and are jumps in outages found?

Records of 300 samples of a regression with two regressors have one jump in the middle, of ``size`` standard deviations
of the noise, and are tracked by `Bank()`, which knows neither size nor noise. An event is correct if it is within 25
samples of the jump. The interval of its date should contain the jump in 95 per cent of the correct events. Then the
same with an outage around the jump. Run: python benchmarks/event_dates.py [records]
[--quick, for the last size and no outage alone]
"""

from __future__ import annotations

import sys

import numpy as np

from driftfit import Bank, Regression, track
from driftfit.bank.results.events import Event

T, AT = 300, 150


def record(rng: np.random.Generator, size: float, outage: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """y and u; parameter 1 jumps by ``size`` standard deviations of the noise, somewhere in the outage."""
    u = rng.standard_normal((T, 2))
    jump = AT + int(rng.integers(0, outage + 1))
    theta = np.where(np.arange(T)[:, None] < jump, [1.0, -0.5], [1.0 + size, -0.5])
    y = (u * theta).sum(axis=1) + rng.standard_normal(T)
    y[AT : AT + outage] = np.nan
    return y, u


def near(events: list[Event], outage: int) -> list[Event]:
    return [event for event in events if AT - 25 <= event.span.date <= AT + outage + 25]


def coverage(size: float, records: int) -> tuple[int, int, int, float]:
    """Share found, share of intervals that contain the date, false events, and the mean length of the interval."""
    found, held, false, length = 0, 0, 0, 0
    for seed in range(records):
        events = track(Regression(2), Bank(), *record(np.random.default_rng(seed), size)).changes()
        here = near(events, 0)
        false += len(events) - len(here)
        if here:
            first, last = min(e.span.first for e in here), max(e.span.last for e in here)
            found, held, length = found + 1, held + int(first <= AT <= last), length + last - first + 1
    return found, held, false, length / max(found, 1)


def outages(size: float, outage: int, records: int) -> int:
    """Share of records in which a jump during an outage is found."""
    runs = (track(Regression(2), Bank(), *record(np.random.default_rng(seed), size, outage)) for seed in range(records))
    return sum(bool(near(run.hypotheses.found(), outage)) for run in runs)


def main(records: int = 1000, quick: bool = False) -> None:
    print("size of the jump   found   interval holds it   false   samples in the interval")
    for size in (10.0,) if quick else (1.5, 2.0, 3.0, 5.0, 10.0):
        found, held, false, length = coverage(size, records)
        print(
            f"{size:12.1f} {found / records:12.3f} {held / max(found, 1):13.3f} {false / records:15.3f} {length:14.1f}"
        )
    print("outage   found, jump of 2   of 5")
    for outage in (0,) if quick else (0, 5, 20, 100):
        counts = [outages(size, outage, records) / records for size in (2.0, 5.0)]
        print(f"{outage:6d} {counts[0]:12.3f} {counts[1]:10.3f}")


if __name__ == "__main__":
    main(*map(int, filter(str.isdigit, sys.argv[1:])), quick="--quick" in sys.argv)

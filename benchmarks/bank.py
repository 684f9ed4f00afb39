"""A bank of hypotheses: time per step, against filterpy's interacting multiple models.

Prints microseconds per step in record mode and live, for three changes with a beam of eight leaves at n = 4, for
twenty-seven leaf updates at n = 3, and for beams of growing width; and the same for filterpy's IMM with three Kalman
filters if it is installed. Minimum of several runs, processor time of one core. Run: python benchmarks/bank.py
[--quick], which runs the first three lines on short records.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from driftfit import ARX, Bank, Kalman, Live, track
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide
from driftfit.bank.sensor import Sensor

T, QUICK = 20_000, 400
THREE = [Change(1e-6), Change(0.5, prob=0.006), Change(1.5, prob=0.004, which=[0])]
KNOWN = [Sensor.nominal(0.01)]


def least(work: Callable[[], object], steps: int, times: int = 5) -> float:
    """Microseconds per step."""
    work()
    found = []
    for _ in range(times):
        start = time.process_time()
        work()
        found.append(time.process_time() - start)
    return 1e6 * min(found) / steps


def record(n: int, T: int = T) -> tuple[ARX, np.ndarray, np.ndarray]:
    """A record of ARX(2, n - 2)."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(T), np.zeros(T)
    for t in range(3, T):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1] + 0.4 * u[t - 2] + 0.1 * rng.standard_normal()
    return ARX(2, n - 2), y, u


def ours(n: int, bank: Bank | Kalman, T: int = T) -> float:
    model, y, u = record(n, T)
    return least(lambda: track(model, bank, y, u), T)


def live(n: int, bank: Bank) -> float:
    model, y, u = record(n)
    samples = list(zip(y[:2000].tolist(), u[:2000].tolist(), strict=True))
    stream = Live(model, bank)

    def feed() -> None:
        for sample in samples:
            stream.update(*sample)

    return least(feed, len(samples))


def filterpy_imm(n: int, steps: int = 200) -> float | None:
    """filterpy's IMM with three models; None if it is not installed."""
    try:
        from filterpy.kalman import IMMEstimator, KalmanFilter
    except ImportError:
        return None
    _, y, u = record(n)
    filters = []
    for change in THREE:
        one = KalmanFilter(dim_x=n, dim_z=1)
        one.F, one.R, one.P = np.eye(n), np.array([[0.01]]), 2.0 * np.eye(n)
        one.Q, one.H = change.increments(n)[0], np.zeros((1, n))
        filters.append(one)
    bank = IMMEstimator(filters, [0.99, 0.006, 0.004], np.tile([0.99, 0.006, 0.004], (3, 1)))

    def feed() -> None:
        for t in range(2, 2 + steps):
            for one in filters:
                one.H = np.array([[y[t - 1], y[t - 2], u[t - 1], u[t - 2]][:n]])
            bank.predict()
            bank.update(np.array([y[t]]))

    return least(feed, steps, 3)


def main(quick: bool = False) -> None:
    size = QUICK if quick else T
    kalman = ours(4, Kalman(1e-6, 0.01, p0=2.0), size)
    eight = ours(4, Bank(THREE, KNOWN, reduce=Beam(8), p0=2.0), size)
    print(f"Kalman filter, n = 4                       {kalman:8.3f} us a step")
    print(f"three changes, Beam(8), n = 4              {eight:8.3f} us a step")
    print(f"the same live                              {live(4, Bank(THREE, KNOWN, reduce=Beam(8), p0=2.0)):8.3f}")
    if quick:
        return
    print(f"27 leaf updates, Decide(3), n = 3          {ours(3, Bank(THREE, KNOWN, reduce=Decide(3), p0=2.0)):8.3f}")
    print(f"27 leaf updates, GPB(3), n = 3             {ours(3, Bank(THREE, KNOWN, reduce=GPB(3), p0=2.0)):8.3f}")
    print(f"27 leaf updates, Beam(9), n = 3            {ours(3, Bank(THREE, KNOWN, reduce=Beam(9), p0=2.0)):8.3f}")
    print(f"IMM, three changes, n = 4                  {ours(4, Bank(THREE, KNOWN, reduce=IMM(), p0=2.0)):8.3f}")
    print("in coordinates of the start, p0 = 1e14:")
    for n, reduce in ((4, Beam(8)), (3, GPB(3)), (4, IMM()), (8, Beam(8))):
        both = [ours(n, Bank(THREE, KNOWN, reduce=reduce, p0=p0)) for p0 in (2.0, 1e14)]
        print(f"{reduce!s:15}, n = {n}                     {both[1]:8.3f}   {both[1] / both[0]:.1f} times as long")
    for leaves in (16, 32, 64, 128, 256):
        print(f"Beam({leaves:3d}), three changes, n = 4           ", end="")
        print(f"{ours(4, Bank(THREE, KNOWN, reduce=Beam(leaves), p0=2.0)):8.3f}")
    theirs = filterpy_imm(4)
    if theirs is not None:
        print(f"filterpy's IMM, three models, n = 4        {theirs:8.1f}   {theirs / eight:.0f} times Beam(8)")


if __name__ == "__main__":
    main("--quick" in sys.argv)

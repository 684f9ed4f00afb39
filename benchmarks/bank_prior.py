"""Banks whose prior is right, by their reductions; banks whose prior is wrong; and a bank that learns it.

Two parameters jump at independent dates by N(0, size^2) in noise of 1, with white regressors: what banks assume holds,
and the prior of a bank that is given size and rate is right. Errors are root mean squares after 30 samples, over those
of a Kalman filter that is told every date, size and noise. NEES is the mean of e'P^-1 e / n, 1 where covariances are
right; "near" is the coverage of bands of 95 % in the six samples from a jump on, which is below .95 for the exact
mixture too, since it is the coverage given a jump. In the second table banks assume a drift of 0.003 and jumps of one
size, once in a hundred samples; one learns how often jumps of 0.5, 5, 50 and 500 happen.

Run: python benchmarks/bank_prior.py [--quick], which runs fewer records.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from driftfit import Bank, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide, Hybrid, Reduction, Resample
from driftfit.bank.sensor import Sensor
from driftfit.engine.kernel import Array
from driftfit.run.result import Track
from lab.bench.oracle import known_walk

N, T, FIRST, NEAR = 2, 600, 30, 6
FIXED = (0.5, 5.0, 50.0)
SIZES = (0.05, 0.5, 1.6, 5.0, 16.0, 50.0, 500.0)
REDUCTIONS = (
    Decide(1), Decide(3), Decide(5), GPB(2), GPB(4), IMM(), Hybrid(9), Beam(3), Beam(9), Beam(32), Resample(3),
    Resample(9), Resample(), Resample(300),
)  # fmt: skip


class Record(NamedTuple):
    phi: Array
    y: Array
    theta: Array
    q: Array


class Score(NamedTuple):
    square: float
    nees: float
    near: float
    log_p: float


def record(size: float, rate: float, seed: int) -> Record:
    rng = np.random.default_rng([seed, int(1e4 * rate), int(1e4 * size)])
    phi, at = rng.standard_normal((T, N)), (rng.random(T) < rate) & (np.arange(T) > 0)
    jumps = at[:, None] * rng.standard_normal((T, N)) * size
    theta = rng.standard_normal(N) + np.cumsum(jumps, axis=0)
    return Record(phi, np.sum(phi * theta, axis=1) + rng.standard_normal(T), theta, at[:, None] * np.full(N, size**2))


def score(made: Record, run: Track) -> Score:
    e, P = run.theta - made.theta, np.tril(run.covariances())
    P = P + np.tril(P, -1).swapaxes(1, 2)
    nees = np.einsum("ti,tij,tj->t", e, np.linalg.inv(P), e) / N
    near = np.convolve(made.q[:, 0] > 0.0, np.ones(NEAR))[:T] > 0.0
    held = np.abs(e)[near & (np.arange(T) >= FIRST)] < 1.96 * run.std[near & (np.arange(T) >= FIRST)]
    return Score(np.mean(e[FIRST:] ** 2), nees[FIRST:].mean(), held.mean() if held.size else np.nan, run.loglik / T)


def scores(banks: Mapping[str, Bank], size: float, rate: float, records: int) -> dict[str, Sequence[float]]:
    """Error over the oracle's, NEES, coverage near jumps and mean log density of every bank."""
    made = [record(size, rate, seed) for seed in range(records)]
    ideal = [known_walk(one.y, one.phi, 0, one.q, np.ones(T)).theta - one.theta for one in made]
    least = np.mean([e[FIRST:] ** 2 for e in ideal])
    found = {}
    for name, bank in banks.items():
        each = [score(one, track(Regression(N), bank, one.y, one.phi, keep="cov")) for one in made]
        square, nees, near, log_p = np.nanmean(each, axis=0)
        found[name] = np.sqrt(square / least), nees, near, log_p
    return found


def told(size: float, rate: float, reduce: Reduction | None = None) -> Bank:
    """The bank with the right prior."""
    return Bank([Change(0.0), Change(size**2, prob=rate)], [Sensor.nominal(1.0)], reduce=reduce, p0=100.0)


def of_size(size: float, prob: float, r: float | None) -> Bank:
    """A slow drift, and jumps of one size."""
    return Bank([Change(size=0.003), Change(size=size, prob=prob)], [Sensor.nominal(r)], reduce=Resample(9))


def reductions(records: int) -> None:
    cases = ((5.0, 0.01), (1.5, 0.03))
    by_case = [scores({str(one): told(*case, one) for one in REDUCTIONS}, *case, records) for case in cases]
    print(" " * 20 + "".join(f"   jumps of {size:g}, {100 * rate:g} in 100 samples " for size, rate in cases))
    print(f"{'':20}" + "   error   NEES   near    log p" * len(cases))
    for one in REDUCTIONS:
        print(
            f"{one!s:20}"
            + "".join(
                f"{error:8.2f}{nees:7.2f}{near:7.2f}{log_p:9.3f}"
                for error, nees, near, log_p in (found[str(one)] for found in by_case)
            )
        )


def priors(records: int) -> None:
    """Errors and NEES over sizes and rates, and the worst of the errors over those of the bank that is told both."""
    names = ["told", *(f"{size:g}" for size in FIXED), "learned"]
    print("                  error over the oracle's            NEES")
    print(" size   rate " + "".join(f"{name:>8}" for name in names) + "".join(f"{name:>8}" for name in names))
    for r in (1.0, None):
        print("noise known" if r else "noise unknown")
        errors = []
        for rate in (1 / 30, 1 / 100, 1 / 1000):
            for size in SIZES:
                banks = {name: of_size(float(name), 0.01, r) for name in names[1:-1]}
                banks |= {"told": of_size(size, rate, r), "learned": Bank(Change.unknown(), [Sensor.nominal(r)])}
                found = scores(banks, size, rate, records)
                errors.append([found[name][0] for name in names])
                row = [f"{found[name][k]:8.{digits}f}" for k, digits in ((0, 2), (1, 1)) for name in names]
                if r:
                    print(f"{size:5g}{rate:7.3f} " + "".join(row), flush=True)
        more = np.array(errors) / np.array(errors)[:, :1]
        for name, ratio in (("largest", more.max(axis=0)), ("mean", more.mean(axis=0))):
            print(f"{name:8}/told" + "".join(f"{x:8.2f}" for x in ratio))


def changing(records: int) -> None:
    """Errors over the oracle's after rate and size have changed at two thirds of 6000 samples."""
    print("at first      then           0.5       5      50 learned")
    for (rate, size), (late, last) in (
        ((0.0005, 5), (0.03, 0.5)),
        ((0.03, 0.5), (0.001, 5)),
        ((0.03, 5), (0.002, 0.5)),
    ):
        squares = np.zeros(2 + len(FIXED))
        for seed in range(records):
            rng, first = np.random.default_rng([seed, int(1e4 * rate)]), np.arange(6000) < 4000
            q = np.where(first, size, last) ** 2 * (rng.random(6000) < np.where(first, rate, late))
            phi, theta = rng.standard_normal((6000, N)), np.zeros((6000, N))
            theta += np.cumsum(np.sqrt(q)[:, None] * rng.standard_normal((6000, N)), axis=0)
            y = np.sum(phi * theta, axis=1) + rng.standard_normal(6000)
            banks = [*(of_size(one, 0.01, 1.0) for one in FIXED), Bank(Change.unknown(), [Sensor.nominal(1.0)])]
            found = [track(Regression(N), bank, y, phi).theta for bank in banks]
            ideal = known_walk(y, phi, 0, np.tile(q[:, None], N), np.ones(6000)).theta
            squares += [np.sum((path - theta)[~first] ** 2) for path in (ideal, *found)]
        row = "".join(f"{x:8.2f}" for x in np.sqrt(squares[1:] / squares[0]))
        print(f"{size:g} at {rate:<7g} {last:g} at {late:<6g}" + row)


def main(quick: bool = False) -> None:
    reductions(3 if quick else 40)
    print()
    priors(1 if quick else 20)
    print()
    changing(1 if quick else 6)


if __name__ == "__main__":
    main("--quick" in sys.argv)

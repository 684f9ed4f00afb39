"""The numbers of the Hammerstein-Wiener reproduction under other interpretations of the paper (a minute).

Prints the numbers of docs/hammerstein_wiener_paper.md under "Where numbers depend on the interpretation".
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.systems.arc_furnace import furnace
from driftfit.systems.hammerstein_wiener import CUBIC, Simulated, example
from driftfit.trackers.kalman import Kalman
from driftfit.tracking import track
from lab.reproduce.hammerstein_wiener import runs
from lab.reproduce.hammerstein_wiener.tables import BIAS, end


def thresholds() -> None:
    """Er of (67) by what is fed back, on the records of the table and on others."""
    furnaces = [furnace(seed) for seed in range(160)]
    pick = np.random.default_rng(0)
    original = runs.furnace_model
    for fed in ("average", "least-squares"):

        def model(f, degree, raw, method, fed=fed):
            found = original(f, degree, raw, method)
            return replace(found, input=DeadZone(found.input.u_max, fed=fed))

        runs.furnace_model = model
        for q in (4, 5, 6):
            rows = (runs.fourth_example(f, q, True, "average") for f in furnaces)
            each = np.array([np.median((r.a + r.b + r.p)[-runs.LAST :]) for r in rows])
            drawn = [np.median(pick.choice(each, 20)) for _ in range(1000)]
            low, high = np.quantile(drawn, (0.1, 0.9))
            print(f"Er, thresholds by {fed}, q = {q}: first 20 records {np.median(each[:20]):.2f}, all 160 "
                  f"{np.median(each):.2f}, medians of 20 drawn: {low:.2f} to {high:.2f} in eight of ten")  # fmt: skip
    runs.furnace_model = original
    rows = [runs.fourth_example(f, 4, False, "svd") for f in furnaces]
    for name in "ap":
        each = np.array([np.median(getattr(r, name)[-runs.LAST :]) for r in rows])
        print(f"Legendre, squared error of {name}: first 20 {np.median(each[:20]):.1e}, all 160 {np.median(each):.1e}")


def one_step() -> None:
    """One step ahead on the range until then, on that of the record, and against the noisy output."""
    slow = Kalman(q=1e-3, r=1.0, p0=1e8, theta0=0.01)
    for name, tracker in (("1e3", runs.PAPER), ("1e-3", slow)):
        found = []
        for seed in range(24):
            s = example(3, seed, snr_db=20.0)
            run = track(s.model, tracker, s.y, s.u)
            record = runs.one_step(run, s)
            found.append([runs.rms(s.y0 - run.prediction), runs.rms(s.y0 - record), runs.rms(s.y - record)])
        until, whole, noisy = np.median(found, axis=0)
        print(f"one step, Q/R = {name}: {until:.3f} on the range until then, {whole:.3f} on that of the record, "
              f"{noisy:.3f} against the noisy output")  # fmt: skip


def bias() -> None:
    """Error of single records against the bias."""
    for db in (40, 30):
        single = [np.linalg.norm(runs.misfit(float(db), 0.0, seed)) for seed in range(24)]
        long = np.mean([runs.misfit(float(db), 0.0, seed, 200_000) for seed in range(3)], axis=0)
        print(f"least squares, {db} dB: single records {np.median(single):.4f}, 200,000 samples "
              f"{np.linalg.norm(long):.4f}, reference {BIAS[f'{db} dB']}")  # fmt: skip


def equation_noise(s: Simulated, xi: np.ndarray, y: np.ndarray) -> np.ndarray:
    """R_t (T,) of parameters xi (T, 8) at outputs y."""
    squares = (1.0 + 2.0 * xi[:, 6] * y + 3.0 * xi[:, 7] * y**2) ** 2
    total = squares.copy()
    for i in (1, 2):
        total[i:] += xi[i:, i - 1] ** 2 * squares[:-i]
    return s.sigma**2 * total + 1e-4


def noise_aware() -> None:
    """Example 3 at 20 dB, R_t from other parameters and outputs."""
    stage, ekf = Kalman(q=4e-6, r=1.0, p0=1e4, theta0=0.01), runs.ExtendedKalman(q=4e-6, r=1.0, p0=1.0)
    found: dict[str, list[list[float]]] = {}
    for seed in range(24):
        s = example(3, seed, snr_db=20.0)
        start = np.repeat(s.xi[:1], len(s.y), axis=0)
        given = {
            "true parameters": equation_noise(s, s.xi, s.y), "initial parameters": equation_noise(s, start, s.y),
            "true parameters and clean outputs": equation_noise(s, s.xi, s.y0),
        }  # fmt: skip
        for name, R in given.items():
            one = runs.separated(track(CUBIC, stage, s.y, s.u, weights=1.0 / R), "gls")
            two = track(CUBIC, ekf, s.y, s.u, weights=1.0 / R).theta
            found.setdefault(name, []).append([runs.late(runs.off(xi, s)).median for xi in (one, two)])
    for name, rows in found.items():
        print("noise-aware R from {}: gls {:.3f}, EKF {:.3f}".format(name, *np.median(rows, axis=0)))


def arrivals() -> None:
    """Samples that the extended Kalman filter needs from 0.01, by set of records."""
    for first in (0, 100, 200, 300):
        rows = []
        for seed in range(first, first + 24):
            s = example(2, seed, T=1500)
            rows.append(runs.arrival(runs.off(track(s.model, runs.FAST, s.y, s.u).theta, s)))
        low, middle, high = np.quantile(rows, (0.25, 0.5, 0.75))
        print(f"EKF from 0.01, records {first} to {first + 23}: {middle:.0f} samples, quartiles {low:.0f}, {high:.0f}")


def likelihood() -> None:
    """How flat the likelihood of example 1 is beyond its maximum."""
    s = example(1, 0)
    rhos = (1.0, 10.0, 100.0, 1000.0)
    found = [runs.concentrated(s.model, track(s.model, Kalman(q=rho, r=1.0, p0=1e8, theta0=0.01), s.y, s.u))
             for rho in rhos]  # fmt: skip
    told = ", ".join(f"{rho:g}: {value - max(found):.1f}" for rho, value in zip(rhos, found, strict=True))
    print(f"log-likelihood of example 1 by Q/R, {told}")


def rises() -> None:
    """How often an estimate at 20 dB and Q/R = 1e3 does not increase on the range of the record."""
    shares = []
    for seed in range(6):
        s = example(3, seed, snr_db=20.0)
        run = track(s.model, runs.PAPER, s.y, s.u)
        wide = 0.2 * np.ptp(s.y)
        grid = np.linspace(s.y.min() - wide, s.y.max() + wide, 64)
        level = s.model.output_weights(run.theta[200:]) @ s.model.out.value(grid).T
        shares.append(np.mean((np.diff(level, axis=1) <= 0.0).any(axis=1)))
    print(f"estimates that do not increase, Q/R = 1e3: {100.0 * np.mean(shares):.0f} %")


def recovery() -> None:
    """Example 3 without noise: samples after the jump of d until the error is at most twice what it was, ten on end."""
    found: dict[str, list[int]] = {"average": [], "svd": [], "svd-joint": []}
    for seed in range(24):
        s = example(3, seed)
        run = track(s.model, runs.PAPER, s.y, s.u)
        for method, samples in found.items():
            error = runs.off(runs.separated(run, method), s)
            small = error[1000:] <= 2.0 * np.median(error[500:1000])
            samples.append(int(np.argmax(np.convolve(small, np.ones(10), "valid") > 9.5)))
    told = ", ".join(f"{method} {np.median(samples):.0f} (most {max(samples)})" for method, samples in found.items())
    print(f"samples to recover from the jump of example 3: {told}")


def laws_of_b() -> None:
    """Example 3 at 20 dB, Q/R = 1e-3: the laws of b as increments, and as levels as printed; rms by record."""
    slow = Kalman(q=1e-3, r=1.0, p0=1e8, theta0=0.01)
    for name, literal in (("increments", False), ("levels", True)):
        found: dict[str, list[tuple[float, float]]] = {"average": [], "svd": [], "svd-joint": []}
        for seed in range(24):
            s = example(3, seed, snr_db=20.0, literal=literal)
            run = track(s.model, slow, s.y, s.u)
            for method, errors in found.items():
                late = runs.late(runs.off(runs.separated(run, method), s))
                errors.append((late.median, late.rms))
        for method, errors in found.items():
            median, rms = np.median(errors, axis=0)
            worst = max(rms for _, rms in errors)
            print(f"b as {name}, {method}: median {median:.3f}, rms {rms:.3g} (worst record {worst:.3g})")


def legendre() -> None:
    """Example 4 on Legendre polynomials of higher order: squared errors of a and p, and the local gain, at the end."""
    furnaces = [furnace(seed) for seed in range(20)]
    for q in (4, 5, 6):
        rows = [runs.fourth_example(f, q, False, "svd") for f in furnaces]
        gain = np.median([np.median(row.gain[-runs.LAST :]) for row in rows])
        print(f"Legendre q = {q}: a {end([r.a for r in rows]):.1g}, p {end([r.p for r in rows]):.1g}, gain {gain:.2f}")


if __name__ == "__main__":
    for part in (thresholds, one_step, bias, noise_aware, arrivals, likelihood, rises, recovery, laws_of_b, legendre):
        part()

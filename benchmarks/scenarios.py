"""Trackers without settings on scenarios they were not designed on: error of theta over that of the filter that knows.

*Oracle* is the Kalman filter that knows the drift covariance and the noise variance of every sample, when jumps occur,
and which readings are faults. Ratios are medians over runs. *each* is ``AdaptiveKalman(groups=[[0], [1], ..])``,
*faults* a `Bank` with a hypothesis for outliers, *ML each* the Kalman filter with the drift of every parameter and the
noise variance by maximum likelihood from the whole record, and *best* that with the one ratio q c / r that is best on
these very runs. The last columns are shares within the 95 % bands of `AdaptiveKalman`: of the parameters that move,
of those that never do, and of y (without faults).

Run: python -m benchmarks.scenarios [--runs 20] [--only NAME ..] [--columns default each bank ml best] [--quick]
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from zlib import crc32

import numpy as np
from scipy.optimize import minimize

from benchmarks.unseen import Case, found
from driftfit import AdaptiveKalman, Bank, Sensor, track
from driftfit.engine.kernel import Array, Driver
from driftfit.results import Track
from driftfit.trackers.base import Tracker
from lab.bench.records import Record

HALF = 1.959963984540054
GRID = (0.0, *np.logspace(-7.0, 2.0, 19))


@Driver
def known_filter(phi: Array, y: Array, Q: Array, F: Array, weight: Array, r: Array, theta: Array) -> float:
    """Filter theta_t = F theta_(t-1) + w, w ~ N(0, weight_t Q_ij); NaN is skipped. Returns the sum of squares e^2 / s
    and log s as a log-likelihood with r concentrated out."""
    n, m = len(F), phi.shape[1]
    P, x, FP, g = 1e6 * np.eye(n), np.zeros(n), np.zeros((n, n)), np.zeros(n)
    squares, logs, count = 0.0, 0.0, 0
    for t in range(len(y)):
        for i in range(n):
            g[i] = 0.0
            for k in range(n):
                g[i] += F[i, k] * x[k]
        for i in range(n):
            x[i] = g[i]
            for j in range(n):
                FP[i, j] = 0.0
                for k in range(n):
                    FP[i, j] += F[i, k] * P[k, j]
        for i in range(n):
            for j in range(n):
                P[i, j] = Q[i, j] * np.sqrt(weight[t, i] * weight[t, j])
                for k in range(n):
                    P[i, j] += FP[i, k] * F[j, k]
        usable = np.isfinite(y[t])
        s, e = r[t], y[t]
        for i in range(m):
            usable = usable and np.isfinite(phi[t, i])
        if usable:
            for i in range(n):
                g[i] = 0.0
                for k in range(m):
                    g[i] += P[i, k] * phi[t, k]
            for k in range(m):
                s += phi[t, k] * g[k]
                e -= phi[t, k] * x[k]
            for i in range(n):
                x[i] += g[i] * e / s
                for j in range(n):
                    P[i, j] -= g[i] * g[j] / s
            if t >= 5 * m:
                squares += e * e / s
                logs += np.log(s)
                count += 1
        for i in range(m):
            theta[t, i] = x[i]
    return -0.5 * (count * np.log(squares / count) + logs)  # type: ignore[no-any-return]


def walked(phi: Array, y: Array, q: Array, r: Array) -> tuple[Array, float]:
    """theta (T, n) of a random walk with drift q (n,) or (T, n), and the log-likelihood."""
    n, theta = phi.shape[1], np.empty(phi.shape)
    weight = np.ascontiguousarray(np.broadcast_to(q, phi.shape))
    return theta, known_filter(phi, np.ascontiguousarray(y), np.eye(n), np.eye(n), weight, r, theta)


def oracle(case: Case, phi: Array) -> Array:
    """theta (T, n) of the filter that knows."""
    y = np.where(case.blind, np.nan, case.y - case.known)
    n = phi.shape[1]
    if case.slopes:
        theta, F = np.empty(phi.shape), np.eye(2 * n)
        F[:n, n:] = np.eye(n)
        weight = np.concatenate([np.zeros_like(case.q), case.q], axis=1)
        known_filter(phi, y, np.eye(2 * n), F, weight, case.r, theta)
        return theta
    if case.common.size:
        theta = np.empty(phi.shape)
        known_filter(phi, y, np.outer(case.common, case.common), np.eye(n), case.q, case.r, theta)
        return theta
    return walked(phi, y, case.q, case.r)[0]


def likeliest(case: Case, phi: Array) -> Array:
    """theta (T, n) with every parameter's drift by maximum likelihood."""
    c, r = np.nanmean(phi**2, axis=0), np.ones(len(case.y))

    def loss(logs: Array) -> float:
        return -walked(phi, case.y, 10.0**logs / c, r)[1]

    n = phi.shape[1]
    start = min((np.full(n, level) for level in (-6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.0)), key=loss)
    best = minimize(loss, start, method="L-BFGS-B", bounds=[(-9.0, 3.0)] * n, options={"maxiter": 60}).x
    return walked(phi, case.y, 10.0**best / c, r)[0]


def ours(kind: Callable[[int], Tracker]) -> Callable[[Case, Array], Track]:
    """A tracker of ours for n parameters. What `Bank()` says of spikes is known: the table shows what they cost."""

    def run(case: Case, phi: Array) -> Track:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Bank: .* look like spikes", UserWarning)
            return track(case.model, kind(phi.shape[1]), case.y, case.u)

    return run


COLUMNS: dict[str, Callable[[Case, Array], Array | Track]] = {
    "default": ours(lambda n: AdaptiveKalman()),
    "each": ours(lambda n: AdaptiveKalman(groups=[[i] for i in range(n)])),
    "bank": ours(lambda n: Bank()),
    "faults": ours(lambda n: Bank(sensors=[Sensor.nominal(), Sensor.outlier(10.0, prob=0.02)])),
    "ml": likeliest,
}


def error(case: Case, theta: Array, c: Array) -> float:
    """Root mean square of theta - truth, each in units of its regressor's root mean square."""
    return float(np.sqrt(np.nanmean(((theta - case.theta)[case.burn :] ** 2) @ c)))


def within(off: Array, std: Array) -> float:
    """Share within the band; NaN for none."""
    known = np.isfinite(off) & np.isfinite(std)
    return float(np.mean(np.abs(off[known]) <= HALF * std[known])) if known.any() else np.nan


def scored(name: str, runs: int, columns: list[str]) -> dict[str, float]:
    """Median ratios to the oracle by column, and coverage of our trackers."""
    ratios: dict[str, list[float]] = {column: [] for column in columns if column != "best"}
    fixed, bands = [], []
    for seed in range(runs):
        case = found()[name](np.random.default_rng([seed, crc32(name.encode())]))
        u = case.u if case.u.ndim == 2 else case.u[:, None]
        phi = np.ascontiguousarray(Record(case.model.bind(u.shape[1]), case.y, u).phi)
        c = np.nanmean(phi**2, axis=0)
        least = error(case, oracle(case, phi), c)
        for column in ratios:
            out = COLUMNS[column](case, phi)
            if isinstance(out, Track):
                late, fine = slice(case.burn, None), ~case.blind[case.burn :]
                off, moves = (out.theta - case.theta)[late], np.ptp(case.theta, axis=0) > 0.0
                parts = [within(off[:, which], out.std[late][:, which]) for which in (moves, ~moves)]
                y = within((case.y - out.prediction)[late][fine], out.innovation_std[late][fine])
                bands.append((column, *parts, y))
                out = out.theta
            ratios[column].append(error(case, out, c) / least)
        if "best" in columns:
            r = np.ones(len(case.y))
            fixed.append([error(case, walked(phi, case.y, g / c, r)[0], c) / least for g in GRID])
    row = {column: float(np.median(values)) for column, values in ratios.items()}
    if fixed:
        row["best"] = float(np.median(fixed, axis=0).min())
    for column in dict.fromkeys(column for column, *_ in bands):
        shares = np.mean([band[1:] for band in bands if band[0] == column], axis=0)
        row |= {f"{column} {part}": share for part, share in zip(("moving", "constant", "y"), shares, strict=True)}
    return row


QUICK = ("armax", "near_unit_root")
"""Scenarios of few parameters, which compile soon."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--only", nargs="*", choices=found())
    parser.add_argument("--columns", nargs="*", default=[c for c in COLUMNS if c != "faults"] + ["best"])
    parser.add_argument("--quick", action="store_true", help="two runs of two scenarios")
    given = parser.parse_args()
    heads: list[str] = []
    for name in (given.only or QUICK)[:2] if given.quick else given.only or found():
        runs = 2 if given.quick else given.runs if name != "very_slow" else max(2, given.runs // 5)
        row = scored(name, runs, given.columns)
        if not heads:
            heads = [*given.columns, *(head for head in row if " " in head)]
            print(f"{'':18}" + "".join(f"{head:>17}" for head in heads))
        cells = [f"{row[head]:.2f}" if np.isfinite(row[head]) else "-" for head in heads]
        print(f"{name:18}" + "".join(f"{cell:>17}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()

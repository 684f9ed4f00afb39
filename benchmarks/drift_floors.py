"""What a causal method can reach that does not know the drift: Bayesian filters that know the kind of change.

For each scenario of `benchmarks.unseen`, Kalman filters run side by side, one for each size of the drift on a grid that
is uniform in its logarithm (and for each of what else is unknown), and are mixed by the likelihood of all outputs so
far: exact Bayesian inference but for the grid. They know of the system what the last column says, and nothing else
changes; *r known* also knows the noise variance of every sample, *r unknown* its course, but not its level (the
conjugate prior 1 / r). *Kind unknown* only knows that parameters walk with a constant drift, and takes the noise for
constant: all alike, one common walk (of two to four parameters), any one alone, or any two, each as likely as the
others; not for kinds that are none of these. Scenarios with events at unknown dates have the filter of
`benchmarks.floors`, which keeps the 200 most probable histories and knows r, how often events occur and how large they
are. Readings that freeze are known.

Errors of the parameters are divided by those of the oracle of `benchmarks.scenarios`; medians over the same runs as
there, and those of `AdaptiveKalman`, which knows nothing. *Ignorant* is the last floor that a scenario has.

Run: python -m benchmarks.drift_floors [--runs 10] [--only NAME ..] [--quick]
"""

from __future__ import annotations

import argparse
from itertools import combinations
from zlib import crc32

import numpy as np

from benchmarks.floors import best_histories, events
from benchmarks.scenarios import error, oracle
from benchmarks.unseen import Case, found, with_
from driftfit import AdaptiveKalman, track
from driftfit.engine.kernel import Array, Driver
from lab.bench.records import Record

WIDTHS = (9, 11, 14, 10, 16)
"""Of the columns."""
SIZES = np.array([0.0, *np.logspace(-8.0, 2.0, 26)])
"""Drift a sample as share q c / r of the noise, where one size is unknown."""
PAIRS, SLOPES, COMMON = np.logspace(-6.0, 1.0, 11), np.logspace(-14.0, -2.0, 31), np.logspace(-4.0, 0.0, 9)
"""The same for two parameters each, for slopes, and for one common walk in each of `DIRECTIONS`."""
DIRECTIONS, ENDS = 1500, 10
"""Random directions of a common walk, and samples between possible ends of a drift."""
NEGLIGIBLE = 20.0
"""Distance in log probability from the best at which a filter does not count."""


@Driver
def mixed_filters(x: Array, signals: Array, F: Array, Q: Array, plans: Array, theta: Array) -> None:
    """theta (2, T, n) with r and without its level, from filters z_t = F z_(t-1) + w, w ~ N(0, Q_b), y = x' z + v.

    ``signals`` (2, T) are y, NaN where it is skipped, and r; ``plans`` (2, B) the sample from which on Q (B, d, d) is 0
    and the log prior probability of each filter; theta are the first n of z.
    """
    y, r, ends, prior = signals[0], signals[1], plans[0], plans[1]
    (T, d), B, still = x.shape, len(Q), np.all(np.eye(len(F)) == F)
    z, P, g, back = np.zeros((B, d)), np.zeros((B, d, d)), np.zeros(d), np.ascontiguousarray(F.T)
    logs, squares, weight, count = np.zeros(B), np.zeros(B), np.zeros((2, B)), 0
    for i in range(d):
        for b in range(B):
            P[b, i, i] = 1e6
    for t in range(T):
        usable = np.isfinite(y[t])
        count += int(usable and t >= 2 * d)
        for b in range(B):
            if not still:
                z[b] = F @ z[b]
                P[b] = F @ P[b] @ back
            if t < ends[b]:
                P[b] += Q[b]
            if not usable:
                continue
            e, s = y[t], r[t]
            for i in range(d):
                g[i] = 0.0
                for j in range(d):
                    g[i] += P[b, i, j] * x[t, j]
                s += x[t, i] * g[i]
                e -= x[t, i] * z[b, i]
            for i in range(d):
                z[b, i] += g[i] * e / s
                for j in range(d):
                    P[b, i, j] -= g[i] * g[j] / s
            if t >= 2 * d:
                logs[b] += np.log(s)
                squares[b] += e * e / s
        if usable and count > 0:
            weight[0] = prior - 0.5 * (logs + squares)
            weight[1] = prior - 0.5 * (logs + count * np.log(squares))
        for way in range(2):
            most, total = weight[way].max(), 0.0
            theta[way, t] = 0.0
            for b in range(B):
                if weight[way, b] > most - NEGLIGIBLE:
                    p = np.exp(weight[way, b] - most)
                    total += p
                    for i in range(theta.shape[2]):
                        theta[way, t, i] += p * z[b, i]
            theta[way, t] /= total


def drifts(kind: str, c: Array) -> Array:
    """Drift covariances (B, n, n) in units of r, of parameters whose regressors have the mean squares c."""
    n = len(c)
    if kind in ("all", "ends"):
        return SIZES[:, None, None] * np.diag(1.0 / c)
    if kind == "slopes":
        return SLOPES[:, None, None] * np.diag(1.0 / c)
    if kind == "direction":
        way = np.random.default_rng(0).normal(size=(DIRECTIONS, n)) / np.sqrt(c)
        return np.concatenate([size * way[:, :, None] * way[:, None, :] for size in COMMON])
    if kind == "one":
        return np.concatenate([SIZES[:, None, None] * np.diag(np.arange(n) == i) / c[i] for i in range(n)])
    two = [np.diag(a * (np.arange(n) == i) + b * (np.arange(n) == j))
           for i, j in combinations(range(n), 2) for a in PAIRS for b in PAIRS]  # fmt: skip
    return np.array(two) / c


def mixture(case: Case, phi: Array, kinds: list[str], noise: tuple[float, float] = (0.0, 0.0)) -> Array:
    """theta (2, T, n); ``noise`` are the coefficients a and c of n_t = a n_(t-1) + v_t + c v_(t-1)."""
    (T, n), scale, more = phi.shape, np.median(case.r), sum(np.array(noise) != 0.0) and 2
    of_kind = [drifts(kind, np.nanmean(phi**2, axis=0)) * scale for kind in kinds]
    Q, prior = np.concatenate(of_kind), np.concatenate([np.full(len(q), -np.log(len(q))) for q in of_kind])
    B, d = len(Q), n + (n if kinds == ["slopes"] else more)
    x, F, whole, r = np.zeros((T, d)), np.eye(d), np.zeros((B, d, d)), case.r
    x[:, :n] = np.where(np.isfinite(phi), phi, 0.0)
    if kinds == ["slopes"]:
        F[:n, n:], whole[:, n:, n:] = np.eye(n), Q
    else:
        whole[:, :n, :n] = Q
    if more:  # the noise n_t and its part c v_t in the next sample are states, and no other noise is left
        F[n:, n:] = [[noise[0], 1.0], [0.0, 0.0]]
        both = np.array([1.0, noise[1]])
        x[:, n], whole[:, n:, n:], r = 1.0, scale * np.outer(both, both), np.zeros(T)
    plans = np.array([np.full(B, T), prior])
    if kinds == ["ends"]:
        dates = np.arange(0, T + 1, ENDS)
        whole, plans = np.repeat(whole, len(dates), axis=0), np.array([np.tile(dates, B), np.zeros(B * len(dates))])
    theta = np.empty((2, T, n))
    mixed_filters(x, np.array([np.where(case.blind, np.nan, case.y), r]), F, whole, plans, theta)
    return theta


def ignorant(case: Case, phi: Array) -> Array:
    """theta (T, n) of the filter that knows neither the kind of drift nor the noise, which it takes for constant."""
    kinds = ["all", "one", "two", "direction"] if phi.shape[1] <= 4 else ["all", "one", "two"]
    return mixture(with_(case, r=np.full(len(phi), np.median(case.r))), phi, kinds)[1]


def histories(case: Case, phi: Array, moves: Array, logs: Array) -> Array:
    """theta (1, T, n); a reading that is known to be frozen has no weight."""
    frozen = case.blind & (np.diff(case.y, prepend=np.nan) == 0.0)
    theta = np.empty((1, *phi.shape))
    best_histories(phi, case.y, np.where(frozen, 1e12, case.r), moves, logs, theta[0])
    return theta


def bursts() -> tuple[Array, Array]:
    """Rest for 200 samples on average, and drift for 50."""
    return np.array([[0, 0, 0, 1], [0.01, 0.01, 0.01, 1]]), np.log([[0.995, 0.005], [0.02, 0.98]])


ONE, TWO, ALL = "one parameter walks", "two parameters walk", "all walk alike"
KNOWN = {
    "one_of_eight": ("one", ONE),
    "few_of_twelve": ("two", TWO),
    "bias_beside_ar": ("one", ONE),
    "armax": ("two", f"{TWO}; c"),
    "quantised": ("one", ONE),
    "closed_loop": ("one", ONE),
    "near_unit_root": ("one", ONE),
    "start_up": ("ends", f"{ALL}, until some date"),
    "frozen_coarse": ("all", ALL),
    "very_slow": ("all", ALL),
    "little_noise": ("all", ALL),
    "correlated": ("direction", "one common walk"),
    "counts": ("one", ONE),
    "mean_reverting": ("all", ALL),
    "t3_noise": ("all", ALL),
    "garch": ("all", ALL),
    "missing_blocks": ("all", ALL),
    "scales": ("all", ALL),
    "integrated": ("slopes", "all slopes walk alike"),
    "short": ("all", ALL),
    "intercept": ("one", ONE),
    "steady": ("all", ALL),
    "ar_noise": ("all", f"{ALL}; a"),
}
"""Kind of drift, in words."""
COLOURED = {"armax": (0.0, 0.7), "ar_noise": (0.7, 0.0)}
"""Coefficients of noise that is not white."""
EVENTS = {
    "jumps_and_faults": (events(0.005, 0.49 * np.ones((1, 3)), (0.03, 200.0)), "all jump; outliers"),
    "one_sided_jump": (events(0.002, np.eye(4)), "one of 4 jumps"),
    "switch": (events(0.01, np.array([*np.eye(4), np.ones(4)])), "one or all jump"),
    "bursts": (bursts(), "all walk at times"),
}
"""Moves and log probabilities of events, in words."""


def ratios(name: str, seed: int) -> list[float]:
    """Errors over the oracle's: with r, without, also without the kind, and of AdaptiveKalman; NaN for none."""
    case = found()[name](np.random.default_rng([seed, crc32(name.encode())]))
    u = case.u if case.u.ndim == 2 else case.u[:, None]
    phi = np.ascontiguousarray(Record(case.model.bind(u.shape[1]), case.y, u).phi)
    c = np.nanmean(phi**2, axis=0)
    if name in KNOWN:
        kind, noise = KNOWN[name][0], COLOURED.get(name, (0.0, 0.0))
        paths = [*mixture(case, phi, [kind], noise)]
        walks = kind not in ("slopes", "ends") and not any(noise)
        paths.append(ignorant(case, phi) if walks else np.full(phi.shape, np.nan))
    else:
        paths = [*histories(case, phi, *EVENTS[name][0]), *np.full((2, *phi.shape), np.nan)]
    paths.append(track(case.model, AdaptiveKalman(), case.y, case.u).theta)
    least = error(case, oracle(case, phi), c)
    return [error(case, path, c) / least if np.isfinite(path[-1]).all() else np.nan for path in paths]


def line(name: str, row: list[float], digits: int = 2) -> str:
    """A line of the table."""
    cells = ["-" if np.isnan(value) else f"{value:.{digits}f}" for value in row]
    return f"{name:18}" + "".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--only", nargs="*", choices=[*KNOWN, *EVENTS])
    parser.add_argument("--quick", action="store_true", help="one run of one scenario")
    given = parser.parse_args()
    rows = []
    print(f"{'':18}{'r known':>9}{'r unknown':>11}{'kind unknown':>14}{'ignorant':>10}{'AdaptiveKalman':>16}")
    for name in given.only or (["near_unit_root"] if given.quick else [*KNOWN, *EVENTS]):
        runs = 1 if given.quick else given.runs if name != "very_slow" else max(2, given.runs // 5)
        *floors, ours = np.median([ratios(name, seed) for seed in range(runs)], axis=0)
        rows.append([*floors, [floor for floor in floors if np.isfinite(floor)][-1], ours])
        words = (KNOWN if name in KNOWN else EVENTS)[name][1]
        print(line(name, rows[-1]) + f"  {words}", flush=True)
    print(line("median", list(np.nanmedian(rows, axis=0))))
    print(line("above 1.05", [float(np.sum(np.array(column) > 1.05)) for column in zip(*rows, strict=True)], 0))


if __name__ == "__main__":
    main()

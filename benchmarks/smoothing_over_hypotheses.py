"""Does the smoother of mixtures equal the exact mixture, and do its bands hold, above all near jumps?

First table: 60 samples of a regression with two regressors, one parameter of which jumps in the middle by ``size``
standard deviations of the noise; in the last row it jumps back 15 samples later. The exact mixture is the sum over all
sets of up to two jump dates, each smoothed by itself; "decided" is the path given the changes that
`run.hypotheses.found()` names, with the same noise and drift. A sample is near if it is within six of a jump. Coverage
is that of 95 % bands, rms in units of that of the exact one.

Second table: 500 noisy readings of one level, which is constant, steps or walks, beside the mean of what is constant
between the true dates. Then `Bank()` and `AdaptiveKalman()`, which are given no numbers, on 400 samples of other kinds,
with the dates that `run.changes()` gives. The last lines are a record of 20,000 samples with a jump in every 200, and
for a bank to which drift and jump are given the samples at which the evidence is not constant.
Run: python benchmarks/smoothing_over_hypotheses.py [records, 60 by default] [--quick, three rows]
"""

from __future__ import annotations

import sys
from itertools import combinations

import numpy as np

from driftfit import AdaptiveKalman, Bank, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.results.smoothed import problem_of
from driftfit.bank.sensor import Sensor
from driftfit.run.result import Track
from driftfit.smooth import mixture

T, AT, NEAR, P0, STILL, JUMP, PROB = 60, 30, 6, 100.0, 1e-6, 9.0, 0.01
GIVEN = Bank([Change(STILL), Change(JUMP, prob=PROB)], [Sensor.nominal(1.0)], p0=P0)
Found = tuple[np.ndarray, np.ndarray]


def exact(y: np.ndarray, u: np.ndarray) -> Found:
    """Mean and standard deviation under all sets of up to two jumps: the smoother by Rauch, Tung and Striebel of each,
    weighted by its evidence."""
    T, n = u.shape
    dates = [one for k in range(3) for one in combinations(range(1, T), k)]
    Q = np.full((len(dates), T), STILL)
    for k, one in enumerate(dates):
        Q[k, list(one)] = JUMP
    jumps = np.array([len(one) for one in dates])
    logs = jumps * np.log(PROB) + (T - 1 - jumps) * np.log(1.0 - PROB)
    m, C = np.zeros((T, len(Q), n)), np.zeros((T, len(Q), n, n))
    at, P = np.zeros((len(Q), n)), np.tile(P0 * np.eye(n), (len(Q), 1, 1))
    for t in range(T):
        P = P + Q[:, t, None, None] * np.eye(n)
        g, e = P @ u[t], y[t] - at @ u[t]
        s = g @ u[t] + 1.0
        logs = logs - 0.5 * (np.log(s) + e * e / s)
        at, P = at + g * (e / s)[:, None], P - g[:, :, None] * g[:, None, :] / s[:, None, None]
        m[t], C[t] = at, P
    for t in range(T - 2, -1, -1):
        ahead = C[t] + Q[:, t + 1, None, None] * np.eye(n)
        G = np.linalg.solve(ahead, C[t]).swapaxes(1, 2)
        m[t] += np.einsum("kij,kj->ki", G, m[t + 1] - m[t])
        C[t] += G @ (C[t + 1] - ahead) @ G.swapaxes(1, 2)
    w = np.exp(logs - logs.max())
    w /= w.sum()
    mean = np.einsum("k,tki->ti", w, m)
    var = np.einsum("k,tki->ti", w, np.einsum("tkii->tki", C) + (m - mean[:, None]) ** 2)
    return mean, np.sqrt(var)


def decided(run: Track) -> Found:
    """The path given the changes that were found, each at its most likely date."""
    kinds, bank = np.zeros(len(run), int), run.tracker
    for event in run.hypotheses.found():  # type: ignore[attr-defined]
        if event.kind == "change":
            kinds[event.span.date] = bank.change_names.index(event.name)  # type: ignore[attr-defined]
    found = mixture.smooth(problem_of(run, [], kinds))
    return found.theta, np.sqrt(found.cov)


def over_all(run: Track) -> Found:
    found = run.smooth()  # type: ignore[attr-defined]
    return found.theta, found.std


def held(found: Found, theta: np.ndarray, near: np.ndarray) -> list[float]:
    """Coverage and mean square error near jumps and everywhere."""
    inside, squares = np.abs(found[0] - theta) < 1.96 * found[1], (found[0] - theta) ** 2
    return [inside[near].mean(), squares[near].mean(), inside.mean(), squares.mean()]


SIZES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


def sizes(records: int, rows: tuple[tuple[float, int], ...] = (*((size, 0) for size in SIZES), (3.0, 15))) -> None:
    """``rows``: sizes, and samples until theta jumps back, or 0."""
    print("         coverage near the jump      rms near, of exact    coverage overall            rms, of exact")
    print(" size   exact  mixture  decided    mixture  decided    exact  mixture  decided    mixture  decided")
    for size, back in rows:
        near = (np.abs(np.arange(T) - AT + 0.5) < NEAR) | (back > 0) & (np.abs(np.arange(T) - AT - back + 0.5) < NEAR)
        found = []
        for seed in range(records):
            rng = np.random.default_rng([seed, int(10 * size)])
            u, theta = rng.standard_normal((T, 2)), rng.standard_normal((1, 2)) + np.zeros((T, 1))
            theta[AT : AT + back if back else T, 0] += size * rng.choice([-1.0, 1.0])
            y = (u * theta).sum(axis=1) + rng.standard_normal(T)
            run = track(Regression(2), GIVEN, y, u)
            found.append([held(one, theta, near) for one in (exact(y, u), over_all(run), decided(run))])
        a, s, b, r = np.mean(found, axis=0).T
        s, r = np.sqrt(s / s[0]), np.sqrt(r / r[0])
        print(
            f"{f'{size:.0f}, -{size:.0f}' if back else f'{size:.1f}':>5} {a[0]:7.3f} {a[1]:8.3f} {a[2]:8.3f}"
            f" {s[1]:10.3f} {s[2]:8.3f} {b[0]:8.3f} {b[1]:8.3f} {b[2]:8.3f} {r[1]:10.3f} {r[2]:8.3f}"
        )


def levels(records: int, kinds: tuple[str, ...] = ("constant", "step of 1", "walk of 0.05")) -> None:
    print(f"{'noise of 0.5':14} {'rms':>21} {'coverage':>23}")
    print(f"{'':14} {'dates given':>12} {'Bank':>7} {'AdaptiveKalman':>15} {'Bank':>7} {'AdaptiveKalman':>15}")
    for kind in kinds:
        found = []
        for seed in range(records):
            rng = np.random.default_rng([seed, *kind.encode()])
            theta = {
                "c": np.zeros(500), "s": np.arange(500) // 250 * 1.0, "w": np.cumsum(0.05 * rng.standard_normal(500))
            }[kind[0]]  # fmt: skip
            y, parts = theta + 0.5 * rng.standard_normal(500), 2 if kind[0] == "s" else 1
            given = np.repeat(y.reshape(parts, -1).mean(axis=1), 500 // parts)
            row = [np.mean((given - theta) ** 2)]
            for tracker in (Bank(), AdaptiveKalman()):
                smoothed = track(Regression(1), tracker, y, np.ones((500, 1))).smooth()
                away = smoothed.theta[:, 0] - theta
                row += [np.mean(away**2), np.mean(np.abs(away) < 1.96 * smoothed.std[:, 0])]
            found.append(row)
        known, bank, banked, default, inside = np.mean(found, axis=0)
        first = "-" if kind[0] == "w" else f"{known**0.5:.3f}"
        print(f"{kind:14} {first:>12} {bank**0.5:7.3f} {default**0.5:15.3f} {banked:7.3f} {inside:15.3f}")


KINDS = (
    "constant", "one jump of 1.5", "one jump of 3", "two jumps 15 apart", "ramp", "walk", "walk of one", "t3 noise",
    "a burst of noise", "a gap at the jump",
)  # fmt: skip


def record(kind: str, rng: np.random.Generator, T: int = 400) -> tuple[np.ndarray, ...]:
    """y, u, theta, and the samples that are near a jump."""
    u, t, noise = rng.standard_normal((T, 2)), np.arange(T), rng.standard_normal(T)
    theta, dates = np.tile([1.0, -0.5], (T, 1)), []
    if "jump" in kind or "noise" in kind:
        dates = [200, 215] if "two" in kind else [200]
        for date, way in zip(dates, (1.0, -1.0), strict=False):
            theta[date:, 0] += way * (1.5 if "1.5" in kind else 3.0)
    if kind == "ramp":
        theta[:, 0] += np.clip((t - 150) / 100.0, 0.0, 1.0) * 3.0
    if kind.startswith("walk"):
        theta += np.cumsum(0.1 * rng.standard_normal((T, 2)) * ([1.0, 0.0] if "one" in kind else 1.0), axis=0)
    if kind == "t3 noise":
        noise = rng.standard_t(3, T) / np.sqrt(3.0)
    if "burst" in kind:
        noise[250:300] *= 3.0
    y = (u * theta).sum(axis=1) + noise
    if "gap" in kind:
        y[190:210] = np.nan
    near = np.zeros(T, bool)
    for date in dates:
        near |= np.abs(t - date + 0.5) < NEAR
    return y, u, theta, near


def kinds(tracker: Bank | AdaptiveKalman, records: int, some: tuple[str, ...] = KINDS) -> None:
    heads = "coverage near  overall       rms   rms filtered   dates found, of  held  samples in the set  false"
    print(f"{tracker!r:20} {heads}")
    for kind in some:
        rows, dates = [], []
        for seed in range(records):
            y, u, theta, near = record(kind, np.random.default_rng([seed, *kind.encode()]))
            run = track(Regression(2), tracker, y, u)
            smoothed = run.smooth()
            rows.append([*held((smoothed.theta, smoothed.std), theta, near if near.any() else ~near),
                         np.mean((run.theta - theta)[30:] ** 2)])  # fmt: skip
            jumps = np.flatnonzero(np.abs(np.diff(theta[:, 0])) > 1.0) + 1
            sets = [(event.span.first, event.span.last) for event in run.changes()]
            by = [[one for one in sets if one[0] - 25 <= at <= one[1] + 25] for at in jumps]
            inside = [sum(a <= at <= b for a, b in some) > 0 for at, some in zip(jumps, by, strict=True)]
            right = {one for some in by for one in some}
            dates.append([len(jumps), sum(map(bool, by)), sum(inside), sum(b - a + 1 for a, b in right), len(right),
                          len(sets) - len(right)])  # fmt: skip
        near_in, _, inside, squares, filtered = np.mean(rows, axis=0)
        there, found, holds, length, count, false = np.sum(dates, axis=0)
        print(
            f"{kind:20} {near_in:13.3f} {inside:8.3f} {squares**0.5:9.3f} {filtered**0.5:14.3f} {found:13d} {there:3d}"
            f" {holds / max(found, 1):5.3f} {length / max(count, 1):19.1f} {false:6d}"
        )


def long(tracker: Bank | AdaptiveKalman, T: int) -> None:
    rng = np.random.default_rng(0)
    u, theta = rng.standard_normal((T, 2)), np.zeros((T, 2))
    for date in range(100, T, 200):
        theta[date:] += 3.0 * rng.standard_normal(2)
    run = track(Regression(2), tracker, (u * theta).sum(axis=1) + rng.standard_normal(T), u)
    found = run.smooth()
    inside, rms = np.mean(np.abs(found.theta - theta) < 1.96 * found.std), np.mean((found.theta - theta) ** 2) ** 0.5
    uneven = f", evidence not constant at {found.uneven.sum()}" if tracker is GIVEN else ""
    print(f"{T} samples, {type(tracker).__name__}: coverage {inside:.3f}, rms {rms:.3f}{uneven}")


if __name__ == "__main__":
    number = int(([*filter(str.isdigit, sys.argv[1:]), "60"])[0])
    if "--quick" in sys.argv:
        sizes(number, ((6.0, 0),))
        levels(number // 4, ("step of 1",))
        kinds(AdaptiveKalman(), number // 4, ("one jump of 3",))
    else:
        sizes(number)
        levels(number // 4)
        for tracker in (Bank(), AdaptiveKalman()):
            kinds(tracker, number // 4)
        for tracker in (GIVEN, AdaptiveKalman()):
            long(tracker, 20_000)

"""Coverage of the smoothed 95 % bands of `AdaptiveKalman`, on records that no constant was chosen on.

Two parameters walk at random in noise of 0.3; samples 100 on are counted. "below 0.8" is the share of records in whose
bands less than 80 % of the path lies: with a slow walk a record can look as if nothing moved.

The second table is for other paths of two parameters, 800 samples: the error of the smoothed path, that of the filter,
the coverage of the smoothed bands, and the share of records in which slopes walk instead of levels.
Run: python benchmarks/smoothing_coverage.py [records, 200 by default] [--quick, a row]
"""

import sys

import numpy as np

from driftfit import AdaptiveKalman, Regression, track


def main(records: int = 200) -> None:
    print(f"{'step':>6} {'samples':>8} {'followed':>9} {'smoothed':>9} {'+-':>6} {'below 0.8':>10}")
    for step, T in ((0.003, 500), (0.01, 500), (0.03, 500), (0.1, 500), (0.01, 2000)):
        followed, smoothed = [], []
        for seed in range(1000, 1000 + records):
            rng = np.random.default_rng(seed)
            u, theta = rng.normal(size=(T, 2)), 1.0 + np.cumsum(step * rng.normal(size=(T, 2)), axis=0)
            run = track(Regression(2), AdaptiveKalman(), (u * theta).sum(axis=1) + 0.3 * rng.normal(size=T), u)
            for found, result in ((followed, run), (smoothed, run.smooth())):
                found.append(np.mean((np.abs(result.theta - theta) < 1.96 * result.std)[100:]))
        error = np.std(smoothed) / np.sqrt(records)
        below = np.mean(np.array(smoothed) < 0.8)
        print(f"{step:>6} {T:>8} {np.mean(followed):>9.3f} {np.mean(smoothed):>9.3f} {error:>6.3f} {below:>10.3f}")


KINDS = ("slopes walk", "slopes walk slowly", "one ramp", "sines", "ramps with corners", "walk", "constant", "jumps")


def path(kind: str, rng: np.random.Generator, T: int = 800) -> np.ndarray:
    """Two parameters (T, 2)."""
    t, steps = np.arange(T), rng.normal(size=(T, 2))
    if kind.startswith("slopes walk"):
        return 1.0 + np.cumsum(np.cumsum((2e-4 if "slowly" in kind else 1e-3) * steps, axis=0), axis=0)
    if kind == "one ramp":
        return np.column_stack([np.linspace(0.0, 2.0, T), np.ones(T)])
    if kind == "sines":
        return np.column_stack([np.sin(t / 80.0), np.sin(t / 80.0 + 1.0)])
    if kind == "ramps with corners":
        corners = [np.interp(t, np.sort(rng.choice(T, 4, replace=False)), rng.normal(size=4)) for _ in range(2)]
        return np.column_stack(corners)
    jump = (rng.random(T) < 0.005)[:, None]
    return 1.0 + np.cumsum({"walk": 0.02, "constant": 0.0, "jumps": jump}[kind] * steps, axis=0)


def shapes(kinds: tuple[str, ...] = KINDS, records: int = 40) -> None:
    print(f"{'':20} {'smoothed':>9} {'filtered':>9} {'in band':>8} {'slopes':>7}")
    for kind in kinds:
        rows = []
        for seed in range(records):
            rng = np.random.default_rng([seed, *kind.encode()])
            theta = path(kind, rng)
            u = rng.normal(size=theta.shape)
            run = track(Regression(2), AdaptiveKalman(), (u * theta).sum(axis=1) + 0.3 * rng.normal(size=len(u)), u)
            found = run.smooth()
            away, behind = found.theta - theta, run.theta - theta
            inside = np.mean(np.abs(away) < 1.96 * found.std)
            rows.append((np.mean(away**2), np.mean(behind[50:] ** 2), inside, len(found.walk.trend) > 0))
        smoothed, filtered, inside, slopes = np.mean(rows, axis=0)
        print(f"{kind:20} {smoothed**0.5:>9.4f} {filtered**0.5:>9.4f} {inside:>8.3f} {slopes:>7.2f}")


if __name__ == "__main__":
    if "--quick" in sys.argv:
        shapes(KINDS[:1])
    else:
        main(*map(int, sys.argv[1:2]))
        shapes()

"""Coverage of the smoothed 95 % bands of `AdaptiveKalman`, on records that no constant was chosen on.

Two parameters walk at random in noise of 0.3; samples 100 on are counted. "below 0.8" is the share of records in whose
bands less than 80 % of the path lies: with a slow walk a record can look as if nothing moved.
Run: python benchmarks/smoothing_coverage.py [records, 200 by default] [--quick]
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


if __name__ == "__main__":
    quick = "--quick" in sys.argv
    main(*([2] if quick else (int(given) for given in sys.argv[1:2])))

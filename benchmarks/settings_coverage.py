"""How often 95 % bands contain the truth: under the settings that `tune` found, averaged over settings, and adaptive.

y = u' theta + v with two white inputs, r = 1 and random walks theta with variances q per sample; each parameter has its
own drift, which is estimated. *error* is the root mean square error of the estimates over that of the filter, or
smoother, that knows q and r. The first 20 samples are left out.

The second table has the share of records of constant parameters in which `likelihood_ratio` rejects a null hypothesis
that is true, at three levels.

Run: python benchmarks/settings_coverage.py [--records 40] [--quick]
"""

import argparse
import warnings

import numpy as np

from driftfit import AdaptiveKalman, Kalman, Regression, Track, likelihood_ratio, track, tune
from driftfit.engine.kernel import Array

BURN, HALF = 20, 1.96
CASES = [(T, q) for T in (60, 200, 800) for q in ((1e-2, 0.0), (1e-3, 1e-3), (1e-4, 1e-4))]
ROWS = ("tuned", "averaged", "AdaptiveKalman", "tuned, smoothed", "averaged, smoothed")


def record(T: int, q: tuple[float, float], seed: int) -> tuple[Array, Array, Array]:
    """y, u and theta."""
    rng = np.random.default_rng([seed, T])
    u = rng.normal(size=(T, 2))
    theta = np.array([1.0, -1.0]) + np.cumsum(np.sqrt(q) * rng.normal(size=(T, 2)), axis=0)
    return np.sum(u * theta, axis=1) + rng.normal(size=T), u, theta


def estimates(y: Array, u: Array) -> list[tuple[Array, Array]]:
    """theta and its standard deviation, in the order of `ROWS`."""
    model = Regression(2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an optimum at a bound
        tuned = tune(model, Kalman(), y, u, groups="each")
    assert not isinstance(tuned, dict)
    run, adaptive, mean = track(model, tuned.tracker, y, u), track(model, AdaptiveKalman(), y, u), tuned.average()
    assert isinstance(run, Track)
    assert isinstance(adaptive, Track)
    path = run.smooth()
    return [
        (run.theta, run.std),
        (mean.theta, mean.std),
        (adaptive.theta, adaptive.std),
        (path.theta, path.std),
        (mean.smoothed_theta, mean.smoothed_std),
    ]


def scores(T: int, q: tuple[float, float], seed: int) -> Array:
    """Share within the band, and error over that of the filter that knows, (5, 2)."""
    y, u, theta = record(T, q, seed)
    knows = track(Regression(2), Kalman(q=q, r=1.0), y, u)
    rows = []
    for name, (estimate, std) in zip(ROWS, estimates(y, u), strict=True):
        best = knows.smooth().theta if "smoothed" in name else knows.theta
        off, least = (estimate - theta)[BURN:], (best - theta)[BURN:]
        rows.append((np.mean(np.abs(off) <= HALF * std[BURN:]), np.sqrt(np.mean(off**2) / np.mean(least**2))))
    return np.array(rows)


LEVELS = (0.01, 0.05, 0.10)
NULLS = ("no drift, one q", "no drift, each q", "one q, each q")


def rejections(T: int, seed: int) -> list[float]:
    """p-values in the order of `NULLS`, of a record of constant parameters."""
    y, u, _ = record(T, (0.0, 0.0), seed)
    model = Regression(2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an optimum at a bound
        still, one = tune(model, Kalman(q=0.0), y, u), tune(model, Kalman(), y, u)
        each = tune(model, Kalman(), y, u, groups="each")
    return [likelihood_ratio(*pair).p for pair in ((still, one), (still, each), (one, each))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--quick", action="store_true", help="two records of one case")
    given = parser.parse_args()
    print(f"{'T':>4}  {'q':14}" + "".join(f"{name:>20}" for name in ROWS))
    for T, q in CASES[:1] if given.quick else CASES:
        means = np.mean([scores(T, q, seed) for seed in range(2 if given.quick else given.records)], axis=0)
        cells = "".join(f"{f'{inside:.2f} (error {error:.2f})':>20}" for inside, error in means)
        print(f"{T:4}  {f'{q[0]:g}, {q[1]:g}':14}{cells}", flush=True)
    print("\nrejected at" + "".join(f"{f'{level:.0%}':>8}" for level in LEVELS))
    for T in (60,) if given.quick else (60, 200):
        found = np.array([rejections(T, seed) for seed in range(2 if given.quick else 10 * given.records)])
        for name, p in zip(NULLS, found.T, strict=True):
            print(f"{T:4}  {name:18}" + "".join(f"{np.mean(p < level):8.1%}" for level in LEVELS), flush=True)


if __name__ == "__main__":
    main()

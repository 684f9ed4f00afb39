"""First-passage forecasts compared with simulated crossings: shares of records, model by model.

Every record follows its model to the end of its data, and its path continues for HORIZON samples. The forecasts are
correct if the share that crossed is the mean of the probabilities, and if a tenth, half and nine tenths of the
crossings occurred by the predicted times. Run: python examples/crossing.py [RECORDS]
"""

import sys

import numpy as np

from driftfit import FLS, AdaptiveKalman, Kalman, Regression, Track, track
from driftfit.extend import Array

T, HORIZON, NOISE = 150, 300, 0.2
AWAY = 0.5


def walks(rng: np.random.Generator, count: int, q: float, slopes: bool) -> Array:
    """Gains (count, T + HORIZON): random walks, or random walks of the slope."""
    steps = np.sqrt(q) * rng.normal(size=(count, T + HORIZON))
    return 5.0 + np.cumsum(np.cumsum(steps, axis=1) if slopes else steps, axis=1)


def scored(runs: list[Track], paths: Array) -> tuple[float, ...]:
    """Share that crossed and its forecast; shares that had crossed by the times predicted for 10, 50, 90 %."""
    forecast, came, by = [], [], []
    for run, path in zip(runs, paths, strict=True):
        limit = float(run.theta[-1, 0]) - AWAY
        found = run.crossing("gain", below=limit, horizon=HORIZON)
        later = np.flatnonzero(path[T - 1 :] < limit)
        when = later[0] if len(later) else np.inf
        forecast.append(found.probability)
        came.append(when < np.inf)
        # a record can check a time only if it is within the horizon
        by.append([when <= t if (t := found.quantile(p)) < np.inf else np.nan for p in (0.1, 0.3, 0.5)])
    return (float(np.mean(came)), float(np.mean(forecast)), *(float(x) for x in np.nanmean(by, axis=0)))


def main(count: int = 200) -> None:
    rng = np.random.default_rng(0)
    cases = {
        "random walk, Kalman": (4e-3, False, Kalman(q=4e-3, r=NOISE**2)),
        "random walk, AdaptiveKalman": (4e-3, False, AdaptiveKalman()),
        "walking slope, FLS": (1e-5, True, FLS(NOISE**2 / 1e-5, differences=2)),
    }
    print(f"{'':28s} crossed  forecast  by 10 %  by 30 %  by 50 %")
    for name, (q, slopes, tracker) in cases.items():
        paths = walks(rng, count, q, slopes)
        u = 1.0 + rng.random((count, T))
        y = paths[:, :T] * u + NOISE * rng.normal(size=(count, T))
        fleet = track(Regression(["gain"]), tracker, y, u, by="row")
        came, forecast, *by = scored(list(fleet.values()), paths)
        print(f"{name:28s} {came:6.2f} {forecast:9.2f} " + " ".join(f"{x:8.2f}" for x in by))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))

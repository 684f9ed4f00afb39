"""When does it cross? First-passage forecasts against what came: shares of records, model by model.

Every record follows its model to the end of its data; the path then goes on for HORIZON samples more. A forecast is
right on the whole if the share that crossed is the mean of the probabilities, and if a tenth, half and nine tenths of
the crossings came by the times that were given for them. Run: python examples/crossing.py [RECORDS]
"""

import sys

import numpy as np

from driftfit import FLS, AdaptiveKalman, Kalman, Regression, track
from driftfit.engine.kernel import Array
from driftfit.results import Track

T, HORIZON, NOISE = 150, 300, 0.2
AWAY = 0.5


def walks(rng: np.random.Generator, count: int, q: float, slopes: bool) -> Array:
    """Gains (count, T + HORIZON): random walks, or walks of the slope."""
    steps = np.sqrt(q) * rng.normal(size=(count, T + HORIZON))
    return 5.0 + np.cumsum(np.cumsum(steps, axis=1) if slopes else steps, axis=1)


def scored(runs: list[Track], paths: Array) -> tuple[float, ...]:
    """Share that crossed and what was said; shares of records that had crossed by the times given for 10, 50, 90 %."""
    said, came, by = [], [], []
    for run, path in zip(runs, paths, strict=True):
        limit = float(run.theta[-1, 0]) - AWAY
        found = run.crossing("gain", below=limit, horizon=HORIZON)
        later = np.flatnonzero(path[T - 1 :] < limit)
        when = later[0] if len(later) else np.inf
        said.append(found.probability)
        came.append(when < np.inf)
        # only where the time lies within the horizon can the record say whether it was right
        by.append([when <= t if (t := found.quantile(p)) < np.inf else np.nan for p in (0.1, 0.3, 0.5)])
    return (float(np.mean(came)), float(np.mean(said)), *(float(x) for x in np.nanmean(by, axis=0)))


def main(count: int = 200) -> None:
    rng = np.random.default_rng(0)
    cases = {
        "random walk, Kalman": (4e-3, False, Kalman(q=4e-3, r=NOISE**2)),
        "random walk, AdaptiveKalman": (4e-3, False, AdaptiveKalman()),
        "walking slope, FLS": (1e-5, True, FLS(NOISE**2 / 1e-5, differences=2)),
    }
    print(f"{'':28s} crossed   said   by 10 %  by 30 %  by 50 %")
    for name, (q, slopes, tracker) in cases.items():
        paths = walks(rng, count, q, slopes)
        u = 1.0 + rng.random((count, T))
        y = paths[:, :T] * u + NOISE * rng.normal(size=(count, T))
        fleet = track(Regression(["gain"]), tracker, y, u, by="row")
        came, said, *by = scored(list(fleet.values()), paths)
        print(f"{name:28s} {came:6.2f} {said:7.2f} " + " ".join(f"{x:8.2f}" for x in by))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))

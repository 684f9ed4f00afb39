"""Time and accuracy compared with river's linear models, in its own `evaluate.progressive_val_score`.

Every model predicts each sample and then learns it, behind river's StandardScaler. Microseconds per sample are
processor time, the least of repeated runs after one that compiles; they contain the scaler, the metric and the
dictionaries, which are printed as "nothing learned". The error is the root mean square over the whole stream, the start
included.

    approval    river's TrumpApproval: 1001 days, six pollsters
    walk k      k coefficients that are random walks, noise 0.5, 4000 samples, simulated

Needs river. Run: python benchmarks/river_models.py [--quick]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from river import datasets, dummy, evaluate, linear_model, metrics, optim, preprocessing, stats

from driftfit import RLS, Kalman
from driftfit.bridges.river import TrackedRegressor

Stream = list[tuple[dict[str, float], float]]

MODELS: dict[str, Callable[[], Any]] = {
    "nothing learned": lambda: dummy.StatisticRegressor(stats.Mean()),
    "LinearRegression": linear_model.LinearRegression,
    "LinearRegression, Adam": lambda: linear_model.LinearRegression(optim.Adam(0.1)),
    "PARegressor": linear_model.PARegressor,
    "BayesianLinearRegression": lambda: linear_model.BayesianLinearRegression(smoothing=0.98),
    "our RLS": lambda: TrackedRegressor(RLS(0.98)),
    "our Kalman": lambda: TrackedRegressor(Kalman(q=0.01, r=0.25)),
    "our AdaptiveKalman": TrackedRegressor,
}


def walk(k: int, T: int) -> Stream:
    """A regression on k features whose coefficients are random walks."""
    rng = np.random.default_rng(k)
    X = rng.normal(size=(T, k))
    y = np.sum(X * (rng.normal(size=k) + np.cumsum(0.1 * rng.normal(size=(T, k)), axis=0)), axis=1)
    y += 0.5 * rng.normal(size=T)
    return [({f"x{j}": x for j, x in enumerate(row)}, float(target)) for row, target in zip(X.tolist(), y, strict=True)]


def scored(make: Callable[[], Any], stream: Stream, repeat: int) -> tuple[float, float]:
    """(microseconds per sample, root mean square error)."""
    times = []
    for _ in range(repeat + 1):
        model, metric = preprocessing.StandardScaler() | make(), metrics.RMSE()
        start = time.process_time()
        evaluate.progressive_val_score(stream, model, metric)
        times.append((time.process_time() - start) / len(stream) * 1e6)
    return min(times[1:]), metric.get()


def main(quick: bool = False) -> None:
    streams: dict[str, Stream] = {} if quick else {"approval": list(datasets.TrumpApproval())}
    for k in (2,) if quick else (2, 8, 20):
        streams[f"walk {k}"] = walk(k, 200 if quick else 4000)
    table = Table(box=None, padding=(0, 1, 0, 0))
    for head in ("µs per sample / error", *streams):
        table.add_column(head, justify="left" if head[0] == "µ" else "right")
    for name, make in MODELS.items():
        cells = [scored(make, stream, 1 if quick else 3) for stream in streams.values()]
        table.add_row(name, *(f"{micro:.0f} / {error:.3g}" for micro, error in cells))
    Console(width=110).print(table)


if __name__ == "__main__":
    main("--quick" in sys.argv)

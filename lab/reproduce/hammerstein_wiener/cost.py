"""The cost of separation in addition to the filter (remark 4): nanoseconds per sample by order."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Legendre
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.separation import METHODS, split
from driftfit.trackers.kalman import Kalman
from driftfit.tracking import track

ORDERS = ((2, 2, 3, 3), (3, 3, 3, 4), (4, 4, 5, 5))
REPEATS = 5


def least(function: Callable[[], object], samples: int) -> float:
    """Nanoseconds per sample, the least of several runs."""
    function()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e9 * min(times) / samples


def measure(
    samples: int = 5000, orders: tuple[tuple[int, int, int, int], ...] = ORDERS
) -> dict[tuple[int, ...], dict[str, float]]:
    """ns per sample, the least of five, for (na, nb, n_in, n_out); the last order without its filter step."""
    found: dict[tuple[int, ...], dict[str, float]] = {}
    rng = np.random.default_rng(0)
    for order in orders:
        na, nb, n_in, n_out = order
        model = HammersteinWiener(na, nb, input=Legendre(n_in, (-4, 4)), output=Legendre(n_out, (-4, 4)))
        y, u = rng.uniform(-3.0, 3.0, (2, samples))
        xi = rng.normal(size=(samples, model.structure.n_x))
        theta: Array = model.structure.products(xi) + 0.01 * rng.normal(size=(samples, model.n))
        row = {method: least(partial(split, model, theta, method), samples) for method in METHODS[:3]}
        if model.n < 30:
            tracker = Kalman(q=1e-3, r=1.0, p0=1e2)
            row["filter"] = least(partial(track, model, tracker, y, u), samples)
        found[order] = row
    return found


def table(times: dict[tuple[int, ...], dict[str, float]]) -> Table:
    """Nanoseconds per sample."""
    shown = Table(box=SIMPLE_HEAD, show_edge=False, title="Nanoseconds a sample", title_justify="left")
    for head in ("na, nb, n_in, n_out", "filter step", *METHODS[:3]):
        shown.add_column(head, justify="right")
    for order, row in times.items():
        step = f"{row['filter']:.0f}" if "filter" in row else "-"
        shown.add_row(", ".join(map(str, order)), step, *(f"{row[m]:.0f}" for m in METHODS[:3]))
    return shown

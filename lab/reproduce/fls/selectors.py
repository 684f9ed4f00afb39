"""How the weight is chosen: the selectors of `tune` on the examples, and on records that are random walks.

On a random walk with mu = r / q = 1, 10 and 100 a selector should find mu, and its 95 % interval should cover in 95 %
of the records. On the examples, whose parameters are no random walks, the error of the smoothed path counts.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.progress import track as progress
from rich.table import Table

from driftfit.models.regression import Regression
from driftfit.run.result import root_mean_square as rms
from driftfit.systems.drift import RandomWalk, paths
from driftfit.systems.time_varying import MU, Simulated, example
from driftfit.trackers.fls import FLS
from driftfit.tracking import track
from driftfit.tune.tune import tune
from driftfit.tune.tuned import Tuned

METHODS = ("ml", "loo", "gcv")
SEEDS = {"sinusoids": 100, "rational": 60, "switching": 25, "exp-ar": 40}
REFERENCE = {
    "paper": (0.172, 0.309, 0.164, 0.218),
    "ml": (0.116, 0.141, 0.062, 0.077),
    "loo": (0.116, 0.262, 0.061, 0.079),
    "gcv": (0.116, 0.190, 0.063, 0.077),
    "best": (0.114, 0.109, 0.060, 0.074),
}
"""Median parameter error of the smoothed path over all samples, from an independent implementation."""
WALKS = {1.0: (0.99, 0.97), 10.0: (10.8, 9.2), 100.0: (138.0, 97.0)}
"""True mu: medians by "ml" and "loo" from the same."""
GRID = np.logspace(-4.0, 5.0, 19)
RECORDS = 100


class Choice(NamedTuple):
    """Median parameter error, median weight, and the share of records in which the weight ended at a bound."""

    error: float
    mu: float
    at_bound: float


def path_error(d: Simulated, mu: float) -> float:
    """Rms parameter error of the smoothed path."""
    return rms(track(d.model, FLS(mu), d.y, d.u).smooth().theta - d.theta)


def choose(d: Simulated, method: str) -> Tuned:
    """One tuning, a bound being a result here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        tuned = tune(d.model, FLS(), d.y, d.u, method=method)
    assert isinstance(tuned, Tuned)  # one output
    return tuned


def on_example(name: str) -> dict[str, Choice]:
    """Every selector on one example, with the weight of the paper and the best of a grid for each record."""
    records = [example(name, s) for s in range(SEEDS[name])]
    found = {"paper": Choice(float(np.median([path_error(d, MU[name]) for d in records])), MU[name], 0.0)}
    for method in METHODS:
        tuned = [choose(d, method) for d in records]
        mu = [t.chosen["mu"] for t in tuned]
        errors = [path_error(d, m) for d, m in zip(records, mu, strict=True)]
        found[method] = Choice(
            float(np.median(errors)), float(np.median(mu)), float(np.mean([bool(t.at_bound) for t in tuned]))
        )
    each = np.array([[path_error(d, mu) for mu in GRID] for d in records])
    best = GRID[np.argmin(each, axis=1)]
    return found | {"best": Choice(float(np.median(each.min(axis=1))), float(np.median(best)), 0.0)}


def random_walk(mu: float, seed: int, T: int = 200) -> Simulated:
    """Two random walks of r / q = mu with r = 1, observed through white regressors."""
    rng = np.random.default_rng(seed)
    theta = paths([RandomWalk(0.0, mu**-0.5)] * 2, T, rng)
    phi = rng.normal(size=(T, 2))
    return Simulated(Regression(2), np.sum(phi * theta, axis=1) + rng.normal(size=T), phi, phi, theta)


def table_of_examples() -> Table:
    """Errors and weights by selector."""
    title = "Median parameter error of the smoothed path (reference) @ median weight, share of records at a bound"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title_justify="left", title=title)
    for head in ("", *SEEDS):
        table.add_column(head, justify="right" if head else "left")
    found = [on_example(name) for name in progress(SEEDS, "selectors", transient=True)]
    for selector, references in REFERENCE.items():
        cells = []
        for choices, reference in zip(found, references, strict=True):
            choice = choices[selector]
            bound = f", {100 * choice.at_bound:.0f} %" if choice.at_bound else ""
            cells.append(f"{choice.error:.3f} ({reference:.3f}) @ {choice.mu:.2g}{bound}")
        table.add_row(selector, *cells)
    return table


def table_of_walks(records: int = RECORDS) -> Table:
    """Medians, coverage of the intervals and loss against the true weight."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, title_justify="left",
                  title=f"Random walks, n = 2, L = 200, {records} records")  # fmt: skip
    for head in ("true mu", "ml (reference)", "loo (reference)", "95 % intervals cover", "error / error at true mu"):
        table.add_column(head, justify="right")
    for mu, (ml, loo) in progress(WALKS.items(), "random walks", transient=True):
        walks = [random_walk(mu, s) for s in range(records)]
        by = {method: [choose(d, method) for d in walks] for method in ("ml", "loo")}
        medians = {method: np.median([t.chosen["mu"] for t in tuned]) for method, tuned in by.items()}
        covered = np.mean([t.interval["mu"][0] <= mu <= t.interval["mu"][1] for t in by["ml"]])
        loss = [path_error(d, t.chosen["mu"]) / path_error(d, mu) for d, t in zip(walks, by["ml"], strict=True)]
        table.add_row(
            f"{mu:g}", f"{medians['ml']:.3g} ({ml:g})", f"{medians['loo']:.3g} ({loo:g})", f"{100 * covered:.0f} %",
            f"{np.median(loss):.3f}",
        )  # fmt: skip
    return table

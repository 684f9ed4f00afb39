"""Flexible least squares, reproduced: four examples, one hundred noise seeds, every method at the weight of the paper.

Prints the medians and reference values, the best weight of each method, the cost of each algorithm as the record grows,
and the verdicts on the claims of the paper; draws the paper's ten figures. Source: Chen et al., "augmented flexible
least squares for time-varying parameter systems", sections 5 and 6. Run ``python -m lab reproduce fls --help``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track as progress
from rich.table import Table

from driftfit.engine.kernel import Array
from driftfit.run.result import root_mean_square as rms
from driftfit.smooth.augmented import augmented
from driftfit.systems.time_varying import EXAMPLES, MU, Simulated, example
from driftfit.trackers.augmented_fls import AugmentedFLS
from driftfit.trackers.fls import FLS
from driftfit.tracking import track

SEEDS = 100
METHODS = ("A-FLS on-line", "A-FLS smoothed", "T-FLS filtered", "T-FLS smoothed", "constant LS", "zero")
REFERENCE: dict[str, dict[str, tuple[float | None, ...]]] = {
    "sinusoids": {
        "parameters": (0.418, 0.481, 0.302, 0.173, 0.686, 0.693),
        "one-step": (0.647, None, 0.565, None, None, None),
        "a posteriori": (0.323, 0.416, 0.154, 0.134, None, None),
    },
    "rational": {
        "parameters": (0.203, 0.123, 0.356, 0.305, 0.133, 0.368),
        "one-step": (0.231, None, 0.242, None, None, None),
        "a posteriori": (0.109, 0.136, 0.082, 0.104, None, None),
    },
    "switching": {
        "parameters": (0.178, 0.160, 0.206, 0.159, 0.216, 0.788),
        "one-step": (0.331, None, 0.361, None, None, None),
        "a posteriori": (0.043, 0.057, 0.031, 0.045, None, None),
    },
    "exp-ar": {
        "parameters": (0.432, 1.085, 0.241, 0.180, 0.057, 1.557),
        "one-step": (0.180, None, 0.161, None, None, None),
        "a posteriori": (0.026, 0.071, 0.003, 0.006, None, None),
    },
}
"""Medians over one hundred seeds from an independent implementation: rms errors after the first fifth of the record."""
BEST: dict[str, tuple[tuple[float, float], ...]] = {
    "sinusoids": ((0.217, 1e-3), (0.250, 1e-3), (0.215, 1e-3), (0.111, 0.03)),
    "rational": ((0.107, 3.2), (0.111, 1.0), (0.167, 10.0), (0.120, 32.0)),
    "switching": ((0.088, 10.0), (0.111, 1.0), (0.082, 100.0), (0.063, 32.0)),
    "exp-ar": ((0.289, 3e-3), (1.077, 1e-3), (0.072, 1e4), (0.055, 1e4)),
}
"""The same for the best weight of each method: (parameter error, weight)."""
GRID = np.logspace(-3.0, 4.0, 15)


class Fit(NamedTuple):
    """A path (T, n) and the one-step errors (T,) that came with it, NaN where the method has none."""

    theta: Array
    one_step: Array


def fits(d: Simulated, mu: float) -> dict[str, Fit]:
    """Every method on one record."""
    T, n = d.theta.shape
    none = np.full(T, np.nan)
    online, exact = track(d.model, AugmentedFLS(mu), d.y, d.u), track(d.model, FLS(mu), d.y, d.u)
    constant = np.linalg.lstsq(d.phi, d.y, rcond=None)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a weight near zero interpolates: no noise is left to estimate
        smoothed = exact.smooth().theta
    paths = (
        Fit(online.theta, online.innovation), Fit(augmented(online, lam=0.8, tol=0.01).theta, none),
        Fit(exact.theta, exact.innovation), Fit(smoothed, none),
        Fit(np.broadcast_to(constant, (T, n)), none), Fit(np.zeros((T, n)), none),
    )  # fmt: skip
    return dict(zip(METHODS, paths, strict=True))


def errors(d: Simulated, fit: Fit) -> tuple[float, float, float]:
    """Rms error of the parameters, of the one-step prediction and of the a-posteriori fit, after the first fifth."""
    after = slice(max(2, len(d.y) // 5), None)
    residual = d.y - np.sum(d.phi * fit.theta, axis=1)
    return rms((fit.theta - d.theta)[after]), rms(fit.one_step[after]), rms(residual[after])


def measure(name: str, mu: float, seeds: Iterable[int]) -> Array:
    """(seeds, methods, 3): `errors` of every method."""
    records = [example(name, s) for s in seeds]
    return np.array([[errors(d, fit) for fit in fits(d, mu).values()] for d in records])


def table_of_medians(found: dict[str, Array]) -> Table:
    """Measured medians and the reference."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, title="Median error, measured (reference)", title_justify="left")
    for head in ("", "", *METHODS):
        table.add_column(head, justify="right" if head else "left")
    for name, values in found.items():
        medians = np.median(values, axis=0)
        for row, (kind, references) in enumerate(REFERENCE[name].items()):
            pairs = zip(medians[:, row], references, strict=True)
            cells = ["" if r is None else f"{value:.3f} ({r:.3f})" for value, r in pairs]
            table.add_row(f"{name}, mu = {MU[name]:g}" if row == 0 else "", kind, *cells)
        table.add_section()
    return table


def best_weights(name: str, seeds: Iterable[int]) -> list[tuple[float, float]]:
    """For each of the first four methods: (least median parameter error over the grid, the weight that has it)."""
    medians = np.array([np.median(measure(name, mu, seeds)[:, :4, 0], axis=0) for mu in GRID])
    at = np.argmin(medians, axis=0)
    return [(float(medians[i, j]), float(GRID[i])) for j, i in enumerate(at)]


def table_of_weights(found: dict[str, list[tuple[float, float]]]) -> Table:
    """Best weights, measured and reference."""
    table = Table(
        box=SIMPLE_HEAD,
        show_edge=False,
        title="Least median parameter error @ weight (reference)",
        title_justify="left",
    )
    for head in ("", *METHODS[:4]):
        table.add_column(head, justify="right" if head else "left")
    for name, rows in found.items():
        cells = [f"{e:.3f} @ {mu:.2g} ({r:.3f} @ {m:.2g})" for (e, mu), (r, m) in zip(rows, BEST[name], strict=True)]
        table.add_row(name, *cells)
    return table


def worst_ratio(found: dict[str, Array]) -> tuple[float, str]:
    """The largest relative deviation of a median from its reference, and where it is."""
    worst = (0.0, "")
    for name, values in found.items():
        medians = np.median(values, axis=0)
        for row, (kind, references) in enumerate(REFERENCE[name].items()):
            for method, value, reference in zip(METHODS, medians[:, row], references, strict=True):
                if reference is not None:
                    # half a unit of the last digit of the reference is not a deviation
                    off = max(abs(value - reference) - 5e-4, 0.0) / reference
                    worst = max(worst, (float(off), f"{name}, {kind}, {method}"))
    return worst


def main(
    seeds: Annotated[int, typer.Option(help="Noise seeds per example; the reference has 100.")] = SEEDS,
    quick: Annotated[
        bool, typer.Option("--quick", help="A part of the numbers: no search for weights, and no times.")
    ] = False,
    figures: Annotated[Path | None, typer.Option(help="Folder for the pictures.")] = None,
) -> None:
    """Reproduce the examples of augmented flexible least squares."""
    from lab.reproduce.fls import claims, cost, selectors
    from lab.reproduce.fls import figures as pictures

    out = Console(width=150, highlight=False)
    numbers = range(seeds)
    found = {name: measure(name, MU[name], numbers) for name in progress(EXAMPLES, "examples", transient=True)}
    out.print(table_of_medians(found))
    ratio, where = worst_ratio(found)
    out.print(f"{len(numbers)} seeds; largest deviation from the reference {100 * ratio:.1f} % ({where})\n")
    times = None
    if not quick:
        out.print(selectors.table_of_examples())
        out.print(selectors.table_of_walks())
        out.print(
            table_of_weights({n: best_weights(n, numbers) for n in progress(EXAMPLES, "weights", transient=True)})
        )
        times = cost.measure()
        out.print("\n", cost.table(times), "\n", sep="")
    claims.show(out, claims.all_claims(found, numbers, times))
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        pictures.draw(figures, numbers)
        cost.plot(times or cost.measure((50, 100))).savefig(figures / "fls_paper_cost.png", dpi=80)

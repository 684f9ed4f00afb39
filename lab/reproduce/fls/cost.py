"""The cost of each algorithm as the record grows: dense and banded normal equations, exact smoother, on-line trackers.

The off-line estimate solves R theta = b with R of order L n. Inverted as a dense matrix that is O(L^3 n^3); R is block
tridiagonal, and solved as a band it is O(L n^3), as is the smoother by recursion. On-line trackers cost O(n) or O(n^2)
per sample.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from scipy import linalg

from driftfit.engine.kernel import Array
from driftfit.models.regression import Regression
from driftfit.results import Track
from driftfit.show.axes import new_figure
from driftfit.trackers.augmented_fls import AugmentedFLS
from driftfit.trackers.fls import FLS
from driftfit.tracking import track

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LENGTHS = (50, 100, 200, 500, 1000, 2000, 5000, 20_000, 100_000)
DENSE = 2000
"""The longest record for the dense equations; beyond, minutes and gigabytes."""
REPEATS = 3
MU = 1.0


def band(phi: Array, mu: float) -> Array:
    """The upper band of R, (n + 1, L n): phi_k phi_k' + mu (1 or 2) I on the diagonal blocks, -mu next to them."""
    L, n = phi.shape
    ab = np.zeros((n + 1, L, n))
    neighbours = np.full(L, 2.0 * mu)
    neighbours[[0, -1]] = mu
    for i in range(n):
        for j in range(i, n):
            ab[n - (j - i), :, j] = phi[:, i] * phi[:, j]
    ab[n] += neighbours[:, None]
    ab[0, 1:] = -mu  # for n = 1 the diagonal next to the main one, else n places away from it
    return ab.reshape(n + 1, L * n)


def dense(phi: Array, y: Array) -> Array:
    """R inverted as a full matrix, as the equations are printed."""
    L, n = phi.shape
    R = np.zeros((L * n, L * n))
    ab = band(phi, MU)
    for offset in range(n + 1):
        values = ab[n - offset, offset:]
        R[np.arange(L * n - offset), np.arange(offset, L * n)] = values
        R[np.arange(offset, L * n), np.arange(L * n - offset)] = values
    return np.asarray((np.linalg.inv(R) @ (phi * y[:, None]).ravel()).reshape(L, n))


def banded(phi: Array, y: Array) -> Array:
    """R solved as the band that it is."""
    return np.asarray(linalg.solveh_banded(band(phi, MU), (phi * y[:, None]).ravel()).reshape(phi.shape))


def smoothed(phi: Array, y: Array) -> Array:
    """The exact smoother, with variances and leave-one-out residuals."""
    return track(Regression(phi.shape[1]), FLS(MU), y, phi).smooth().theta


def online(tracker: AugmentedFLS | FLS) -> Callable[[Array, Array], Track]:
    """A tracker over the record."""
    return lambda phi, y: track(Regression(phi.shape[1]), tracker, y, phi)


ALGORITHMS: dict[str, Callable[[Array, Array], Track | Array]] = {
    "dense inverse": dense, "banded": banded, "exact smoother": smoothed,
    "T-FLS on-line": online(FLS(MU)), "A-FLS on-line": online(AugmentedFLS(MU)),
}  # fmt: skip


def measure(lengths: Sequence[int] = LENGTHS) -> dict[str, dict[int, float]]:
    """Seconds by algorithm and length, the least of three; n = 2, the regressors white."""
    times: dict[str, dict[int, float]] = {name: {} for name in ALGORITHMS}
    for L in lengths:
        rng = np.random.default_rng(1)
        phi, y = rng.normal(size=(L, 2)), rng.normal(size=L)
        for name, algorithm in ALGORITHMS.items():
            if name != "dense inverse" or L <= DENSE:
                algorithm(phi, y)  # compiles
                times[name][L] = min(_seconds(algorithm, phi, y) for _ in range(REPEATS))
    return times


def _seconds(algorithm: Callable[[Array, Array], object], phi: Array, y: Array) -> float:
    start = time.perf_counter()
    algorithm(phi, y)
    return time.perf_counter() - start


def growth(times: dict[int, float]) -> float:
    """The power of L over the three longest records."""
    longest = np.log(list(times.items())[-3:])
    return float(np.polyfit(longest[:, 0], longest[:, 1], 1)[0])


def table(times: dict[str, dict[int, float]]) -> Table:
    """Milliseconds, and the power of L over the three longest records."""
    lengths = list(dict.fromkeys(L for row in times.values() for L in row))
    table = Table(box=SIMPLE_HEAD, show_edge=False, title="Milliseconds for L samples, n = 2", title_justify="left")
    for head in ("", *(f"{L:,}" for L in lengths), "grows as"):
        table.add_column(head, justify="right" if head else "left")
    for name, row in times.items():
        cells = [f"{1e3 * row[L]:.3g}" if L in row else "-" for L in lengths]
        table.add_row(name, *cells, f"L^{growth(row):.1f}")
    return table


def plot(times: dict[str, dict[int, float]]) -> Figure:
    """Seconds against L."""
    figure = new_figure(6.5, 4.0)
    axis = figure.subplots()
    for name, row in times.items():
        axis.loglog(list(row), list(row.values()), marker="o", ms=3, lw=1.2, label=name)
    axis.set_xlabel("samples L")
    axis.set_ylabel("seconds (n = 2)")
    axis.legend(fontsize=8, frameon=False)
    axis.grid(alpha=0.25, lw=0.5)
    return figure

"""Wide models: one record with n parameters against the loop in C of that size, and against NumPy with BLAS.

    python -m benchmarks.wide            n = 4 to 200; compiling the larger sizes takes minutes of processor time
    python -m benchmarks.wide --quick

ARX(n/2, n/2), a random-walk Kalman filter. P phi takes n^2 products and sums, the update of one triangle of P half as
many: 3 n^2 floating-point operations in all. NumPy uses symv and syr of SciPy's BLAS, the
fewest calls that do it, and no missing-data rule. What is compared takes turns; figures are undisturbed processor time.
"""

import os

for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import tempfile
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from scipy.linalg.blas import dsymv, dsyr

from benchmarks.end_to_end import undisturbed
from benchmarks.kernel import CFilter, Tile


def numpy_loop(tile: Tile, n: int) -> None:
    """The filter with BLAS, on the lags of y and u."""
    na = n // 2
    y, u = np.nan_to_num(tile.y[:, 0]), tile.u[:, 0]
    theta, P, phi = np.zeros(n), np.asfortranarray(np.eye(n)), np.zeros(n)
    diagonal = np.einsum("ii->i", P)
    for t in range(len(y)):
        diagonal += 1e-4
        g = dsymv(1.0, P, phi, lower=1)
        s = 0.01 + phi @ g
        theta += g * ((y[t] - phi @ theta) / s)
        P = dsyr(-1.0 / s, g, lower=1, a=P, overwrite_a=1)
        diagonal = np.einsum("ii->i", P)
        phi[1:na], phi[na + 1 :] = phi[: na - 1].copy(), phi[na:-1].copy()
        phi[0], phi[na] = y[t], u[t]


def main(quick: Annotated[bool, typer.Option(help="Small sizes, to see that it works.")] = False) -> None:
    """Print the table."""
    table = Table(title="One sample of a wide model, us; times ours above 1: slower than ours", title_justify="left")
    for head in ("n", "ours", "C", "NumPy with BLAS", "C, times ours", "NumPy, times ours", "ours, GFLOP/s"):
        table.add_column(head, justify="right")
    with tempfile.TemporaryDirectory() as folder:
        for n in (4, 12) if quick else (4, 8, 12, 24, 48, 100, 200):
            T = max(200, 400_000 // n**2)
            tile = Tile(n, 1, max(T, 4 * n))
            T = len(tile.y)
            loop = CFilter(tile, folder)
            ours, c, blas = (
                ns / T / 1e3
                for ns in undisturbed((tile.run, loop.run, lambda: numpy_loop(tile, n)), 3 if quick else 15)  # noqa: B023
            )
            table.add_row(f"{n}", f"{ours:.3f}", f"{c:.3f}", f"{blas:.2f}", f"{c / ours:.2f}", f"{blas / ours:.2f}",
                          f"{3e-3 * n * n / ours:.1f}")  # fmt: skip
    Console(width=110).print(table)


if __name__ == "__main__":
    typer.run(main)

"""How often `select` finds the true orders, compared with BIC of constant least squares.

The truth is ARX(2, 2), y_t = 1.2 y_(t-1) - 0.5 y_(t-2) + g_t u_(t-1) + 0.4 u_(t-2) + e_t with noise of 0.3; the nine
candidates have one to three lags of both. g_t is 1, or a random walk with steps of 0.02. "best" and "simplest" are
those of a selection without a tracker; "slow Kalman" is the best with a random walk, q = 1e-5 and r = 0.09.

The second table has five regressors, of which two count; the coefficient of one jumps from 1 to 2 at 100 of 150
samples. "Best" is among all subsets.

Run: python benchmarks/select_orders.py [records per row, 60 by default] [--quick]
"""

from __future__ import annotations

import sys

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, Kalman, Regression, grid, select
from driftfit.engine.kernel import Array

CANDIDATES = grid(ARX, na=[1, 2, 3], nb=[1, 2, 3])
TRUTH = repr(ARX(2, 2))
SLOW = Kalman(q=1e-5, r=0.09)


def record(rng: np.random.Generator, T: int, drifts: bool, heavy: bool) -> tuple[Array, Array]:
    e = 0.3 * (rng.standard_t(3, size=T) / np.sqrt(3.0) if heavy else rng.normal(size=T))
    u, y, gain = rng.normal(size=T), np.zeros(T), 1.0 + 0.02 * drifts * np.cumsum(rng.normal(size=T))
    for t in range(2, T):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + gain[t] * u[t - 1] + 0.4 * u[t - 2] + e[t]
    return y, u


def bic(y: Array, u: Array) -> str:
    """The candidate with the smallest BIC."""
    T, scores = len(y), {}
    for model in CANDIDATES:
        columns = [
            signal[3 - k : T - k] for signal, order in ((y, model.na), (u, model.nb)) for k in range(1, order + 1)
        ]
        X, z = np.column_stack(columns), y[3:]
        e = z - X @ np.linalg.lstsq(X, z, rcond=None)[0]
        scores[repr(model)] = len(z) * np.log(e @ e / len(z)) + X.shape[1] * np.log(len(z))
    return min(scores, key=scores.__getitem__)


def jumps(records: int) -> Table:
    """How often the two regressors that count are found where the coefficient of one jumps."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, title="After a jump")
    table.add_column("best", justify="right")
    rng, found = np.random.default_rng(0), 0
    for _ in range(records):
        u, e = rng.normal(size=(150, 5)), 0.5 * rng.normal(size=150)
        y = u[:, 1] * np.where(np.arange(150) < 100, 1.0, 2.0) + u[:, 3] + e
        found += select(Regression(5), y, u).regressors() == ("theta2", "theta4")
    table.add_row(f"{100.0 * found / records:.0f}")
    return table


def main(records: int = 60, lengths: tuple[int, ...] = (200, 600, 2000)) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"True orders found, % of {records} records")
    table.add_column("gain, noise")
    for head in ("T", "best", "simplest", "slow Kalman", "BIC"):
        table.add_column(head, justify="right")
    for name, drifts, heavy in (("constant", 0, 0), ("constant, t3 noise", 0, 1), ("drifting", 1, 0)):
        for T in lengths:
            rng = np.random.default_rng(T)
            found = np.zeros(4)
            for _ in range(records):
                y, u = record(rng, T, bool(drifts), bool(heavy))
                result = select(CANDIDATES, y, u)
                names = result.best, result.simplest, select(CANDIDATES, y, u, tracker=SLOW).best, bic(y, u)
                found += [chosen == TRUTH for chosen in names]
            table.add_row(name, str(T), *(f"{100.0 * share:.0f}" for share in found / records))
    Console(width=96).print(table)
    Console(width=96).print(jumps(2 * records))


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(1, (200,))
    else:
        main(*map(int, sys.argv[1:2]))

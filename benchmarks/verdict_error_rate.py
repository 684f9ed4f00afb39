"""How often constants are said to move, and how often moving parameters are found.

The level is 5 %. Regression on three inputs, and ARX(2, 2); noise that is steady, has outliers (5 % are ten times as
large), is heavy-tailed (Student's t, 3 degrees of freedom), or changes its variance (four times the deviation in the
last 30 %); and inputs that become three times as large half-way; or noise that is an autoregression with 0.5, beside
inputs that are autoregressions with 0.8. "joint" is the share of records whose parameters are said to move, "named" the
share in which at least one is named, "no lags" the joint test that takes scores to be white, "Hansen" what its
statistic and the published table would say.

Run: python benchmarks/verdict_error_rate.py [records a cell, 1000 by default] [--quick]
"""

import sys

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy import signal

from driftfit.judges.attribute import holm
from driftfit.judges.constancy import constancy
from driftfit.judges.quadratic import quantile

LEVEL = 0.05
NOISES = ("steady", "outliers", "heavy tails", "changing noise", "changing noise and inputs", "correlated")
LIMIT = {n: quantile(np.tile(1.0 / (np.pi * np.arange(1, 400)) ** 2, n), LEVEL) for n in (3, 4)}


def noise(kind: str, rng: np.random.Generator, T: int) -> np.ndarray:
    e = rng.standard_t(3, size=T) if kind == "heavy tails" else rng.normal(size=T)
    if kind == "outliers":
        e *= np.where(rng.random(T) < 0.05, 10.0, 1.0)
    if kind.startswith("changing"):
        e *= np.where(np.arange(T) > 0.7 * T, 4.0, 1.0)
    if kind == "correlated":
        e = signal.lfilter([np.sqrt(0.75)], [1.0, -0.5], e)
    return e


def record(model: str, kind: str, rng: np.random.Generator, T: int, jump: float) -> tuple[np.ndarray, np.ndarray]:
    """Regressors and output; from sample T / 2 on the last parameter is larger by ``jump``."""
    e = noise(kind, rng, T)
    u = rng.normal(size=(T, 3)) * np.where(np.arange(T) < T // 2, 1.0, 3.0 if "inputs" in kind else 1.0)[:, None]
    if kind == "correlated":
        u = signal.lfilter([0.6], [1.0, -0.8], u, axis=0)
    gain = 0.5 + jump * (np.arange(T) >= T // 2)
    if model == "regression":
        return u, u[:, 0] - u[:, 1] + gain * u[:, 2] + e
    y, drive = np.zeros(T), u[:, 0]
    for t in range(2, T):
        y[t] = 1.1 * y[t - 1] - 0.5 * y[t - 2] + drive[t - 1] + gain[t] * drive[t - 2] + e[t]
    return np.column_stack([y[1:-1], y[:-2], drive[1:-1], drive[:-2]]), y[2:]


def main(records: int = 1000, lengths: tuple[int, ...] = (100, 300, 1000)) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"Level {LEVEL:g}, {records} records a cell", width=108)
    for head in ("model", "noise", "T", "joint", "named", "no lags", "Hansen", "finds a jump of 0.5"):
        table.add_column(head, justify="left" if head in ("model", "noise") else "right")
    for model in ("regression", "arx"):
        for kind in NOISES:
            for T in lengths:
                rng = np.random.default_rng([T, *model.encode(), *kind.encode()])
                records_of = [record(model, kind, rng, T, 0.0) for _ in range(records)]
                still, bare = ([constancy(*made, lags) for made in records_of] for lags in (None, 0))
                moved = [constancy(*record(model, kind, rng, T, 0.5)) for _ in range(records // 4)]
                said = np.mean([test.p_joint < LEVEL for test in still])
                named = np.mean([test.p_joint < LEVEL and holm(test.p_own, LEVEL).any() for test in still])
                white = np.mean([test.p_joint < LEVEL for test in bare])
                hansen = np.mean([test.joint > LIMIT[len(test.p)] for test in bare])
                found = np.mean([test.p_joint < LEVEL for test in moved])
                shares = (f"{100.0 * share:.1f} %" for share in (said, named, white, hansen, found))
                table.add_row(model, kind, str(T), *shares)
    Console(width=110).print(table)


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(4, (100,))
    else:
        main(*map(int, sys.argv[1:2]))

"""How often constants are reported to move, and how often moving parameters are found.

The level is 5 %. A regression on two inputs and an intercept, and ARX(2, 2); noise that is steady, has outliers (5 %
are ten times as large), is heavy-tailed (Student's t, 3 degrees of freedom), or changes its variance (four times the
deviation in the last 30 %); rare counts (Poisson, 88 % are 0) and bursts (12 % of the samples, exponential); and inputs
that become three times as large half-way; or noise that is an autoregression with 0.6 or 0.9, beside inputs that are
autoregressions with 0.8. "joint" is the share of records whose parameters are reported to move; "mean square", "break"
and "interval" are the three tests in it, each by itself at 5 %; "at 0.1 %" is joint at that level; "named" the share in
which at least one parameter is named; "finds 0.5" the share in which a step of half a noise deviation in one
coefficient, half-way, is found.

Then faults of a mean in 1000 samples of noise 0.5, beside an input: how many of the records they are found in, and the
largest p of all, by their size.

Run: python benchmarks/verdict_error_rate.py [records per cell, 300 by default] [--quick]
"""

import sys

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy import signal

from driftfit.judge.statistics.attribution import holm
from driftfit.judge.statistics.constancy import constancy

LEVEL = 0.05
NOISES = (
    "steady",
    "outliers",
    "heavy tails",
    "changing noise",
    "changing noise and inputs",
    "AR(0.6)",
    "AR(0.9)",
    "rare counts",
    "bursts",
)
T_FAULT = 1000


def noise(kind: str, rng: np.random.Generator, T: int) -> np.ndarray:
    e = rng.standard_t(3, size=T) if kind == "heavy tails" else rng.normal(size=T)
    if kind == "rare counts":
        return (rng.poisson(0.128, T) - 0.128) / np.sqrt(0.128)
    if kind == "bursts":
        e = 0.01 * e + (rng.random(T) < 0.12) * rng.exponential(2.0, T)
    if kind == "outliers":
        e *= np.where(rng.random(T) < 0.05, 10.0, 1.0)
    if kind.startswith("changing"):
        e *= np.where(np.arange(T) > 0.7 * T, 4.0, 1.0)
    if kind.startswith("AR"):
        rho = float(kind[3:6])
        e = signal.lfilter([np.sqrt(1.0 - rho * rho)], [1.0, -rho], rng.normal(size=T + 300))[300:]
    return e


def record(model: str, kind: str, rng: np.random.Generator, T: int, jump: float) -> tuple[np.ndarray, np.ndarray]:
    """Regressors and output; from sample T / 2 on the last coefficient is larger by ``jump``."""
    e = noise(kind, rng, T)
    u = rng.normal(size=(T, 2)) * np.where(np.arange(T) < T // 2, 1.0, 3.0 if "inputs" in kind else 1.0)[:, None]
    if kind.startswith("AR"):
        u = signal.lfilter([0.6], [1.0, -0.8], u, axis=0)
    gain = 0.5 + jump * (np.arange(T) >= T // 2)
    if model == "regression":
        return np.column_stack([u, np.ones(T)]), u[:, 0] - u[:, 1] + gain + e
    y, drive = np.zeros(T), u[:, 0]
    for t in range(2, T):
        y[t] = 1.1 * y[t - 1] - 0.5 * y[t - 2] + drive[t - 1] + gain[t] * drive[t - 2] + e[t]
    return np.column_stack([y[1:-1], y[:-2], drive[1:-1], drive[:-2]]), y[2:]


def rates(records: int, lengths: tuple[int, ...]) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"Level {LEVEL:g}, {records} records a cell, %", width=108)
    heads = (
        "model",
        "noise",
        "T",
        "joint",
        "mean square",
        "break",
        "interval",
        "wild",
        "at 0.1 %",
        "named",
        "finds 0.5",
    )
    for head in heads:
        table.add_column(head, justify="left" if head in ("model", "noise") else "right", no_wrap=head == "model")
    all_rates = []
    for model in ("regression", "arx"):
        for kind in NOISES:
            for T in lengths:
                rng = np.random.default_rng([T, *model.encode(), *kind.encode()])
                still = [constancy(*record(model, kind, rng, T, 0.0)) for _ in range(records)]
                moved = [constancy(*record(model, kind, rng, T, 0.5)) for _ in range(records // 4)]
                p = np.array([(test.p_joint, *test.p_each) for test in still])
                named = np.mean([test.p_joint < LEVEL and holm(test.p_own, LEVEL).any() for test in still])
                shares = [*np.mean(p < LEVEL, axis=0), np.mean(p[:, 0] < 0.001), named]
                all_rates.append(shares[0])
                shares.append(np.mean([test.p_joint < LEVEL for test in moved]))
                table.add_row(model, kind, str(T), *(f"{100.0 * share:.1f}" for share in shares))
    table.caption = (
        f"joint, mean of all cells {100.0 * np.mean(all_rates):.1f}, largest {100.0 * np.max(all_rates):.1f}"
    )
    return table


def faults(records: int) -> Table:
    t = np.arange(T_FAULT)
    shapes = {
        "step at 560, back at 860": (t >= 560) & (t < 860),
        "pulse of 60 samples": (t >= 600) & (t < 660),
        "pulse of 30 samples": (t >= 600) & (t < 630),
        "ramp of 60 samples, which stays": np.clip((t - 600) / 60.0, 0.0, 1.0),
        "ramp of 60 samples, then back": np.clip((t - 600) / 60.0, 0.0, 1.0) * (t < 660),
        "random walk, size its end's deviation": None,
    }
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"Found of {records}, and the largest p", width=108)
    sizes = (0.5, 1.0, 3.0, 10.0, 30.0, 1000.0)
    for head in ("fault", *(f"{size:g}" for size in sizes)):
        table.add_column(head, justify="left" if head == "fault" else "right")
    for name, shape in shapes.items():
        cells = []
        for size in sizes:
            p = []
            for seed in range(records):
                rng = np.random.default_rng(seed)
                u, e = rng.normal(size=(2, T_FAULT))
                path = np.cumsum(rng.normal(size=T_FAULT)) / np.sqrt(T_FAULT) if shape is None else shape
                y = 32.0 - size * path + 0.2 * u + 0.5 * e
                p.append(constancy(np.column_stack([u, np.ones(T_FAULT)]), y).p_joint)
            cells.append(f"{np.sum(np.array(p) < LEVEL)}, {'< 1e-4' if max(p) < 1e-4 else f'{max(p):.2g}'}")
        table.add_row(name, *cells)
    return table


def main(records: int = 300, lengths: tuple[int, ...] = (100, 300, 1000)) -> None:
    console = Console(width=110)
    console.print(faults(max(records // 10, 1)))
    console.print(rates(records, lengths))


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(4, (100,))
    else:
        main(*map(int, sys.argv[1:2]))

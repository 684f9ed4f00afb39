"""How often constants are reported to move in kinds of noise and with inputs on which the verdict was not tuned.

The level is 5 %. The models are a regression on two inputs and an intercept, and ARX(2, 2) with an intercept, both with
constant coefficients. The noise has variance 1: GARCH(1, 1) with persistence 0.98; Student's t with 3 degrees of
freedom; an autoregression with a spectral peak (period 8, pole radius 0.9); a moving average (0.8 at the first two
lags); a level that switches by a factor of 5 (a Markov chain that stays 50 samples on average); an autoregression at
lag 12 (0.6); a seasonal level; 3 % outliers, ten times as large; outputs rounded to one standard deviation of the
noise. The inputs are white, autoregressions with 0.95, steps that stay for 40 samples on average, and a closed loop
(the first input reacts to the previous output). Inputs are white if the noise is not, and the noise is white Gaussian
if the inputs are not, except in the last rows: a first input that is 1 in one of twenty samples and otherwise 0, with
white noise and with noise that is ten times as large in these samples; and one that is lognormal, with noise in
proportion to it.

Run: python benchmarks/verdict_unseen.py [records per cell, 300 by default] [--quick]
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy import signal

from driftfit.engine.kernel import Array
from driftfit.judge.evidence import of_one_size
from driftfit.judge.regressors import Rows
from driftfit.judge.statistics.constancy import constancy
from driftfit.run.parallel_lanes import cores

LEVEL = 0.05
BEFORE = 200
NOISES = ("white", "GARCH", "t3", "AR(2), peak", "MA(2)", "switching level", "AR at lag 12", "seasonal level",
          "3 % outliers", "rounded")  # fmt: skip
INPUTS = ("AR(0.95)", "steps", "closed loop", "AR(0.95), noise AR(0.6)", "pulses", "pulses, louder",
          "lognormal, in proportion")  # fmt: skip
LENGTHS = (80, 300, 1000)


def noise(kind: str, rng: np.random.Generator, T: int) -> Array:
    """Noise (T,) of variance about 1."""
    e = rng.normal(size=T + BEFORE)
    t = np.arange(T + BEFORE)
    if kind == "GARCH":
        v = np.ones(T + BEFORE)
        for i in range(1, T + BEFORE):
            v[i] = 0.02 + 0.18 * v[i - 1] * e[i - 1] ** 2 + 0.8 * v[i - 1]
        e = e * np.sqrt(v)
    elif kind == "t3":
        e = rng.standard_t(3, size=T + BEFORE) / np.sqrt(3.0)
    elif kind == "AR(2), peak":
        e = 0.3 * signal.lfilter([1.0], [1.0, -1.8 * np.cos(2.0 * np.pi / 8.0), 0.81], e)
    elif kind == "MA(2)":
        e = signal.lfilter([1.0, 0.8, 0.8], [1.0], e) / 1.5
    elif kind == "switching level":
        loud = np.cumsum(rng.random(T + BEFORE) < 0.02) % 2
        e = e * np.where(loud, 5.0, 1.0) / 3.6
    elif kind == "AR at lag 12":
        e = 0.8 * signal.lfilter([1.0], [1.0, *[0.0] * 11, -0.6], e)
    elif kind == "seasonal level":
        e = e * (1.0 + 0.8 * np.sin(2.0 * np.pi * t / 24.0))
    elif kind == "3 % outliers":
        e = e * np.where(rng.random(T + BEFORE) < 0.03, 10.0, 1.0)
    elif "AR(0.6)" in kind:
        e = 0.8 * signal.lfilter([1.0], [1.0, -0.6], e)
    return e[BEFORE:]


def inputs(kind: str, rng: np.random.Generator, T: int) -> Array:
    """Inputs (T, 2) of variance about 1."""
    u = rng.normal(size=(T + BEFORE, 2))
    if kind.startswith("AR(0.95)"):
        u = np.sqrt(1.0 - 0.95**2) * signal.lfilter([1.0], [1.0, -0.95], u, axis=0)
    elif kind == "steps":
        stays = np.cumsum(rng.random((T + BEFORE, 2)) < 1.0 / 40.0, axis=0)
        u = np.take_along_axis(u, stays, axis=0)
    elif kind.startswith("pulses"):
        u[:, 0] = rng.random(T + BEFORE) < 0.05
    elif kind.startswith("lognormal"):
        u[:, 0] = np.exp(u[:, 0])
    return u[BEFORE:]


def record(model: str, kind: str, rng: np.random.Generator, T: int) -> tuple[Array, Array]:
    """Regressors and output."""
    e, u = noise(kind, rng, T), inputs(kind, rng, T)
    if kind == "pulses, louder":
        e[1:] *= np.where(u[:-1, 0] > 0.0, 10.0, 1.0)
    elif kind == "lognormal, in proportion":
        e[1:] *= u[:-1, 0]
    y, loop = np.zeros(T), 0.5 if kind == "closed loop" else 0.0
    for t in range(2, T):
        u[t - 1, 0] -= loop * y[t - 1]
        if model == "regression":
            y[t] = u[t - 1, 0] - 0.5 * u[t - 1, 1] + 0.5 + e[t]
        else:
            y[t] = 1.1 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1, 0] + 0.5 * u[t - 2, 0] + 0.5 + e[t]
    if kind == "rounded":
        y = np.round(y)
    one = np.ones(T - 2)
    if model == "regression":
        return np.column_stack([u[1:-1], one]), y[2:]
    return np.column_stack([y[1:-1], y[:-2], u[1:-1, 0], u[:-2, 0], one]), y[2:]


def cell(model: str, kind: str, T: int, records: int) -> Array:
    """p-values of records."""
    rng = np.random.default_rng([T, *model.encode(), *kind.encode()])
    found = []
    for _ in range(records):
        rows = Rows(np.arange(T - 2), *record(model, kind, rng, T))
        found.append(of_one_size(rows, constancy(rows.phi, rows.y), None)[1].p_joint)
    return np.array(found)


def rates(records: int, lengths: tuple[int, ...]) -> Table:
    title = f"Constants said to move at {100 * LEVEL:g} % (and at 1 %), % of {records} records a cell"
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=title)
    table.add_column("model")
    table.add_column("noise or inputs")
    for T in lengths:
        table.add_column(f"T = {T}", justify="right")
    every = []
    with ProcessPoolExecutor(cores()) as pool:
        for model in ("regression", "arx"):
            for kind in (*NOISES, *INPUTS):
                cells = []
                for p in pool.map(cell, *zip(*((model, kind, T, records) for T in lengths), strict=True)):
                    every.append(np.mean(p < LEVEL))
                    cells.append(f"{100.0 * every[-1]:.1f} ({100.0 * np.mean(p < 0.01):.1f})")
                table.add_row(model, kind, *cells)
            table.add_section()
    share = np.mean([(0.02 <= rate <= 0.08) for rate in every])
    table.caption = (
        f"mean {100.0 * np.mean(every):.1f}, least {100.0 * np.min(every):.1f}, largest {100.0 * np.max(every):.1f}; "
        f"{100.0 * share:.0f} % of the cells between 2 and 8"
    )
    return table


def main(records: int = 300, lengths: tuple[int, ...] = LENGTHS) -> None:
    Console(width=110).print(rates(records, lengths))


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(3, (80,))
    else:
        main(*map(int, sys.argv[1:2]))

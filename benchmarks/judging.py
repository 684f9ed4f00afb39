"""How often constants are said to change, and what is said of parameters that do: size, power, names, kinds, dates.

The models are a regression on two inputs and an intercept, and ARX(2, 2) with an intercept. The first table has
constant coefficients. The noise has variance 1: white; GARCH(1, 1) with persistence 0.98; Student's t with 3 degrees
of freedom; autoregressions of order 1 (0.6, 0.9) and of lag 12 (0.6); one with a spectral peak (period 8, radius 0.9);
a moving average (0.8 at the first two lags); a level that switches by a factor of 5 (stays 50 samples) or is four
times as large in the last 30 %; a seasonal level; 3 % outliers, ten times as large; outputs rounded to one deviation
of the noise; rare counts (Poisson, 88 % are 0) and bursts (12 % of the samples, exponential); 10 % of the samples
missing in noise that is AR(0.6). Inputs are white; autoregressions with 0.95; held for 40 samples on average; in a
closed loop (the first reacts to the output before); pulses in one of twenty samples, with noise that is as loud, or
ten times; and lognormal with noise in proportion.

The second table has one change in white noise or in AR(0.6): a step of the intercept or of the first gain half-way,
by 0.5 or 1 deviation of the noise; the same from 40 to 60 % of the record; a ramp from 30 to 70 %; and a random walk
whose deviation at its end is 2. "found" is the share of records whose constants are rejected at 5 %; of these, "named"
is the share in which exactly the right parameter is named, alone or as one of several that explain the record as well;
"kind" that in which the kind of change is the right one; "date" and "size" those in which the 95 % interval holds the
date of the first step, and two standard errors hold the change.

Run: python benchmarks/judging.py [records per cell, 300 by default] [first seed, 0 by default] [--quick]
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from scipy import signal

from driftfit import ARX, RLS, Regression, Track, track
from driftfit.engine.kernel import Array
from driftfit.judge.evidence import Evidence
from driftfit.run.parallel_lanes import cores

BEFORE = 200
NOISES = (
    "white", "GARCH", "t3", "AR(0.6)", "AR(0.9)", "AR at lag 12", "spectral peak", "MA(2)", "switching level",
    "louder at the end", "seasonal level", "3 % outliers", "rounded", "rare counts", "bursts", "gaps",
)  # fmt: skip
INPUTS = ("slow inputs", "held inputs", "closed loop", "pulses", "louder pulses", "lognormal, in proportion")
MODELS = {"regression": Regression(2, intercept=True), "ARX(2, 2)": ARX(2, 2, intercept=True)}
CHANGES = ("step 0.5", "step 1", "temporary 1", "ramp 2", "walk 2")
KINDS = {"step": "step", "temporary": "temporary", "ramp": "gradual", "walk": "wandering"}


def noise(kind: str, rng: np.random.Generator, T: int) -> Array:
    """Noise (T,) of variance about 1."""
    e, t = rng.normal(size=T + BEFORE), np.arange(T + BEFORE)
    filters: dict[str, tuple[list[float], list[float], float]] = {
        "AR(0.6)": ([1.0], [1.0, -0.6], 0.8), "gaps": ([1.0], [1.0, -0.6], 0.8), "AR(0.9)": ([1.0], [1.0, -0.9], 0.436),
        "AR at lag 12": ([1.0], [1.0, *[0.0] * 11, -0.6], 0.8), "MA(2)": ([1.0, 0.8, 0.8], [1.0], 1.0 / 1.5),
        "spectral peak": ([1.0], [1.0, -1.8 * np.cos(2.0 * np.pi / 8.0), 0.81], 0.3),
    }  # fmt: skip
    levels: dict[str, Callable[[], Any]] = {
        "switching level": lambda: np.where(np.cumsum(rng.random(len(t)) < 0.02) % 2, 5.0, 1.0) / 3.6,
        "louder at the end": lambda: np.where(t > BEFORE + 0.7 * T, 4.0, 1.0),
        "seasonal level": lambda: 1.0 + 0.8 * np.sin(2.0 * np.pi * t / 24.0),
        "3 % outliers": lambda: np.where(rng.random(len(t)) < 0.03, 10.0, 1.0),
    }
    if kind in filters:
        b, a, size = filters[kind]
        e = size * signal.lfilter(b, a, e)
    elif kind in levels:
        e = e * levels[kind]()
    elif kind == "GARCH":
        v = np.ones(len(t))
        for i in range(1, len(t)):
            v[i] = 0.02 + 0.18 * v[i - 1] * e[i - 1] ** 2 + 0.8 * v[i - 1]
        e = e * np.sqrt(v)
    elif kind == "t3":
        e = rng.standard_t(3, size=len(t)) / np.sqrt(3.0)
    elif kind == "rare counts":
        e = (rng.poisson(0.128, len(t)) - 0.128) / np.sqrt(0.128)
    elif kind == "bursts":
        e = 0.01 * e + (rng.random(len(t)) < 0.12) * rng.exponential(2.0, len(t))
    return e[BEFORE:]


def inputs(kind: str, rng: np.random.Generator, T: int) -> Array:
    """Inputs (T, 2) of variance about 1."""
    u = rng.normal(size=(T + BEFORE, 2))
    if kind == "slow inputs":
        u = np.sqrt(1.0 - 0.95**2) * signal.lfilter([1.0], [1.0, -0.95], u, axis=0)
    elif kind == "held inputs":
        u = np.take_along_axis(u, np.cumsum(rng.random(u.shape) < 1.0 / 40.0, axis=0), axis=0)
    elif "pulses" in kind:
        u[:, 0] = rng.random(len(u)) < 0.05
    elif kind.startswith("lognormal"):
        u[:, 0] = np.exp(u[:, 0])
    return u[BEFORE:]


def record(model: str, kind: str, rng: np.random.Generator, path: Array, gain: int) -> Track:
    """A run whose intercept, or with ``gain`` 1 whose first gain, moves by path (T,)."""
    T = len(path)
    e, u = noise(kind, rng, T), inputs(kind, rng, T)
    if kind == "louder pulses":
        e[1:] *= np.where(u[:-1, 0] > 0.0, 10.0, 1.0)
    elif kind.startswith("lognormal"):
        e[1:] *= u[:-1, 0]
    y, level, slope = np.zeros(T), 0.5 + path * (1 - gain), 1.0 + path * gain
    for t in range(2, T):
        u[t - 1, 0] -= 0.5 * y[t - 1] * (kind == "closed loop")
        if model == "regression":
            y[t] = slope[t] * u[t - 1, 0] - 0.5 * u[t - 1, 1] + level[t] + e[t]
        else:
            y[t] = 1.1 * y[t - 1] - 0.5 * y[t - 2] + slope[t] * u[t - 1, 0] + 0.5 * u[t - 2, 0] + level[t] + e[t]
    if kind == "rounded":
        y = np.round(y)
    if kind == "gaps":
        y = np.where(rng.random(T) < 0.1, np.nan, y)
    warnings.simplefilter("ignore")  # rare pulses and outliers look like fault codes
    used = (y[1:], u[:-1]) if model == "regression" else (y, u[:, 0])
    return track(MODELS[model], RLS(1.0), *used)


def sizes(cell: tuple[str, str, int, int, int]) -> Array:
    """p-values (records,) of constants."""
    model, kind, T, records, first = cell
    runs = (record(model, kind, np.random.default_rng([first + i, T]), np.zeros(T), 0) for i in range(records))
    return np.array([Evidence(run).p for run in runs])


def moved(change: str, rng: np.random.Generator, T: int) -> Array:
    """The path (T,) of a change, in deviations of the noise."""
    kind, size = change.split()
    t, amount = np.arange(T) / T, float(size)
    if kind == "step":
        return amount * (t >= 0.5)
    if kind == "temporary":
        return amount * ((t >= 0.4) & (t < 0.6))
    if kind == "ramp":
        return amount * np.clip((t - 0.3) / 0.4, 0.0, 1.0)
    return amount * np.cumsum(rng.normal(size=T)) / np.sqrt(T)


def told(cell: tuple[str, str, str, int, int, int, int]) -> Array:
    """(records, 5): found, named, kind, date and size, NaN where nothing is said."""
    model, kind, change, gain, T, records, first = cell
    names, rows = MODELS[model].names, []
    right = "intercept" if not gain else "b1" if model != "regression" else "theta1"
    assert right in names
    for i in range(records):
        rng = np.random.default_rng([first + i, T, 1])
        path = moved(change, rng, T)
        verdict = record(model, kind, rng, path, gain).verdict()
        row = [float(bool(verdict.drifts)), *[np.nan] * 4]
        if verdict.drifts:
            event = verdict.events[0]
            of = [{move.name, *move.instead} for one in verdict.events for move in one.moves]
            row[1] = float(all(right in one for one in of))
            row[2] = float({one.kind for one in verdict.events} == {KINDS[change.split()[0]]})
            if change.startswith(("step", "temporary")) and row[1] and row[2]:
                at = int(np.argmax(path > 0.0)) - (model == "regression")
                row[3] = float(event.earliest <= at <= event.latest)
                move = event.moves[0]
                if move.name == right:
                    row[4] = float(abs(move.after - move.before - path.max()) < 2.0 * move.std)
        rows.append(row)
    return np.array(rows)


def main(records: int = 300, first: int = 0, lengths: tuple[int, ...] = (100, 400)) -> None:
    kinds = (*NOISES, *INPUTS) if records > 5 else NOISES[:2]
    cells = [(model, kind, T, records, first) for model in MODELS for kind in kinds for T in lengths]
    with ProcessPoolExecutor(cores()) as pool:
        print(f"Constants said to change at 5 % (and at 1 %), % of {records} records")
        print(f"{'model':<11} {'noise or inputs':<25}" + "".join(f"{f'T = {T}':>15}" for T in lengths))
        rates, line = [], ""
        for cell, p in zip(cells, pool.map(sizes, cells), strict=True):
            rates.append(np.mean(p < 0.05))
            line += f"{100.0 * rates[-1]:8.1f} ({100.0 * np.mean(p < 0.01):4.1f})"
            if cell[2] == lengths[-1]:
                print(f"{cell[0]:<11} {cell[1]:<25}{line}", flush=True)
                line = ""
        print(f"mean {100 * np.mean(rates):.1f}, least {100 * np.min(rates):.1f}, largest {100 * np.max(rates):.1f}\n")
        print(f"What is said of a change in {lengths[-1]} samples, % of {max(records // 5, 2)} records")
        print(f"{'model':<11} {'noise':<8} {'changes':<10} {'how':<12} found  named   kind   date   size")
        changed = [
            (model, kind, change, gain, lengths[-1], max(records // 5, 2), first)
            for model in MODELS for kind in ("white", "AR(0.6)") for gain in (0, 1) for change in CHANGES
        ]  # fmt: skip
        for cell, rows in zip(changed, pool.map(told, changed), strict=True):
            shares = (f"{100.0 * np.nanmean(one):6.0f}" if np.isfinite(one).any() else f"{'-':>6}" for one in rows.T)
            print(f"{cell[0]:<11} {cell[1]:<8} {('intercept', 'gain')[cell[3]]:<10} {cell[2]:<12}" + " ".join(shares),
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(2, 0, (100,))
    else:
        main(*map(int, sys.argv[1:3]))

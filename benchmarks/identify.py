"""Plants for `driftfit.identify`: is the structure found, is drift named and dated, and is its cause named?

Each plant has five inputs, of which two matter, with delays of 0 to 15 samples, and one or two lags of the output:

    y_t = sum a_i y_(t-i) + g_t f(u1_(t-k1)) + b u2_(t-k2) + c + v_t

Inputs are white, autoregressions with 0.9, or held for 25 samples on average. The standard deviation of the effect of
the inputs is 0.3 or 1 times that of the noise. The noise is white or an autoregression with 0.6; the first input reacts
to the output (closed loop); or the meter of y prints whole numbers, about one deviation of the noise apart. What
changes: nothing; the gain g jumps by a factor of 1.8; it rises by as much during a third of the record; it is a random
walk whose deviation at the end is 0.8 of it; the pole jumps by 0.35; f is a static curve that saturates; or g depends
on the level of a third input, which returns to where it was.

Seeds below 1000 are for tuning, those from 1000 on for judging. "named", "date" and "interval" are shares of the plants
in which a drift was found, "cause" that of the plants of which a cause was named, "silent" that of those without one.
The row "true structure" is the verdict with the structure of the plant: how well a date can be known.

Run: python benchmarks/identify.py [first seed, 1000 by default] [seed to stop before] [--of CHANGE] [--by METHOD]
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy import signal

from driftfit.engine.kernel import Array
from driftfit.identify.roles import roles
from driftfit.identify.structure import Structure, search
from driftfit.identify.working_point import cause, products
from driftfit.judge.changes.changes import Changes
from driftfit.judge.changes.null import Lags
from driftfit.judge.changes.words import Event, events
from driftfit.judge.evidence import REJECTED as LEVEL
from driftfit.judge.evidence import judged_rows
from driftfit.judge.regressors import Rows
from driftfit.judge.statistics.coarse_readings import step_of
from driftfit.use.simulate import moved

T = 1500
BEFORE = 200
CHANGES = ("constant", "jump", "ramp", "walk", "moving pole", "static curve", "gain by level")
INPUTS = ("white", "AR(0.9)", "held")
NOISES = ("white", "coloured", "closed loop", "whole numbers")
SNRS = (0.3, 1.0)
FACTOR = 1.8


class Plant(NamedTuple):
    """A record, and what is true of it."""

    table: dict[str, Array]
    change: str
    inputs: dict[str, int]
    """The inputs that matter, with their delays."""
    moving: str
    """The input whose effect changes; "y" for a pole, empty if nothing changes in time."""
    date: int
    cause: str
    """"", "time" or "working point"."""


def input_of(kind: str, rng: np.random.Generator, n: int) -> Array:
    """An input (n,) of variance about 1."""
    if kind == "white":
        return rng.normal(size=n)
    if kind == "AR(0.9)":
        return signal.lfilter([np.sqrt(1.0 - 0.81)], [1.0, -0.9], rng.normal(size=n))
    return rng.normal(size=n)[np.cumsum(rng.random(n) < 1.0 / 25.0)]


def plant(change: str, inputs: str, noise: str, snr: float, seed: int) -> Plant:
    """A plant drawn from a seed."""
    rng = np.random.default_rng([seed, CHANGES.index(change), INPUTS.index(inputs), NOISES.index(noise), int(10 * snr)])
    n = T + BEFORE
    U = np.column_stack([input_of(inputs, rng, n) for _ in range(5)])
    first, second, level = rng.permutation(5)[:3]
    delays = {int(first): int(rng.integers(0, 16)), int(second): int(rng.integers(0, 16))}
    if noise == "closed loop":
        delays[int(first)] = max(delays[int(first)], 1)
    pole = float(rng.uniform(0.3, 0.6)) if change == "moving pole" else float(rng.uniform(0.3, 0.85))
    a = [pole] if rng.random() < 0.5 or change == "moving pole" else [pole + 0.2, -0.2 * pole]
    date = int(rng.uniform(0.4, 0.65) * T) + BEFORE
    e = rng.normal(size=n)
    v = signal.lfilter([0.8], [1.0, -0.6], e) if noise == "coloured" else e
    b = snr / np.sqrt(2.0) * rng.choice([-1.0, 1.0], 2)
    g, t = np.ones(n), np.arange(n)
    if change == "jump":
        g = np.where(t >= date, FACTOR, 1.0)
    elif change == "ramp":
        g = 1.0 + (FACTOR - 1.0) * np.clip((t - date + T // 6) / (T // 3), 0.0, 1.0)
    elif change == "walk":
        walk = np.cumsum(np.where(t > BEFORE, rng.normal(size=n), 0.0))
        g = 1.0 + 0.8 * walk / np.sqrt(T)
    elif change == "gain by level":
        U[:, level] = signal.lfilter([np.sqrt(1.0 - 0.98**2)], [1.0, -0.98], rng.normal(size=n))
        g = 1.0 + 0.8 * np.tanh(U[:, level])
    poles = np.where(t >= date, a[0] + 0.35, a[0]) if change == "moving pole" else np.full(n, a[0])
    y = np.zeros(n)
    for k in range(20, n):
        if noise == "closed loop":
            U[k, first] -= 0.3 * np.sign(b[0]) * y[k - 1]
        x = U[k - delays[int(first)], first]
        x = 2.0 * np.tanh(1.2 * x + 0.6) if change == "static curve" else x
        past = poles[k] * y[k - 1] + (a[1] * y[k - 2] if len(a) > 1 else 0.0)
        y[k] = past + b[0] * g[k] * x + b[1] * U[k - delays[int(second)], second] + 0.5 + v[k]
    y = np.round(y) if noise == "whole numbers" else y
    timely = change in ("jump", "ramp", "walk", "moving pole")
    return Plant(
        {"flow": y[BEFORE:], **{f"u{j + 1}": U[BEFORE:, j] for j in range(5)}},
        change,
        {f"u{j + 1}": k for j, k in delays.items()},
        "y" if change == "moving pole" else f"u{first + 1}" if timely else "",
        date - BEFORE if timely else -1,
        "time" if timely else "working point" if change in ("static curve", "gain by level") else "",
    )


def plants(seed: int) -> list[Plant]:
    """Every change with every kind of input and both sizes of noise; kinds of noise in turn."""
    found = []
    for i, change in enumerate(CHANGES):
        for j, inputs in enumerate(INPUTS):
            for k, snr in enumerate(SNRS):
                found.append(plant(change, inputs, NOISES[(i + 2 * j + k + seed) % len(NOISES)], snr, seed))
    return found


class Found(NamedTuple):
    """What a method says of a plant: chosen inputs with delays, whether parameters move and which, when, and why."""

    inputs: dict[str, tuple[int, int]]
    moves: bool | None
    which: tuple[str, ...] = ()
    date: int = -1
    cause: str = ""
    spans: tuple[tuple[int, int], ...] = ()
    """Intervals of its dates."""


class Judged(NamedTuple):
    """The verdict on constants of a structure, without its tracker, which only decides what readings are left out."""

    rows: Rows
    changes: Changes
    events: tuple[Event, ...]

    @classmethod
    def of(cls, plant: Plant, structure: Structure) -> Judged:
        """The verdict of a structure, whose inputs are numbered in the order of the table."""
        y, names = plant.table["flow"], [name for name in plant.table if name != "flow"]
        past = [moved(y, k + 1) for k in range(structure.na)]
        each = [(names[j], k) for j, nb, nk in structure.shape[1] for k in range(nk, nk + nb)]
        phi = np.column_stack([*past, *(moved(plant.table[name], k) for name, k in each), np.ones(T)])
        at = np.flatnonzero(np.isfinite(phi).all(axis=1))
        source = (
            np.column_stack([at - at[0] - k - 1 for k in range(structure.na)]) if past else np.zeros((len(at), 0), int)
        )
        lags = Lags(np.arange(structure.na), source, np.ones(source.shape))
        step = step_of(y)
        rows = Rows(at, phi[at], y[at], np.full(len(at), step) if step else None, lags, np.ones(len(at)))
        found = judged_rows(rows, LEVEL)
        assert found is not None
        own = ["y"] * len(past) + [name for name, _ in each] + ["level"]
        return cls(rows, found, events(found, own, at, str) if found.rejected else ())

    @property
    def found(self) -> Found:
        """What it says."""
        moved = [event for event in self.events if any(move.name != "level" for move in event.moves)]
        which = tuple(move.name for event in moved for move in event.moves)
        middle = int(np.median([event.at for event in moved])) if moved else -1
        spans = tuple((event.earliest, event.latest) for event in moved)
        return Found({}, self.changes.rejected, which, middle, "time" if self.changes.rejected else "", spans)


def ours(plant: Plant) -> Found:
    """The decisions of `driftfit.identify` with its defaults."""
    record = roles(plant.table, "flow")
    y, U, _ = record.centred().spread(31)
    best = search(y, U, 30, 0, np.inf, np.random.default_rng(0))
    one = Judged.of(plant, best)
    Z, made = products(plant.table["flow"], record.U, best, record.inputs, "flow", 0)
    why, moves = cause(one.rows.phi, one.rows.y, Z[one.rows.at], made), one.changes.rejected
    if moves and why.products:
        more = one.rows._replace(phi=np.hstack([one.rows.phi, why.columns]), lags=None)
        again = judged_rows(more.only(np.isfinite(more.phi).all(axis=1), range(more.phi.shape[1])), LEVEL)
        moves = again is None or again.rejected
    kind, agreed = why.kind(moves), True
    if moves:  # the structures that came next must say so, too
        nexts = (Structure(na, {j: (nb, nk) for j, nb, nk in used}) for (na, used), *_ in best.second)
        agreed = all(Judged.of(plant, one).changes.rejected for one in nexts)
    inputs = {record.inputs[j]: ends for j, ends in best.delays.items()}
    moves = one.changes.rejected and kind != "working point" and agreed
    return one.found._replace(inputs=inputs, moves=moves, cause=kind if moves or kind == "working point" else "")


def by_criterion(price: float) -> Callable[[Plant], Found]:
    """Forward selection of lags of y and inputs with constants: an information criterion with a price per column."""

    def method(plant: Plant) -> Found:
        y, names = plant.table["flow"], [name for name in plant.table if name != "flow"]
        columns = {("y", k): np.roll(y, k) for k in range(1, 9)}
        columns |= {(name, k): np.roll(plant.table[name], k) for name in names for k in range(31)}
        X, z = np.column_stack([np.ones(len(y)), *columns.values()])[40:], y[40:]
        N, chosen, places = len(z), [0], list(columns)
        cost = price if price else np.log(N) + 2.0 * np.log(X.shape[1])
        while True:
            Q = np.linalg.qr(X[:, chosen])[0]
            e, rest = z - Q @ (Q.T @ z), X - Q @ (Q.T @ X)
            size = np.maximum(np.einsum("np,np->p", rest, rest), 1e-9)
            gain = -N * np.log1p(-np.minimum((rest.T @ e) ** 2 / size / (e @ e), 0.999))
            best = int(np.argmax(gain))
            if best in chosen or not gain[best] > cost or len(chosen) > 20:
                break
            chosen.append(best)
        lags: dict[str, list[int]] = {}
        for name, k in (places[one - 1] for one in chosen[1:]):
            if name != "y":
                lags.setdefault(name, []).append(k)
        return Found({name: (min(k), min(k)) for name, k in lags.items()}, None)

    return method


def default_arx(plant: Plant) -> Found:
    """ARX(2, 2) on all inputs."""
    inputs = {name: (1, 2) for name in plant.table if name != "flow"}
    return Judged.of(plant, Structure(2, dict.fromkeys(range(5), (2, 1)))).found._replace(inputs=inputs)


def true_structure(plant: Plant) -> Found:
    """The inputs and delays of the plant, and two lags of the output."""
    inputs = {name: (k, k) for name, k in plant.inputs.items()}
    given = {int(name[1:]) - 1: (1, k) for name, k in plant.inputs.items()}
    return Judged.of(plant, Structure(2, given)).found._replace(inputs=inputs)


METHODS: dict[str, Callable[[Plant], Found]] = {
    "identify": ours, "true structure": true_structure, "constants, extended BIC": by_criterion(0.0),
    "ARIMAX, AIC": by_criterion(2.0), "ARX(2, 2)": default_arx,
}  # fmt: skip
NEAR = 30
"""Samples within which a date is right; of a ramp, within it."""


def scored(plant: Plant, found: Found) -> dict[str, float]:
    """Whether each part is right, NaN where there is no such part."""
    nan, timely = float("nan"), plant.cause == "time"
    near = T // 6 if plant.change in ("ramp", "walk") else NEAR
    right = set(found.inputs) == set(plant.inputs)
    decided = found.moves is not None
    return {
        "inputs": float(right),
        "delays": float(right and all(low <= plant.inputs[u] <= high for u, (low, high) in found.inputs.items())),
        "false inputs": float(len(set(found.inputs) - set(plant.inputs))),
        "missed": float(len(set(plant.inputs) - set(found.inputs))),
        "drift found": float(found.moves) if timely and decided else nan,
        "named": float(plant.moving in found.which) if timely and found.moves else nan,
        "date": float(abs(found.date - plant.date) <= near) if timely and found.moves else nan,
        "interval": float(any(first <= plant.date <= last for first, last in found.spans))
        if plant.change in ("jump", "moving pole") and found.moves
        else nan,
        "claims": float(found.moves) if plant.change == "constant" and decided else nan,
        "cause": float(found.cause == plant.cause) if plant.cause and found.cause else nan,
        "silent": float(not found.cause) if plant.cause and decided else nan,
    }


def main() -> None:
    """Print the tables for some seeds and methods."""
    options = argparse.ArgumentParser()
    options.add_argument("seeds", type=int, nargs="*", default=[1000, 1001])
    options.add_argument("--of", choices=CHANGES)
    options.add_argument("--by", choices=METHODS)
    options.add_argument("--quick", action="store_true", help="two plants")
    given = options.parse_args()
    for name in [given.by] if given.by else METHODS:
        rows: dict[str, list[dict[str, float]]] = {}
        each = (one for seed in range(*given.seeds) for one in plants(seed) if given.of in (None, one.change))
        for one in islice(each, 2 if given.quick else None):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                row = scored(one, METHODS[name](one))
            rows.setdefault(one.change, []).append(row)
            rows.setdefault("all", []).append(row)
            print(".", end="", file=sys.stderr, flush=True)
        heads = list(rows["all"][0])
        print(f"\n{name}, seeds {given.seeds}\n{'':14}{''.join(f'{h:>13}' for h in heads)}  plants")
        for change, found in rows.items():
            known = [np.array([row[h] for row in found]) for h in heads]
            cells = (f"{np.nanmean(x):13.2f}" if np.isfinite(x).any() else f"{'':13}" for x in known)
            print(f"{change:14}{''.join(cells)}  {len(found)}", flush=True)


if __name__ == "__main__":
    main()

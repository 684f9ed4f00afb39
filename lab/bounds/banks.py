"""Banks drawn at random, whose arrays are apart in memory, with NaN in between.

An address beyond its array gives NaN, or is found to have been written to. Every reduction, kind of change, sensor,
prior and form is drawn, one output and two, and records that have outages, gaps in time, fault codes, repeated readings
and regressors that begin late.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from lab.bounds.checks import Violations

APART = 64
"""Entries between the arrays of a bank."""


def heavy(y: float, y_hat: float, h: float, r: float, last: float) -> tuple[float, float, float]:
    """A user-defined sensor, with Laplacian noise."""
    width, far = 2.0 * math.sqrt(h + r), abs(y - y_hat)
    return -math.log(2.0 * width) - far / width, r * max(1.0, far / math.sqrt(r)), y_hat


def move_apart() -> None:
    """Put `APART` NaN after every array of banks made from now on."""
    from driftfit.bank.layout import MEMORY_AT, PACKED, REPORTED, ROW, WINDOWS

    bank: Any = import_module("driftfit.bank.bank")
    packed = bank.packed
    inside = [name for name in PACKED if name not in REPORTED]

    def apart(arrays: Any, numbers: Any) -> dict[str, Any]:
        state = packed(arrays, numbers)
        old, table = state["memory"], state["table"]
        size = len(old) + APART * (len(inside) + 1)
        new, shifts = np.full(2 ** int(np.ceil(np.log2(size))), np.nan), {}
        order = sorted(inside, key=lambda name: (table[ROW[name], 0], inside.index(name)))
        for k, name in enumerate(order):
            at, size = table[ROW[name], 0] // 8, int(table[ROW[name], 1] * table[ROW[name], 2])
            shifts[name] = APART * (k + 1)
            new[at + shifts[name] : at + shifts[name] + size] = old[at : at + size]
        for name in (*inside, *WINDOWS):
            table[ROW[name], 0] += 8 * shifts["scratch" if name in WINDOWS else name]
        table[MEMORY_AT, 2] = len(new)  # several outputs put copies behind it
        return {**state, "memory": new}

    bank.packed = apart


def trespassed(lane: Any) -> list[str]:
    """The arrays after which something was written."""
    from driftfit.bank.layout import PACKED, REPORTED, ROW

    result = []
    for name in PACKED:
        start, rows, columns = lane["table"][ROW[name]]
        after = start // 8 + rows * columns
        if name not in REPORTED and not np.isnan(lane["memory"][after : after + APART]).all():
            result.append(f"written beyond {name}")
    return result


def drawn(rng: np.random.Generator, quick: bool) -> tuple[Any, Any, dict[str, Any]]:
    """A model, a bank for it, and a record, at random."""
    from driftfit import ARX, Regression

    n = 2 if quick else int(rng.choice([1, 2, 3, 4, 5, 9]))
    na = int(rng.integers(0, 2 if quick else 3)) if rng.random() < 0.5 else 0
    ny = 2 if rng.random() < 0.2 else 1
    model = ARX(na, n, nk=int(rng.integers(0, 2)), ny=ny) if na else Regression(n, ny=ny)
    bank = bank_of(rng, n + ny * na)
    T = int(rng.integers(1, 90))
    u = rng.standard_normal((T, n if not na else 1))
    y = u.sum(axis=1) * np.where(np.arange(T) < T // 2, 1.0, 2.5) + 0.3 * rng.standard_normal(T)
    if rng.random() < 0.4:  # regressors that begin late, so that a bank runs in the coordinates of its start
        for k in range(u.shape[1]):
            u[: int(rng.integers(T)), k] = 0.0
    if rng.random() < 0.5:
        y[rng.random(T) < 0.2] = np.nan
        y[T // 3 : T // 2] = np.nan
    if rng.random() < 0.3:
        u[rng.random(T) < 0.1] = np.nan
    if rng.random() < 0.3:
        y = np.round(y)
    if rng.random() < 0.2:
        y[int(rng.integers(T))] = 9999.0
    more = {"y": y if ny == 1 else np.stack([y, -y], axis=1), "u": u}
    if rng.random() < 0.4:
        more["time"] = np.cumsum(rng.choice([1.0, 0.5, 2.0, 20.0], T))
    if ny == 1 and rng.random() < 0.2:
        Hd = len(bank.all_changes)
        each = rng.dirichlet(np.ones(Hd), T)
        chain = rng.dirichlet(np.ones(Hd), (T, Hd))
        more["prob"] = chain if rng.random() < 0.5 else np.where(rng.random((T, 1)) < 0.5, np.nan, each)
    return model, bank, more


def bank_of(rng: np.random.Generator, n: int) -> Any:
    """A random bank for n parameters; invalid combinations are redrawn."""
    from driftfit import Bank, Change, Sensor

    while True:
        changes = [Change(float(rng.choice([0.0, 1e-4])))]
        walks = rng.random() < 0.5
        for _ in range(int(rng.integers(0, 3))):
            kind = int(rng.integers(0, 3 if walks else 6))
            p = float(rng.choice([0.0, 0.01, 0.1]))
            changes.append([
                Change(1.0, prob=p), Change(size=3.0, prob=p), Change(1.0, prob=p, which=[int(rng.integers(n))]),
                Change(forget=0.8, prob=p), Change(forget=0.9, kind="directional", prob=p),
                Change(2.0, prob=p, reset=True),
            ][kind])  # fmt: skip
        nominal = [Sensor.nominal(0.1), Sensor.nominal(), Sensor.nominal(guess=0.1)]
        sensors = [nominal[int(rng.integers(3))]]
        others = [Sensor.outlier(prob=0.05), Sensor.outlier(kind="additive", prob=0.05), Sensor.offset(value=2.0)]
        others += [Sensor.frozen(0.01), Sensor.own(heavy, prob=0.05, cleans=True)]
        sensors += [others[k] for k in rng.permutation(5)[: int(rng.integers(0, 3))]]
        Hd, Hm = len(changes), len(sensors)
        transition = None
        if rng.random() < 0.5:
            transition = [rng.dirichlet(np.ones(k), k) if rng.random() < 0.7 else None for k in (Hd, Hm)]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return Bank(
                    changes, sensors, None if transition is None else tuple(transition), reduction(rng, Hd * Hm),
                    p0=None if rng.random() < 0.5 else float(rng.choice([2.0, 1e14])), lag_variance=rng.random() < 0.5,
                )  # fmt: skip
        except ValueError:
            continue


def reduction(rng: np.random.Generator, H: int) -> Any:
    """A random reduction."""
    from driftfit.bank.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid, Resample

    depth, leaves, window = (
        int(x) for x in (rng.integers(1, 5), rng.choice([1, 2, 7, 9, 22, 33, 64, 100]), rng.choice([1, 3, 8, 30]))
    )
    loss = "map" if rng.random() < 0.5 else rng.random((H, H)) * (1.0 - np.eye(H))
    wait = None if rng.random() < 0.5 else 0.01
    kinds: list[Callable[[], Any]] = [
        lambda: Beam(leaves, window), lambda: Hybrid(leaves, min(window, 6), int(rng.integers(0, 3)), 20),
        lambda: Decide(depth, loss, force=True), lambda: Decide("auto", loss, depth, 0.01, wait, True),
        lambda: Resample(leaves, window), lambda: GPB(min(depth, 3)),
        lambda: IMM(), lambda: FirstFloor(depth, str(rng.choice(["prior", "posterior"]))),
    ]  # fmt: skip
    return kinds[int(rng.integers(len(kinds)))]()


def faults(run: Any) -> list[str]:
    """What is wrong with the numbers and the memory of a bank."""
    wrong = [] if np.isfinite(run.theta).all() and np.isfinite(run.prediction[run.ok]).all() else ["not finite"]
    wrong, p = wrong + trespassed(run.state), run.hypotheses.mode_prob
    known = ~np.isnan(p).any(axis=1)  # once the bank has begun
    proper = (p[known] > -1e-9).all() and (p[known] < 1.0 + 1e-9).all() and (np.diff(known.astype(int)) >= 0).all()
    return wrong if proper else [*wrong, "not probabilities"]


def run_banks(seeds: range, quick: bool, violations: Violations) -> int:
    """Run the banks of these seeds; returns how many had a violation or wrong numbers."""
    from driftfit import track

    move_apart()
    bad = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        model, bank, record = drawn(rng, quick)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            settings: dict[str, Any] = {**record, "dt": 1.0} if "time" in record else record
            run: Any = track(model, bank, **settings)
        each = list(run.values()) if len(model.outputs) > 1 else [run]
        for one in each:
            one.hypotheses.found()
        wrong = violations.take() + [result for one in each for result in faults(one)]
        if wrong:
            bad += 1
            print(f"bank {seed}: {bank!r}\n    " + "\n    ".join(wrong), flush=True)
        if (seed + 1) % 10 == 0:
            print(f"banks {seeds[0]} to {seed}, {bad} at fault", flush=True)
    return bad

"""Random configurations of the library's public interface, each a function that runs one and returns named arrays.

They cover every tracker in every form, the models, the reductions of a bank, several outputs, fleets, grids, uneven
time, weights, known drift, warm starts, saved and loaded states, streams, and records with missing data. Only the
public interface is used, so they give the same results before and after an internal change.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from driftfit import (
    ARX,
    FLS,
    GPB,
    IMM,
    RLS,
    AdaptiveKalman,
    AugmentedFLS,
    Bank,
    Beam,
    Change,
    Decide,
    ExtendedKalman,
    FirstFloor,
    HammersteinWiener,
    Hybrid,
    Kalman,
    Live,
    OutputError,
    Regression,
    Sensor,
    track,
)
from driftfit.models.hammerstein_wiener.basis import Polynomial

Arrays = dict[str, np.ndarray[Any, Any]]
Configuration = Callable[[], Arrays]

WRITTEN = ("theta", "std", "prediction", "innovation", "innovation_std", "ok")
T = 300

CHANGES = [Change(q=0, prob=0.98), Change(q=0.5, prob=0.02)]
SENSORS = [Sensor.nominal(r=0.01, prob=0.97), Sensor.outlier(prob=0.03)]

SIMPLE: dict[str, Any] = {
    "Kalman": Kalman(q=1e-3, r=0.01),
    "Kalman, prior": Kalman(q=1e-3, r=0.01, p0=2.0, theta0=0.1),
    "Kalman, square root": Kalman(q=1e-3, r=0.01, form="sqrt"),
    "RLS": RLS(0.98),
    "RLS, directional": RLS(0.98, kind="directional"),
    "FLS": FLS(50.0),
    "FLS, second differences": FLS(50.0, differences=2),
    "AugmentedFLS": AugmentedFLS.from_fls_mu(50.0, n=2, s=1.0),
    "AdaptiveKalman": AdaptiveKalman(),
    "Bank, beam": Bank(CHANGES, [Sensor.nominal(r=0.01)], p0=2.0, reduce=Beam(9)),
    "Bank, unknown noise": Bank(),
}
BANKS: dict[str, Any] = {
    "GPB(1)": Bank(CHANGES, SENSORS, p0=2.0, reduce=GPB(1)),
    "GPB(2)": Bank(CHANGES, SENSORS, p0=2.0, reduce=GPB(2)),
    "IMM": Bank(CHANGES, SENSORS, p0=2.0, reduce=IMM()),
    "Decide": Bank(CHANGES, SENSORS, p0=2.0, reduce=Decide(2)),
    "Hybrid": Bank(CHANGES, SENSORS, p0=2.0, reduce=Hybrid(6)),
    "FirstFloor": Bank(CHANGES, [Sensor.nominal(r=0.01)], p0=2.0, reduce=FirstFloor(2)),
    "beam, wide prior": Bank(CHANGES, SENSORS, p0=1e14, reduce=Beam(6)),
}
FORGETTING = [
    Change(1e-4),
    Change(forget=0.9, prob=0.02),
    Change(forget=0.9, kind="directional", prob=0.02),
    Change(forget=0.9, kind="stabilised", anchor=[[3.0, 1.0], [1.0, 2.0]], prob=0.01),
    Change(0.5, which=[1], reset=True, prob=0.01),
    Change(2.0, reset=True, prob=0.01),
]
FAULTS = [Sensor.nominal(r=0.01), Sensor.outlier(kind="additive", prob=0.02), Sensor.frozen(resolution=0.01)]
MARKOV = ([[0.97, 0.03], [0.3, 0.7]], [[0.96, 0.02, 0.02], [0.5, 0.4, 0.1], [0.1, 0.1, 0.8]])
WAITING = Decide("auto", max_depth=3, wait_cost=0.005)
EVERY_PART: dict[str, Any] = {
    "a persistent prior, GPB(2)": Bank(CHANGES, FAULTS, MARKOV, reduce=GPB(2), p0=2.0),
    "a persistent prior, IMM": Bank(CHANGES, FAULTS, MARKOV, reduce=IMM(), p0=2.0),
    "a persistent prior, hybrid": Bank(CHANGES, FAULTS, MARKOV, reduce=Hybrid(6), p0=2.0),
    "forgetting": Bank(FORGETTING, [Sensor.nominal(r=0.01)], reduce=Beam(7), p0=2.0),
    "forgetting, IMM": Bank(FORGETTING, [Sensor.nominal(r=0.01)], reduce=IMM(), p0=2.0),
    "unknown noise, GPB(2)": Bank(CHANGES, [Sensor.nominal(guess=0.1)], reduce=GPB(2), p0=2.0),
    "unknown noise, many leaves": Bank(CHANGES, [Sensor.nominal()], reduce=Beam(80)),
    "waiting": Bank(CHANGES, SENSORS, reduce=WAITING, p0=2.0),
    "waiting, unknown noise": Bank(CHANGES, [Sensor.nominal()], reduce=WAITING),
    "FirstFloor, prior": Bank(CHANGES, [Sensor.nominal(r=0.01)], reduce=FirstFloor(3, "prior"), p0=2.0),
    "lags for certain": Bank(CHANGES, FAULTS, MARKOV, reduce=Beam(6), p0=2.0, lag_variance=False),
}
"""Banks that together use every part of the compiled routine, from a prior that the first samples outgrow too."""
BLOCKS = HammersteinWiener(na=1, nb=1, input=Polynomial(2), output=Polynomial(2))


def signals(seed: int, m: int = 1, ny: int = 1, holes: bool = True) -> tuple[np.ndarray[Any, Any], ...]:
    """y (T, ny), u (T, m) of a stable system whose gain jumps, with missing values in both."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, m))
    gain = np.where(np.arange(T) < T // 2, 1.0, 1.6)
    y = np.zeros((T, ny))
    for t in range(1, T):
        y[t] = 0.6 * y[t - 1] + gain[t] * u[t - 1].sum() + 0.1 * rng.standard_normal(ny)
    if holes:
        y[rng.random((T, ny)) < 0.05] = np.nan
        u[rng.random((T, m)) < 0.02] = np.nan
        y[120:128] = np.nan
    return y, u


def written(run: Any) -> Arrays:
    """The results of a run, and its likelihood."""
    return {name: np.asarray(getattr(run, name)) for name in WRITTEN} | {"loglik": np.asarray(run.loglik)}


def smoothed(run: Any) -> Arrays:
    """The results of its smoother."""
    path = run.smooth()
    return {"smoothed theta": np.asarray(path.theta), "smoothed std": np.asarray(path.std)}


def of_record(model: Any, tracker: Any, seed: int, smooth: bool = False, **known: Any) -> Configuration:
    """One record."""

    def run() -> Arrays:
        y, u = signals(seed, m=model.m)
        made = track(model, tracker, y[:, 0], u, **known)
        return written(made) | (smoothed(made) if smooth else {})

    return run


def of_stream(model: Any, tracker: Any, seed: int) -> Configuration:
    """A stream that is stored, loaded and continued halfway."""

    def run() -> Arrays:
        y, u = signals(seed, m=model.m)
        live = Live(model, tracker)
        steps = [live.update(y[t, 0], u[t]) for t in range(T // 2)]
        with tempfile.TemporaryDirectory() as folder:
            live.save(Path(folder) / "state.npz")
            live = Live.load(Path(folder) / "state.npz")
        steps += [live.update(y[t, 0], u[t]) for t in range(T // 2, T)]
        return {"steps": np.array(steps, dtype=float), "theta": live.theta, "std": live.std}

    return run


def of_warm_start(model: Any, tracker: Any, seed: int) -> Configuration:
    """The second half of a record, continued from the first."""

    def run() -> Arrays:
        y, u = signals(seed, m=model.m)
        first = track(model, tracker, y[: T // 2, 0], u[: T // 2])
        return written(track(model, tracker, y[T // 2 :, 0], u[T // 2 :], warm_start=first))

    return run


def of_fleet(model: Any, tracker: Any, seed: int, units: int) -> Configuration:
    """Series of one fleet, by row."""

    def run() -> Arrays:
        records = [signals(seed + k, m=model.m) for k in range(units)]
        fleet = track(
            model, tracker, np.stack([y[:, 0] for y, _ in records]), np.stack([u for _, u in records]), by="row"
        )
        return {f"{key}: {name}": value for key in fleet.keys() for name, value in written(fleet[key]).items()}  # noqa: SIM118

    return run


def of_grid(model: Any, trackers: list[Any], seed: int) -> Configuration:
    """Settings over one record."""

    def run() -> Arrays:
        y, u = signals(seed, m=model.m)
        runs = track(model, trackers, y[:, 0], u)
        return {f"{key}: {name}": value for key in runs.keys() for name, value in written(runs[key]).items()}  # noqa: SIM118

    return run


def of_outputs(model: Any, tracker: Any, seed: int, ny: int) -> Configuration:
    """Several outputs."""

    def run() -> Arrays:
        y, u = signals(seed, m=2, ny=ny)
        wanted = np.repeat(u[:, None, :], ny, axis=1) if getattr(model, "shared", False) else u
        made = track(model, tracker, y, wanted)
        return {name: np.asarray(getattr(made, name)) for name in WRITTEN}

    return run


def of_output_fleet(
    model: Any, tracker: Any, seed: int, units: int, halves: bool = False, **known: Any
) -> Configuration:
    """A fleet of records with several outputs each, by row; with ``halves`` it is continued halfway."""

    def run() -> Arrays:
        records = [signals(seed + k, m=2, ny=2) for k in range(units)]
        y, u = (np.stack(part) for part in zip(*records, strict=True))
        if getattr(model, "shared", False):
            u = np.repeat(u[:, :, None, :], 2, axis=2)
        fleet: Any = None
        for rows in (slice(0, T // 2), slice(T // 2, T)) if halves else (slice(None),):
            fleet = track(model, tracker, y[:, rows], u[:, rows], by="row", warm_start=fleet, **known)
        return {f"{k}: {name}": value for k in range(units) for name, value in written(fleet[k]).items()}

    return run


def of_output_stream(model: Any, tracker: Any, seed: int) -> Configuration:
    """A stream with several outputs that is stored, loaded and continued halfway, with separate factors."""

    def run() -> Arrays:
        y, u = signals(seed, m=2, ny=2)
        given = np.repeat(u[:, None, :], 2, axis=1) if getattr(model, "shared", False) else u
        live: Any = Live(model, tracker, lag=5, limits={"y1": (-4.0, 4.0)})
        steps = []
        for t in range(T):
            ahead = live.predict(given[t])
            steps.append([*ahead, *live.update(y[t], given[t], time=1.3 * t, weight=[1.0, 2.0], drift=1.5)])
            if t == T // 2:
                live = Live.from_bytes(live.to_bytes())
        kept = live.smooth()
        found = {"steps": np.array(steps, dtype=float), "theta": live.theta, "std": live.std}
        return found | {"lagged theta": kept.theta, "lagged std": kept.std, "ahead": live.forecast(3).theta}

    return run


def configurations() -> Iterator[tuple[str, Configuration]]:
    """Eighty of them, by name; the draws are fixed."""
    rng = np.random.default_rng(80)
    models = {"ARX(1, 1)": ARX(1, 1), "Regression(2)": Regression(2), "ARX(1, 1) from zero": ARX(1, 1, start="zero")}
    uneven = np.cumsum(rng.choice([0.5, 1.0, 1.0, 1.0, 3.0], T))
    for name, tracker in SIMPLE.items():
        smooth = not isinstance(tracker, AdaptiveKalman | AugmentedFLS | RLS) and tracker != Bank()
        for kind, model in models.items():
            seed = int(rng.integers(1000))
            yield f"{name} on {kind}", of_record(model, tracker, seed, smooth)
        seed = int(rng.integers(1000))
        yield f"{name}, uneven time", of_record(ARX(1, 1), tracker, seed, time=uneven)
        yield f"{name}, stream", of_stream(ARX(1, 1), tracker, seed)
        yield f"{name}, warm start", of_warm_start(ARX(1, 1), tracker, seed)
    for name, tracker in BANKS.items():
        yield f"Bank, {name}", of_record(ARX(1, 1), tracker, int(rng.integers(1000)))
    weights, drift = rng.choice([0.0, 0.5, 1.0, 2.0], T), rng.choice([0.0, 1.0, 1.0, 10.0], T)
    yield "Kalman, weights and drift", of_record(ARX(1, 1), SIMPLE["Kalman"], 5, True, weights=weights, drift=drift)
    yield "Bank, weights", of_record(ARX(1, 1), SIMPLE["Bank, beam"], 5, weights=weights)
    each = rng.choice([0.0, 1.0, 4.0], (T, 2))
    yield "Kalman, a drift for each", of_record(ARX(1, 1), SIMPLE["Kalman"], 6, True, drift=each)
    yield "FLS, a drift for each", of_record(ARX(1, 1), SIMPLE["FLS"], 6, True, drift=each)
    for units in (3, 40):
        for name in ("Kalman", "RLS", "FLS"):
            yield f"{name}, fleet of {units}", of_fleet(ARX(1, 1), SIMPLE[name], 100, units)
    yield "AdaptiveKalman, fleet of 3", of_fleet(ARX(1, 1), AdaptiveKalman(), 100, 3)
    yield "Kalman, grid", of_grid(ARX(1, 1), [Kalman(q=q, r=0.01) for q in np.logspace(-6, 0, 20)], 7)
    for name in ("Kalman", "RLS"):
        yield f"{name}, two outputs", of_outputs(ARX(1, 1, inputs=2, ny=2), SIMPLE[name], 8, 2)
        yield f"{name}, a theta shared", of_outputs(Regression(2, ny=2, shared=True), SIMPLE[name], 9, 2)
    joint, apart, shared = ARX(1, 1, inputs=2, ny=2), Regression(2, ny=2), Regression(2, ny=2, shared=True)
    own = {"y1": SIMPLE["Kalman"], "y2": Kalman(q=[1e-4, 1e-3], r=0.04)}
    limits, excluded = {"y2": (-3.0, 3.0), 0: (-1.5, 1.5)}, [(50, 60)]
    for kind, model in {"joint": joint, "a theta each": apart, "a theta shared": shared}.items():
        for units in (3, 40):
            yield f"fleet of {units} with two outputs, {kind}", of_output_fleet(model, SIMPLE["Kalman"], 300, units)
        yield f"fleet with two outputs, {kind}, warm start", of_output_fleet(model, SIMPLE["RLS"], 310, 3, True)
        yield (
            f"fleet with two outputs, {kind}, uneven time",
            of_output_fleet(model, SIMPLE["FLS"], 320, 3, time=uneven, limits=limits, exclude=excluded),
        )
        yield f"stream with two outputs, {kind}", of_output_stream(model, SIMPLE["Kalman"], 330)
    yield "two outputs, a tracker each", of_outputs(apart, own, 340, 2)
    yield "Hammerstein-Wiener, Kalman", of_record(BLOCKS, Kalman(q=1e-5, r=0.01, p0=1.0), 10)
    yield "Hammerstein-Wiener, extended", of_record(BLOCKS, ExtendedKalman(q=1e-5, r=0.01), 10)
    yield "Hammerstein-Wiener, output error", of_record(BLOCKS, OutputError(q=1e-5, r=0.01, q_w=1e-4), 10)
    for at, (name, tracker) in enumerate(EVERY_PART.items()):
        for p0 in (tracker.p0, 1e14):
            yield f"Bank, {name}, p0 {p0}", of_record(ARX(1, 1), replace(tracker, p0=p0), 20 + at, time=uneven)
    for name in ("Decide", "Hybrid", "IMM"):
        yield f"Bank, {name}, two outputs", of_outputs(ARX(1, 1, inputs=2, ny=2), BANKS[name], 8, 2)
    for n in (1, 3, 4, 7):
        yield f"Bank, {n} parameters", of_record(Regression(n), Bank(), 40 + n)
    fault = rng.choice([0.0, 0.01, 0.2], T)
    prob = np.stack([1.0 - fault, fault], 1)
    yield "Bank, probabilities of each sample", of_record(ARX(1, 1), SIMPLE["Bank, beam"], 50, prob=prob)
    yield "Bank, stream of faults", of_stream(ARX(1, 1), EVERY_PART["a persistent prior, hybrid"], 51)

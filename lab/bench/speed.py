"""Speed contests, one function each: the contests, and the packages in each. ``python -m lab bench speed``.

Every contest is a regression of four parameters unless it says otherwise, from the same start P0 = 10, with the same
numbers. Times are medians of runs that take turns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.bank.change import Change
from driftfit.bank.reduction import IMM, Beam
from driftfit.bank.sensor import Sensor
from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.regression import Regression
from driftfit.streams import Live
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.augmented_fls import AugmentedFLS
from driftfit.trackers.base import Tracker
from driftfit.trackers.kalman import Kalman
from driftfit.trackers.rls import RLS
from driftfit.tracking import track
from lab.bench import speed_peers as peers
from lab.bench.computer import times
from lab.bench.contest import Contest, Finish, Job, hold
from lab.bench.speed_bounds import bound
from lab.bench.speed_peers import P0, Q, R, Signals

SEED = 1
FORGETTING = 0.99


def signals(T: int, n: int = 4, series: int | None = None) -> Signals:
    """White regressors, slowly drifting true parameters, noise."""
    rng = np.random.default_rng(SEED)
    shape = (T, n) if series is None else (series, T, n)
    phi = rng.normal(size=shape)
    theta = 1.0 + 0.01 * np.cumsum(rng.normal(size=shape), axis=-2)
    return Signals(np.sum(phi * theta, axis=-1) + 0.1 * rng.normal(size=shape[:-1]), phi)


def stream(name: str, tracker: Tracker, data: Signals) -> Job:
    """Live, sample by sample, the regressors as arrays."""
    live = Live(Regression(data.phi.shape[1]), tracker)
    outputs, rows = data.y.tolist(), list(data.phi)

    def run() -> None:
        for y, u in zip(outputs, rows, strict=True):
            live.update(y, u)

    return Job(name, run, len(outputs), lambda: live.theta)


def record(name: str, tracker: Tracker, data: Signals) -> Job:
    """A whole record."""
    model = Regression(data.phi.shape[1])

    def run() -> Any:
        return track(model, tracker, data.y, data.phi)

    return Job(name, run, len(data.y), lambda: run().theta)


def live_kalman(T: int) -> Contest:
    """Kalman filter, one update from Python."""
    data = signals(T)
    others = (peers.live_filterpy, peers.live_pykalman, peers.live_simdkalman)
    note = "one predict and update from Python"
    return Contest(
        "Live update, Kalman filter", note, stream("driftfit Live, Kalman", kalman(), data), peers.on(data, others)
    )


def kalman() -> Kalman:
    """The filter of the contests."""
    return Kalman(q=Q, r=R, p0=P0)


def live_rls(T: int) -> Contest:
    """Least squares with forgetting, one update from Python."""
    data = signals(T)
    ours = stream("driftfit Live, RLS", RLS(FORGETTING, p0=P0), data)
    others = peers.on(data, (lambda d: peers.live_padasip_rls(d, FORGETTING),))
    return Contest(
        "Live update, RLS", "prediction and adaptation from Python; ours also carries the noise variance", ours, others
    )


def live_nlms(T: int) -> Contest:
    """Normalised gradient, one update from Python."""
    data = signals(T)
    ours = stream("driftfit Live, AugmentedFLS", AugmentedFLS(mu=0.5, theta0=0.0), data)
    others = (lambda d: peers.live_padasip_nlms(d, 0.5), peers.live_river)
    return Contest(
        "Live update, NLMS", "river runs a plain gradient step, another algorithm", ours, peers.on(data, others)
    )


def live_free(T: int) -> Contest:
    """The tracker without settings, compared with its parts: a bank of filters."""
    data = signals(T)
    others = (lambda: stream("driftfit Live, Kalman", kalman(), data),)
    return Contest(
        "Live update, AdaptiveKalman",
        "no peer chooses its own settings",
        stream("driftfit Live, AdaptiveKalman", AdaptiveKalman(), data),
        others,
    )


def record_kalman(T: int) -> Contest:
    """Kalman filter over a record."""
    data = signals(T)
    others = (peers.statsmodels_filter, peers.dynamax_filter, peers.filterpy_filter, peers.pykalman_filter)
    return Contest(
        "Record, Kalman filter",
        "peers that loop in Python run a tenth of the record",
        record("driftfit track, Kalman", kalman(), data),
        peers.on(data, others),
    )


def record_rls(T: int) -> Contest:
    """Least squares with forgetting over a record."""
    data = signals(T)
    others = (lambda d: peers.polars_rls(d, FORGETTING), lambda d: peers.padasip_rls(d, FORGETTING))
    return Contest(
        "Record, RLS",
        "coefficients at every sample",
        record("driftfit track, RLS", RLS(FORGETTING, p0=P0), data),
        peers.on(data, others),
    )


def record_ls(T: int) -> Contest:
    """Recursive least squares without forgetting."""
    data = signals(T)
    return Contest(
        "Record, recursive least squares",
        "diffuse start, no forgetting",
        record("driftfit track, RLS(1)", RLS(1.0), data),
        peers.on(data, (peers.statsmodels_recursive,)),
    )


def smoother(T: int) -> Contest:
    """Filter and smoother over a record."""
    data = signals(T)

    def both() -> Any:
        return track(Regression(4), kalman(), data.y, data.phi).smooth()

    ours = Job("driftfit track(...).smooth()", both, T, lambda: np.asarray(both().theta))
    others = (peers.statsmodels_smoother, peers.dynamax_smoother, peers.pykalman_smoother)
    return Contest("Filter and smoother", "means and variances at every sample", ours, peers.on(data, others))


def fleet(T: int) -> Contest:
    """Many series at once."""
    series, length = max(T // 80, 32), 200
    data = signals(length, series=series)

    def run() -> Any:
        return track(Regression(4), kalman(), data.y, data.phi, by="row")

    ours = Job("driftfit track(by='row')", run, series * length, lambda: np.asarray(run()[0].theta))
    others = (peers.dynamax_fleet, peers.simdkalman_fleet, peers.statsmodels_fleet)
    return Contest(f"Fleet of {series} series of {length}", "per series and step", ours, peers.on(data, others))


def bank(T: int) -> Contest:
    """Two drift rates with a Markov prior, interacting multiple models."""
    data = signals(T)
    tracker = Bank(
        changes=[Change(q=Q), Change(q=100.0 * Q)], sensors=[Sensor.nominal(r=R)], p0=P0,
        transition=peers.TRANSITION, initial=[0.5, 0.5], reduce=IMM(),
    )  # fmt: skip
    ours = stream("driftfit Live, Bank, IMM of 2", tracker, data)
    return Contest(
        "Bank against IMM", "two models of four parameters, live", ours, peers.on(data, (peers.live_filterpy_imm,))
    )


def hammerstein_wiener(T: int) -> Contest:
    """The over-parametrised regression of a Hammerstein-Wiener model with cubic blocks."""
    model = HammersteinWiener(2, 2, input=Polynomial(3), output=Polynomial(3))
    rng = np.random.default_rng(SEED)
    y, u = 0.1 * rng.normal(size=T), rng.normal(size=T).tolist()
    live = Live(model, Kalman(q=Q, r=R, p0=P0))

    def run() -> None:
        for value, present in zip(y.tolist(), u, strict=True):
            live.update(value, present)

    name = f"driftfit Live, Kalman on {live.theta.size} products"
    others = (lambda: Job("driftfit track, the same", lambda: track(model, Kalman(q=Q, r=R, p0=P0), y, u), T),)
    return Contest("Hammerstein-Wiener step", "no peer has this model", Job(name, run, T), others)


BOUNDS = ((2, 1), (4, 1), (6, 1), (10, 1), (4, 32))
"""(n, lanes) of the contests against the floors."""

CONTESTS: tuple[tuple[Callable[[int], Contest], int, int], ...] = (
    (live_kalman, 500, 200), (live_rls, 2000, 200), (live_nlms, 2000, 200), (live_free, 2000, 200),
    (record_kalman, 20_000, 1000), (record_rls, 20_000, 1000), (record_ls, 5_000, 1000), (smoother, 10_000, 1000),
    (fleet, 80_000, 3200), (bank, 1000, 200), (hammerstein_wiener, 2000, 200),
    *((partial(bound, n, lanes), 32_000, 3200) for n, lanes in BOUNDS),
)  # fmt: skip
"""Contests with their sizes, full and quick."""


def contests(quick: bool) -> Iterator[Finish]:
    """Hold them all; one that needs something absent is named instead."""
    for make, full, small in CONTESTS:
        try:
            contest = make(small if quick else full)
        except ImportError as error:
            yield Finish(_title(make), "", [], [error.name or str(error)])
        else:
            yield hold(contest, 3 if quick else 11)


def _title(make: Any) -> str:
    """What a contest that could not be made is about."""
    if isinstance(make, partial):
        return f"Floors, n = {make.args[0]}, {make.args[1]} lanes"
    return str(make.__doc__).splitlines()[0].rstrip(".")


def slopes(quick: bool) -> dict[str, tuple[Array, Array, str]]:
    """Seconds against T, n, series and leaves, by name: (sizes, seconds, what of)."""
    found: dict[str, tuple[Array, Array, str]] = {}
    for name, (sizes, job, what) in GROWTH.items():
        try:
            chosen = sizes[:3] if quick else sizes
            seconds = [_fastest(job(size), 3 if quick else 9) for size in chosen]
        except ImportError:
            continue
        found[name] = (np.array(chosen, float), np.array(seconds), what)
    return found


def _fastest(run: Callable[[], object], repeats: int) -> float:
    return times(repeats, [run])[0]


def _samples(T: int) -> Callable[[], object]:
    return record("", kalman(), signals(T)).run


def _parameters(n: int) -> Callable[[], object]:
    return record("", kalman(), signals(20_000, n)).run


def _series(count: int) -> Callable[[], object]:
    data = signals(200, series=count)
    return lambda: track(Regression(4), kalman(), data.y, data.phi, by="row")


def _leaves(count: int) -> Callable[[], object]:
    return record("", Bank(reduce=Beam(count)), signals(2000)).run


GROWTH: dict[str, tuple[tuple[int, ...], Callable[[int], Callable[[], object]], str]] = {
    "T": ((1_000, 10_000, 100_000, 1_000_000), _samples, "track, Kalman, n = 4"),
    "n": ((1, 2, 4, 8, 16), _parameters, "track, Kalman, T = 20 000"),
    "series": ((1, 8, 32, 128, 512, 2048), _series, "fleet, Kalman, n = 4, T = 200"),
    "leaves": ((4, 16, 64, 256), _leaves, "track, Bank with Beam, n = 4, T = 2000"),
}


def slope(sizes: Array, seconds: Array) -> float:
    """Exponent between the largest half of the sizes."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(seconds[half:]), 1)[0])

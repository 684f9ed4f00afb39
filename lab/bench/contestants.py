"""The methods of the benchmark: every tracker of ours, every installed peer, and their settings.

A method runs *with its defaults*, if it has defaults for everything, and *tuned*, if it has a setting: the one of its
grid with the least parameter error on other runs of the same scenario. A filter with q in units of r also takes r from
those runs: the mean of e^2 / s at r = 1.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit import Kalman, trackers, tune
from driftfit.engine.kernel import Array
from driftfit.trackers.base import Tracker
from driftfit.tracking import track
from lab.bench import peers
from lab.bench.computer import installed
from lab.bench.peers import Follow, walk
from lab.bench.records import Outcome, Record

RATIOS = tuple((ratio, power) for power in (0.0, 1.0) for ratio in (0.0, *np.logspace(-7.0, 1.0, 17).tolist()))
FORGETTING = (*(1.0 - np.logspace(-4.0, -0.7, 12)).tolist(), 1.0)
STEPS = tuple(np.logspace(-2.0, 0.0, 9).tolist())
RATES = tuple(np.logspace(-5.0, -0.5, 10).tolist())
PRICES = tuple(np.logspace(-1.0, 4.0, 16).tolist())
LARGE_PRICES = tuple(np.logspace(-1.0, 7.0, 17).tolist())


@dataclass(frozen=True)
class Contestant:
    """A way to follow parameters.

    ``relative``: if tuned, its std is in units of sqrt(r). ``tuned_as`` names a method whose setting it takes,
    because it is the same algorithm.
    """

    name: str
    package: str
    follow: Follow
    grid: tuple[Any, ...] = ()
    default: bool = True
    relative: bool = False
    tuned_as: str = ""


def ours(name: str, settings: str, grid: tuple[Any, ...], relative: bool = False) -> Contestant:
    """A tracker of ours with one number to choose."""
    kind = trackers.found()[name]

    def follow(record: Record, setting: Any, c: Array) -> Outcome:
        return run(kind(**{settings: setting}), record)

    return Contestant(name, "driftfit", follow, grid, default=False, relative=relative)


def as_it_comes(kind: type[Tracker]) -> Contestant:
    """A tracker of ours that needs no numbers."""
    return Contestant(kind.__name__, "driftfit", lambda record, setting, c: run(kind(), record))


def run(tracker: Tracker, record: Record) -> Outcome:
    """Run a tracker of ours."""
    return Outcome.of(track(record.model, tracker, record.y, record.u))


def kalman(record: Record, setting: Any, c: Array) -> Outcome:
    """Our Kalman filter with r = 1."""
    return run(trackers.found()["Kalman"](q=walk(setting, c), r=1.0), record)  # type: ignore[call-arg]


def least_squares(record: Record, setting: Any, c: Array) -> Outcome:
    """Least squares on all of the past."""
    return run(trackers.found()["RLS"](forgetting=1.0), record)  # type: ignore[call-arg]


def likeliest(record: Record, setting: Any, c: Array) -> Outcome:
    """Our Kalman filter with the drift of every parameter by maximum likelihood on the very record that is scored."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an optimum at a bound: nothing drifts, or everything does
        tuned = tune(record.model, Kalman(), record.y, record.u, groups="each")
    assert isinstance(tuned.tracker, Tracker)  # of one output
    return run(tuned.tracker, record)


KALMAN = Contestant("Kalman", "driftfit", kalman, RATIOS, default=False, relative=True)

ONE_NUMBER = {"RLS": ("forgetting", FORGETTING), "FLS": ("mu", LARGE_PRICES), "AugmentedFLS": ("mu", PRICES)}
"""Trackers with one number to choose, and its grid."""


def own() -> list[Contestant]:
    """Every tracker of ours that runs on a regression."""
    known = trackers.found()
    free = [as_it_comes(kind) for kind in known.values() if not kind.required]
    one = [ours(name, *ONE_NUMBER[name]) for name in ONE_NUMBER if name in known]
    others = (("Kalman, ML each", likeliest), ("RLS(1), constant LS", least_squares))
    return [*free, KALMAN, *one, *(Contestant(name, "driftfit", follow) for name, follow in others)]


PEERS = (
    Contestant("filterpy KalmanFilter", "filterpy", peers.filterpy_kalman, RATIOS, relative=True, tuned_as="Kalman"),
    Contestant("padasip FilterRLS", "padasip", peers.padasip_rls, FORGETTING),
    Contestant("padasip FilterNLMS", "padasip", peers.padasip_nlms, STEPS),
    Contestant("river LinearRegression", "river", peers.river_linear, RATES),
    Contestant("statsmodels RecursiveLS", "statsmodels", peers.statsmodels_recursive),
)
"""Peers that are scored on every run."""

SAME_FILTER = (
    Contestant("filterpy KalmanFilter", "filterpy", peers.filterpy_kalman),
    Contestant("pykalman KalmanFilter", "pykalman", peers.pykalman_kalman),
    Contestant("simdkalman primitives", "simdkalman", peers.simdkalman_kalman),
    Contestant("dynamax lgssm_filter", "dynamax", peers.dynamax_kalman),
)
"""Peers that run the same filter as `Kalman` with the same settings: their rows would be identical."""


def present(contestants: tuple[Contestant, ...]) -> tuple[list[Contestant], list[str]]:
    """Those whose package is installed, and the names of the packages that are not."""
    there = [c for c in contestants if installed(c.package)]
    return there, sorted({c.package for c in contestants if not installed(c.package)})

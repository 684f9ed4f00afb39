"""Smoothing once a record is complete, and noise of unknown variance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.bank.reduction import Beam, Decide
from driftfit.bank.results.smoothed import problem_of
from driftfit.bank.sensor import Sensor
from driftfit.engine.kernel import Array
from driftfit.results import Track
from driftfit.smooth import mixture
from driftfit.smooth.piecewise import piecewise
from driftfit.trackers.kalman import Kalman
from driftfit.tracking import track
from lab.jumps import MODEL, START, Jumping, jumping
from lab.reproduce.hypotheses.contests import CHANGES, P0, R, bank
from lab.reproduce.hypotheses.scores import pooled

SMOOTHING = {
    "filter, Decide d=3": 0.295, "RTS with decided events": 0.171, "RTS with true events": 0.054,
    "segments, least squares, decided events": 0.188, "RTS of one KF": 0.282, "filter, Beam(9)": None,
    "over all hypotheses": None,
}  # fmt: skip
"""Reference values of the RMSE, of fifty records."""
SIGMAS = (0.1, 0.3, 1.0)
NOISE = {
    "r known": (0.206, 0.271, 0.566), "r = .09 assumed": (0.258, 0.271, 1.143),
    "unknown, from .09": (0.242, 0.303, 0.660),
    "Bank(), nothing given": (None, None, None),
}  # fmt: skip
"""The same for Decide(2) and three standard deviations of the noise."""


def given(run: Track, kinds: Array) -> Array:
    """The smoothed path if change ``kinds[t]`` happened before sample t."""
    return mixture.smooth(problem_of(run, [], kinds)).theta


def paths(record: Jumping) -> dict[str, Array]:
    """Every row of the table of smoothing."""
    run, beam = (track(MODEL, bank(reduce), record.y, record.u) for reduce in (Decide(3), Beam(9)))
    kinds = np.zeros(len(run), int)
    for decision in run.hypotheses.decisions:
        kinds[decision.sample] = decision.event
    walk = track(MODEL, Kalman((0.004, 0.004, 0.04), R, p0=P0), record.y, record.u)
    found = (
        run.theta, given(run, kinds), given(run, record.kinds),
        piecewise(run, [t for t in np.flatnonzero(kinds).tolist() if t > 0]).path, walk.smooth().theta, beam.theta,
        beam.smooth().theta,
    )  # fmt: skip
    return dict(zip(SMOOTHING, found, strict=True))


def rmse(path: Callable[[Jumping], dict[str, Array]], records: list[Jumping]) -> dict[str, tuple[float, float]]:
    """RMSE of every path with its standard error."""
    each: dict[str, list[float]] = {}
    for record in records:
        for name, theta in path(record).items():
            each.setdefault(name, []).append(float(np.sum((theta - record.theta)[START:] ** 2)))
    T = len(records[0].y) - START
    found = {name: pooled(np.array(s)[:, None], np.full((len(s), 1), T)) for name, s in each.items()}
    return {name: (float(rms[0]), error) for name, (rms, error) in found.items()}


def smoothing(runs: int) -> dict[str, tuple[float, float]]:
    """RMSE with its standard error of every row."""
    return rmse(paths, [jumping(seed) for seed in range(runs)])


def noise(runs: int, sigma: float) -> dict[str, tuple[float, float]]:
    """The same for unknown noise."""
    unknown = Sensor.nominal(guess=0.09, nu=4.0, memory=100.0)
    banks = {
        "r known": Bank(CHANGES, (Sensor.nominal(sigma**2),), reduce=Decide(2), p0=P0),
        "r = .09 assumed": bank(Decide(2)),
        "unknown, from .09": Bank(CHANGES, (unknown,), reduce=Decide(2), p0=P0),
        "Bank(), nothing given": Bank(),
    }  # fmt: skip

    def all_of(record: Jumping) -> dict[str, Array]:
        return {name: track(MODEL, one, record.y, record.u).theta for name, one in banks.items()}

    return rmse(all_of, [jumping(seed, sigma=sigma) for seed in range(runs)])

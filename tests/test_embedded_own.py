"""Trackers of one's own are exported as C like any other, or refused before a file is written."""

import ctypes
import re
from dataclasses import dataclass

import numpy as np
import pytest
from embedded_support import agree, bits, needs_gcc, same_numbers

from driftfit import ARX, Regression
from driftfit.embedded import export_c, to_struct
from driftfit.embedded.values import TranslationError
from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import kernel
from driftfit.trackers.base import Tracker


@kernel
def slope_of(e):
    if abs(e) > 1.0:
        return 1.0 / abs(e)
    return 1.0


@kernel
def descend(s, l):
    y_hat, power = 0.0, 1e-3
    for i in range(s.phi.shape[0]):
        y_hat += s.phi[i, l] * s.theta[i, l]
        power += s.phi[i, l] ** 2
    s.y_hat[l], s.e[l], s.s[l] = y_hat, s.y[l] - y_hat, s.r[l]
    some = 1
    for i in range(s.phi.shape[0]):
        some = some if s.phi[i, l] == 0.0 else 3
        s.theta[i, l] += s.ok[l] * s.rate[l] * some * slope_of(s.e[l]) * s.e[l] * s.phi[i, l] / power
    s.leaks[l] += some - 1
    some = 2
    s.turns[l] += some
    s.rate[l] *= 1.0 if s.noise[l] < 2.0 else 0.5


@kernel
def unknown_variance(s, l):
    for i in range(s.theta.shape[0]):
        s.var[i, l] = np.nan


@kernel
def still(s, l):
    """Nothing changes with time."""


@dataclass(frozen=True)
class Descent(Tracker):
    """A tracker of one's own: normalised gradient steps with bounded errors."""

    rate: float = 0.1
    covariance = False

    def state(self, n):
        return {"theta": np.zeros(n), "rate": self.rate, "r": 1.0, "leaks": 0, "turns": 0}

    @property
    def steps(self):
        return TrackerSteps(still, still, descend, unknown_variance, still)


@kernel
def follow(s, l):
    μ = s.θ[l] * s.float[l]
    for i in range(s.phi.shape[0]):
        s.theta[i, l] += s.ok[l] * μ * s.phi[i, l] * s.y[l]
    s.y_hat[l], s.e[l], s.s[l] = μ, s.y[l] - μ, 1.0
    s.float[l] *= 0.5


@dataclass(frozen=True)
class Letters(Tracker):
    """Names that Python knows and C does not; */ int evil; /*"""

    covariance = False

    def state(self, n):
        return {"theta": np.zeros(n), "θ": 0.5, "float": 0.25}

    @property
    def steps(self):
        return TrackerSteps(still, still, follow, unknown_variance, still)


@needs_gcc
def test_names_that_c_does_not_know_are_written_in_its_letters(tmp_path):
    agree(tmp_path, Regression(1), Letters(), 200)
    assert (tmp_path / "tracker.c").read_text().isascii()


@needs_gcc
def test_a_tracker_of_ones_own_is_exported_like_any_other(tmp_path):
    live, ours = agree(tmp_path, ARX(2, 2), Descent(rate=0.1), 1_000)
    assert "r" not in [name for name in re.findall(r"tracker_real (\w+);", (tmp_path / "tracker.h").read_text())]
    live.lane()["noise"][...] = 4.0
    ctypes.memmove(ours.buffer, to_struct(live), ours.size)
    assert bits(live.update(0.5, 0.3)) == bits(ours.update(0.5, [0.3]))
    assert same_numbers(ours.state, to_struct(live))


@kernel
def correct(s, l):
    s.y_hat[l] = s.phi[0, l] * s.theta[0, l]
    s.e[l] = s.y[l] - s.y_hat[l]
    s.s[l] = 1.0
    s.theta[0, l] += s.ok[l] * 0.1 * np.tanh(s.e[l]) * s.phi[0, l]


@kernel
def predict(s, l):
    s.var[0, l] = 1.0


@dataclass(frozen=True)
class Odd(Tracker):
    """A tracker of one's own that calls what C has no bits for."""

    def state(self, n):
        return {"theta": np.zeros(n)}

    @property
    def steps(self):
        return TrackerSteps(predict, still, correct, predict, still)


def test_what_c_has_no_bits_for_is_refused(tmp_path):
    with pytest.raises(TranslationError, match=r"correct: no translation of `np.tanh"):
        export_c(Regression(1), Odd(), tmp_path)
    assert not list(tmp_path.iterdir())

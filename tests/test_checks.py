"""The shipped contract: it passes the trackers of the house and names what others break."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from support import rows_of

from driftfit import ARX, Kalman, Live, track
from driftfit.checks import check_tracker
from driftfit.engine.drivers import TrackerSteps, nothing_extra, unknown
from driftfit.engine.kernel import kernel, nothing
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.covariance import prediction
from driftfit.trackers.kalman import INDEPENDENT


def steps(predict, correct) -> TrackerSteps:
    return TrackerSteps(predict, nothing, correct, unknown, nothing)


@kernel
def follow(s, l):
    """Normalised LMS."""
    s.y_hat[l] = prediction(s, l)
    s.e[l] = s.y[l] - s.y_hat[l]
    s.s[l] = np.nan
    power = 0.0
    for i in range(s.theta.shape[0]):
        power += s.phi[i, l] * s.phi[i, l]
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += s.ok[l] * s.gain[l] * s.phi[i, l] * s.e[l] / (1.0 + power)


@kernel
def fade(s, l):
    """Forgets theta, whether time passes or not."""
    for i in range(s.theta.shape[0]):
        s.theta[i, l] *= 0.999


@kernel
def always(s, l):
    """Learns from every sample, also from those that must not be used."""
    s.ok[l] = 1.0
    follow(s, l)


@kernel
def careless(s, l):
    """Looks at lane 0 for the size of the regressor, and does not ask whether the sample is to be used."""
    s.y_hat[l] = prediction(s, l)
    s.e[l] = s.y[l] - s.y_hat[l]
    s.s[l] = np.nan
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += s.gain[l] * s.phi[i, l] * s.e[l] / (1.0 + s.phi[0, 0] * s.phi[0, 0])


@kernel
def bold(s, l):
    """Projects with no regularisation."""
    s.y_hat[l] = prediction(s, l)
    s.e[l] = s.y[l] - s.y_hat[l]
    s.s[l] = np.nan
    s.theta[0, l] += s.ok[l] * s.e[l] / s.phi[0, l]


@kernel
def hindsight(s, l):
    """Reports what it knows after the output was observed."""
    follow(s, l)
    s.y_hat[l] = prediction(s, l)


@dataclass(frozen=True)
class NLMS(Tracker):
    """Normalised least mean squares."""

    gain: float = 0.5
    covariance: ClassVar[bool] = False
    kind: ClassVar[TrackerSteps] = steps(nothing, follow)

    def state(self, n: int) -> Mapping[str, Any]:
        return {"theta": np.zeros(n), "gain": self.gain}

    @property
    def steps(self) -> TrackerSteps:
        return self.kind


def with_steps(*of: Any) -> NLMS:
    return type("NLMS", (NLMS,), {"kind": steps(*of)})()


class Boastful(NLMS):
    covariance = True
    kind = TrackerSteps(nothing, nothing, follow, variance=nothing)


class Deaf(Kalman):
    """Declares a drift for each parameter and ignores it."""

    @property
    def steps(self) -> TrackerSteps:
        return INDEPENDENT._replace(read_extra=nothing_extra)


@dataclass
class Loose(Tracker):
    gain: Any = 0.5
    covariance: ClassVar[bool] = False

    def __hash__(self) -> int:
        return 0

    def state(self, n: int) -> Mapping[str, Any]:
        return {"theta": np.zeros(n), "gain": self.gain}

    @property
    def steps(self) -> TrackerSteps:
        return NLMS.kind


def test_a_tracker_that_keeps_its_promises():
    """Those of the library are checked in `tests/contract/test_shipped_checks.py`."""
    assert check_tracker(NLMS(), ARX(1, 1)) == []


@pytest.mark.parametrize(
    ("tracker", "result"),
    [
        (with_steps(nothing, always), ["must be a factor of the gain", "no time passes and no sample is used"]),
        (with_steps(nothing, careless), ["index every field with [..., l]", "must be a factor of the gain"]),
        (with_steps(nothing, bold), ["make theta not finite"]),
        (
            with_steps(fade, hindsight),
            ["depends on that output", "s.e is not", "with s.dt[l] = 0 predict must change nothing"],
        ),
        (Boastful(), ["It does not run"]),
        (Deaf(q=1e-4, r=0.01), ["drift_per_parameter = True"]),
        (Loose(), ["frozen=True"]),
        (NLMS(gain=0.0), ["does not follow a constant system"]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_broken_promises_are_reported(tracker, result):
    sentences = check_tracker(tracker)
    for words in result:
        assert any(words in sentence for sentence in sentences), sentences


def test_a_tracker_from_any_module_passes_everywhere(tmp_path):
    rng = np.random.default_rng(0)
    u = rng.normal(size=(12, 100))
    y = np.concatenate([np.zeros((12, 1)), u[:, :-1]], axis=1) + 0.1 * rng.normal(size=(12, 100))
    fleet = track(ARX(1, 1), NLMS(), y, u, by="row")
    run = track(ARX(1, 1), NLMS(), y[3], u[3])
    assert np.array_equal(fleet[3].theta, run.theta)
    assert "NLMS()" in str(run.summary())
    away = np.array([np.abs(fleet[k].theta[33:] - fleet[k].theta[33]).max(axis=0) for k in range(12)])
    share = away / np.median(away, axis=0)  # without a covariance a series is compared with the others
    printed = rows_of(fleet.summary())
    for k in np.argsort(-share.max(axis=1))[:5]:
        moved = fleet[k].names[share[k].argmax()]
        assert [str(k), moved, f"{share[k].max():.1f}"] in [line[:3] for line in printed]
    run.plot()
    fleet.plot()
    live = Live(ARX(1, 1), NLMS())
    live.update(1.0, 1.0)
    live.save(tmp_path / "state.npz")
    assert Live.load(tmp_path / "state.npz", classes=[NLMS]).tracker == NLMS()

"""Smoothing given events, and segments."""

import contextlib

import numpy as np
import pytest
from test_bank import N, R, changes, record

from driftfit import AdaptiveKalman, Bank, Kalman, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.results.smoothed import problem_of
from driftfit.bank.sensor import Sensor
from driftfit.smooth import mixture
from driftfit.smooth.piecewise import piecewise

KNOWN = [Sensor.nominal(R)]
Y, U = record(120, 5, (40, 90))


def test_events_say_what_moved_and_how_far():
    run = track(Regression(N), Bank(changes(), KNOWN, p0=2.0), Y, U)
    segments = piecewise(run)
    events = run.hypotheses.events()
    assert events == run.changes()
    assert segments.bounds.tolist() == [0, *(event.date for event in events), 120]
    smoothed = run.smooth()
    for k, event in enumerate(events):
        p = smoothed.change_prob[event.first : event.last + 1, 1:].sum(axis=1)
        assert event.prob + 0.02 > p.sum() > 0.95 * event.prob - 1e-12  # more than one jump has some probability
        assert p.argmax() == event.date - event.first
        mean = p @ smoothed.shift[event.first : event.last + 1] / min(p.sum(), 1.0)
        assert list(event.shift.values()) == pytest.approx(mean, abs=1e-9)
        # constants on both sides know theta slightly better than paths that drift
        sides = (slice(*segments.bounds[i : i + 2]) for i in (k, k + 1))
        constant = np.sqrt(np.diag(sum(R * np.linalg.inv(U[part].T @ U[part]) for part in sides)))
        assert (np.abs(segments.theta[k + 1] - segments.theta[k] - mean) < 2.0 * constant).all()
    with pytest.raises(ValueError, match="has no hypotheses"):
        track(Regression(N), Kalman(0.01, R), Y, U).changes()


@pytest.mark.parametrize("excited", [True, False])
def test_changes_of_the_default_have_dates_names_and_sizes(excited):
    """Of a parameter whose regressor is always 0 nothing is known, so it did not move."""
    rng = np.random.default_rng(3)
    u, theta = rng.standard_normal((400, N)) * [1.0, excited], np.ones((400, N))
    theta[200:, 0] += 1.0
    theta[300:] -= 0.6
    with contextlib.nullcontext() if excited else pytest.warns(UserWarning, match="theta2 could not"):
        run = track(Regression(N), AdaptiveKalman(), (u * theta).sum(axis=1) + 0.3 * rng.standard_normal(400), u)
    first, second = run.changes()
    assert (first.name, second.name) == ("theta1", "all" if excited else "theta1")
    for event, date, moved in ((first, 200, [1.0, 0.0]), (second, 300, [-0.6, -0.6 * excited])):
        assert 0.8 < event.prob <= 1.0
        assert event.first <= date <= event.last < event.first + 12
        shift, std = (np.array([*values.values()]) for values in (event.shift, event.std))
        assert (np.abs(shift - moved) <= 3.0 * std).all()
        assert std.max() < 0.3


def test_segments_are_the_limit_of_large_jumps():
    bank = Bank([Change(0.0), Change(1e4, prob=0.01)], KNOWN, p0=1e6)
    run = track(Regression(N), bank, Y, U)
    breaks = [40, 90]
    kinds = np.isin(np.arange(120), breaks).astype(int)
    segments = piecewise(run, breaks)
    np.testing.assert_allclose(mixture.smooth(problem_of(run, [], kinds)).theta, segments.path, atol=1e-5)
    assert segments.table().height == 3
    for i, axis in enumerate(segments.plot().axes):
        tracked, *lines = (line.get_ydata() for line in axis.lines)
        assert (tracked == run.theta[:, i]).all()
        assert [line[0] for line in lines] == segments.theta[:, i].tolist()
    assert i == N - 1
    with pytest.raises(ValueError, match="within 1"):
        piecewise(run, [0])


@pytest.mark.parametrize(("walk", "unit"), [((0.05, 0.05), 1.0), ((0.2, 0.2), 1000.0), ((0.05, 0.0), 1.0)])
def test_bands_of_the_smoothed_path_hold_where_parameters_walk(walk, unit):
    """Random walks in noise 0.5: between events `Bank()` has next to no drift, and covered a quarter. The changes that
    it finds in a walk are none; with them, and one factor for all parameters, four fifths were covered."""
    covered, kept = [], 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((400, N))
        theta = 1.0 + np.cumsum(walk * rng.standard_normal((400, N)), axis=0)
        y = unit * ((u * theta).sum(axis=1) + 0.5 * rng.standard_normal(400))
        hypotheses = track(Regression(N), Bank(), y, u).hypotheses
        smoothed = hypotheses.smoothed
        low, high = smoothed.band(0.95)
        covered.append(((low < unit * theta) & (unit * theta < high))[20:].mean(axis=0))
        kept += len(hypotheses.changes())
    walks = np.array(walk) > 0.0
    assert 0.92 < np.mean(covered, axis=0)[walks].mean() < 0.98
    assert (np.mean(covered, axis=0)[~walks] > 0.93).all()
    assert kept <= 6


@pytest.mark.parametrize("walk", [0.02, 0.05])
def test_bands_of_a_short_record_hold_too(walk):
    """150 samples hardly tell a small drift from none. A prior that prefers large drifts covered .93 of the path, and
    its error for constants was an eighth larger."""
    covered = []
    for seed in range(24):
        rng = np.random.default_rng([seed, 150])
        u = rng.standard_normal((150, N))
        theta = rng.standard_normal(N) + np.cumsum(walk * rng.standard_normal((150, N)), axis=0)
        y = (u * theta).sum(axis=1) + 0.5 * rng.standard_normal(150)
        low, high = track(Regression(N), Bank(), y, u).smooth().band(0.95)
        covered.append(((low < theta) & (theta < high)).mean())
    assert 0.84 < np.mean(covered) < 0.975


def test_a_jump_amid_a_walk_is_kept():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((400, N))
        theta = np.cumsum(0.05 * rng.standard_normal((400, N)), axis=0)
        theta[200:] += 2.0
        y = (u * theta).sum(axis=1) + 0.5 * rng.standard_normal(400)
        changes = track(Regression(N), Bank(), y, u).changes()
        (event,) = (event for event in changes if abs(event.span.date - 200) <= 2)
        shift, std = (np.array([*values.values()]) for values in (event.shift, event.std))
        assert np.abs(shift - 2.0).max() < 3.5 * std.max() < 2.0


def test_a_drift_that_was_given_is_kept():
    run = track(Regression(N), Bank(changes(), KNOWN, p0=2.0), Y, U)
    smoothed = run.smooth()
    assert smoothed.r == R
    steady = track(Regression(N), Bank(), *record(300, 5, (100, 200))).hypotheses
    assert steady.smoothed.r == pytest.approx(R, rel=0.25)
    assert len(steady.changes()) == 2

"""Runs of 100,000 steps and more: drift, an unstable system, a term that appears, coverage, no excitation."""

import sys

import numpy as np
import pytest
from contract_table import SLOW, as_arx, model_of, ready
from support import THETA, arx_record

from driftfit import ARX, RLS, AugmentedFLS, InstrumentalVariables, Kalman, OutputError, Regression, track
from driftfit.run.program import Program
from driftfit.run.result import root_mean_square
from driftfit.trackers import found

LONG = 100_000
TRACKERS = [pytest.param(ready(kind, SLOW), id=name) for name, kind in found().items()]


def drifting(T):
    """Parameters that turn slowly, (T, 4)."""
    phase = 2.0 * np.pi * np.arange(T) / 20_000
    return THETA + np.stack([0.2 * np.sin(phase), -0.2 * np.sin(phase), 0.5 * np.cos(phase), 0.3 * np.sin(phase)], 1)


@pytest.mark.parametrize("tracker", TRACKERS)
def test_a_drifting_system_is_followed_to_the_end(tracker):
    path = drifting(LONG)
    y, u = arx_record(LONG, 1, theta=path)
    run = track(model_of(tracker, ARX(2, 2)), tracker, y, u)
    theta = as_arx(tracker, run.theta)
    steady = track(ARX(2, 2), RLS(1.0), y, u)
    for part in (slice(1000, 50_000), slice(50_000, LONG)):
        error = root_mean_square(theta[part] - path[part])
        assert error < 0.023
        assert error < 0.09 * root_mean_square(steady.theta[part] - path[part])
        assert root_mean_square(run.innovation[part]) < 1.25 * 0.1
    first, last = (root_mean_square(run.innovation[part]) for part in (slice(1000, 21_000), slice(80_000, LONG)))
    assert last == pytest.approx(first, rel=0.02)  # as good at the end as at the start


def unstable_in_closed_loop(T, seed):
    """y_t = 1.1 y_(t-1) + u_(t-1) + v with u = -0.6 y + dither: the loop is stable, the system is not."""
    rng = np.random.default_rng(seed)
    v, dither = 0.1 * rng.standard_normal(T), 0.5 * rng.standard_normal(T)
    y, u = np.zeros(T), np.zeros(T)
    for t in range(T):
        y[t] = (1.1 * y[t - 1] + u[t - 1] if t else 0.0) + v[t]
        u[t] = -0.6 * y[t] + dither[t]
    return y, u


IN_CLOSED_LOOP = {InstrumentalVariables: (30.0, 0.03, 0.3), OutputError: (10.0, 0.012, 0.15)}
"""Largest prediction, error of the mean and RMS innovation of what assumes an open loop: under feedback instruments and
simulated outputs are correlated with the noise, and such an estimate wanders, but does not run away."""


@pytest.mark.parametrize("tracker", TRACKERS)
def test_an_unstable_system_with_bounded_output(tracker):
    """Filled lags of an unstable estimate must not run away: outages are cut after na outputs."""
    y, u = unstable_in_closed_loop(LONG, 2)
    y[np.random.default_rng(3).random(LONG) < 0.05] = np.nan
    for start in range(10_000, LONG, 10_000):
        y[start : start + 300] = np.nan
    run = track(model_of(tracker, ARX(1, 1)), tracker, y, u)
    theta = as_arx(tracker, run.theta, 1, 1)
    assert np.isfinite(theta).all()
    largest, off, error = IN_CLOSED_LOOP.get(type(tracker), (6.0, 0.005, 0.11))
    assert np.nanmax(np.abs(run.prediction)) < largest
    np.testing.assert_allclose(theta[LONG // 2 :].mean(axis=0), [1.1, 1.0], atol=off)
    assert root_mean_square(run.innovation[run.ok][1000:]) < error


def impulse(theta):
    """The first responses of y to u, for mean parameters (4,)."""
    a1, a2, b1, b2 = theta
    y = [b1, a1 * b1 + b2]
    for _ in range(6):
        y.append(a1 * y[-1] + a2 * y[-2])
    return np.array(y)


def second_order(theta):
    """h1 h3 - h2^2 of the responses: 0 for a system of first order, however it is written, with (.., 4) parameters."""
    a1, a2, b1, b2 = np.moveaxis(theta, -1, 0)
    h2 = a1 * b1 + b2
    return b1 * (a1 * h2 + a2 * b1) - h2**2


def told_apart(tracker, run, at):
    """Where the 95 % band of `second_order` does not hold 0, from theta and its covariance."""
    theta, cov, step = run.theta[at], run.written("P")[at], 1e-6

    def value(theta):
        return second_order(as_arx(tracker, theta))

    ways = step * np.eye(theta.shape[1])
    slope = np.stack([(value(theta + way) - value(theta - way)) / (2.0 * step) for way in ways], axis=1)
    return np.abs(value(theta)) > 1.96 * np.sqrt(np.einsum("ti,tij,tj->t", slope, cov, slope))


@pytest.mark.parametrize("tracker", TRACKERS)
def test_a_structure_that_changes_half_way(tracker):
    """The second lags appear at half time: their parameters are 0 before and what they became after.

    What is compared is the response, and whether it needs a second order: a pole that a zero cancels is as good as
    none, and a filter of the output error cannot tell the two.
    """
    half = LONG // 2
    path = np.where(np.arange(LONG)[:, None] < half, [0.7, 0.0, 1.0, 0.0], THETA)
    y, u = arx_record(LONG, 4, theta=path)
    run = track(model_of(tracker, ARX(2, 2)), tracker, y, u, keep="cov" if tracker.covariance else "std")
    theta = as_arx(tracker, run.theta)
    np.testing.assert_allclose(impulse(theta[half - 20000 : half].mean(axis=0)), impulse(path[0]), atol=0.005)
    np.testing.assert_allclose(impulse(theta[half + 1000 : half + 3000].mean(axis=0)), impulse(THETA), atol=0.007)
    np.testing.assert_allclose(impulse(theta[-2000:].mean(axis=0)), impulse(THETA), atol=0.015)
    if tracker.covariance:  # the order is distinguished from 1 only where it is 2
        assert told_apart(tracker, run, slice(1000, half, 50)).mean() < 0.02
        assert told_apart(tracker, run, slice(half + 1000, None, 50)).mean() > 0.99


def random_walk(T, seed, q, r, n=1):
    """y, u, theta of a regression whose parameters really are a random walk."""
    rng = np.random.default_rng(seed)
    theta = np.cumsum(np.sqrt(q) * rng.standard_normal((T, n)), axis=0)
    u = rng.standard_normal((T, n))
    return (u * theta).sum(axis=1) + np.sqrt(r) * rng.standard_normal(T), u, theta


@pytest.mark.parametrize(("q", "r"), [(1e-3, 0.1), (0.1, 0.1), (1e-5, 1.0)])
def test_bands_cover_what_they_say(q, r):
    y, u, theta = random_walk(LONG, 5, q, r)
    run = track(Regression(1), Kalman(q=q, r=r), y, u)
    for level, least, most in ((0.95, 0.93, 0.97), (0.5, 0.46, 0.54)):
        low, high = run.band(level)
        inside = (low < theta) & (theta < high)
        assert least < inside[100:].mean() < most
    score = run.innovation[100:] / run.innovation_std[100:]
    assert score.var() == pytest.approx(1.0, abs=0.02)
    assert np.mean(score[1:] * score[:-1]) == pytest.approx(0.0, abs=0.015)


def test_bands_cover_through_gaps_and_missing_data():
    """Interval, weight and drift factor enter the band as they enter the truth."""
    rng = np.random.default_rng(6)
    T, q, r = LONG, 1e-3, 0.1
    dt = rng.choice([1.0, 0.5, 4.0], T)
    dt[0] = 1.0
    drift, weights = rng.choice([1.0, 0.0, 5.0], T), rng.choice([1.0, 4.0, 0.25], T)
    theta = np.cumsum(np.sqrt(q * dt * drift) * rng.standard_normal(T))
    u = rng.standard_normal(T)
    y = u * theta + np.sqrt(r / weights) * rng.standard_normal(T)
    y[rng.random(T) < 0.3] = np.nan
    run = track(Regression(1), Kalman(q=q, r=r), y, u, time=np.cumsum(dt), weights=weights, drift=drift)
    low, high = run.band()
    inside = (low[:, 0] < theta) & (theta < high[:, 0])
    assert 0.93 < inside[100:].mean() < 0.97
    assert 0.93 < inside[100:][~run.ok[100:]].mean() < 0.97


def test_bands_of_least_squares_cover():
    """RLS(1) estimates the noise as it goes; over many short records its final band covers."""
    rng = np.random.default_rng(7)
    hits = []
    for _ in range(1500):
        u = rng.standard_normal(60)
        y = 2.0 * u + 0.7 * rng.standard_normal(60)
        low, high = track(Regression(1), RLS(1.0), y, u).band()
        hits.append(low[-1, 0] < 2.0 < high[-1, 0])
    assert 0.93 < np.mean(hits) < 0.97


def test_forgetting_keeps_its_memory_over_a_long_run():
    """The variance of a constant regression under forgetting is r (1 - lam) / (1 + lam), at 1e3 and at 1e5 alike."""
    rng = np.random.default_rng(9)
    y = 3.0 + rng.standard_normal(LONG)
    lam = 0.95
    theta = track(Regression(1), RLS(lam), y, np.ones(LONG)).theta[:, 0]
    for part in (slice(500, 50_000), slice(50_000, LONG)):
        assert theta[part].var() == pytest.approx((1.0 - lam) / (1.0 + lam), rel=0.08)
        assert theta[part].mean() == pytest.approx(3.0, abs=0.02)


def test_augmented_fls_has_a_floor_that_does_not_drift():
    y, u = arx_record(LONG, 10)
    run = track(ARX(2, 2), AugmentedFLS(5.0), y, u)
    early, late = (root_mean_square(run.theta[part] - THETA) for part in (slice(1000, 50_000), slice(50_000, LONG)))
    assert 0.02 < late < 0.03
    assert late == pytest.approx(early, rel=0.05)


@pytest.mark.parametrize(("cost", "longest", "fewest"), [(5e-4, 0.6, 10), (1e-7, 0.6, 1)])
def test_records_run_in_parts_between_which_ctrl_c_is_heard(monkeypatch, cost, longest, fewest):
    """A million samples were one call, which takes minutes with a slow tracker."""
    clock, spent, fill = [0.0], [], Program.fill

    def slow(self, tile, y, *rest):
        fill(self, tile, y, *rest)
        spent.append(cost * len(y))
        clock[0] += spent[-1]

    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(2, 20_000))
    whole = track(ARX(1, 1), Kalman(q=1e-4, r=0.1), y, u)
    monkeypatch.setattr(Program, "fill", slow)
    monkeypatch.setattr(sys.modules[Program.__module__], "perf_counter", lambda: clock[0])
    run = track(ARX(1, 1), Kalman(q=1e-4, r=0.1), y, u)
    assert np.array_equal(run.theta, whole.theta)
    assert max(spent) < longest
    assert fewest <= len(spent) < 0.2 / cost + 10  # and the parts of a quick tracker are long

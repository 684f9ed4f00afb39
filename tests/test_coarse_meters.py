"""Coarse meters: a record of few values has a resolution, and bands and comparisons allow for the error of rounding."""

import numpy as np
import pytest

from driftfit import FLS, RLS, AdaptiveKalman, Bank, Regression, select, track, tune

T = 1500
MODEL = Regression(3)


def meter(seed, unit=1.0):
    """Whole numbers; the inputs change every 30 samples."""
    rng = np.random.default_rng(seed)
    held = np.repeat(rng.normal(size=(T // 30, 2)), 30, axis=0)
    u = np.column_stack([held, np.ones(T)])
    return np.round(u @ [2.0, -1.0, 32.0] + 0.05 * rng.normal(size=T)) * unit, u


@pytest.mark.parametrize("tracker", [AdaptiveKalman(), RLS(0.99), FLS(1e3), Bank()], ids=lambda one: type(one).__name__)
def test_coarse_readings_bound_the_noise(tracker):
    y, u = meter(5)
    run = track(MODEL, tracker, y, u, gate=True)
    assert run.innovation_std[300:].min() >= 1.0 / np.sqrt(12.0)
    assert np.median(run.innovation_std[300:]) < 0.6
    assert -0.5 * T < run.loglik < 0.5 * T
    assert np.mean(np.abs(run.innovation[300:]) < 1.96 * run.innovation_std[300:]) > 0.93
    assert "steps of 1" in str(run.summary())
    for unit in (2.0**-30, 2.0**30):
        scaled = track(MODEL, tracker, y * unit, u, gate=True)
        np.testing.assert_allclose(scaled.innovation_std[300:] / unit, run.innovation_std[300:], rtol=1e-6)


@pytest.mark.parametrize("tracker", [AdaptiveKalman(), RLS(0.99), FLS(1e3), Bank()], ids=lambda one: type(one).__name__)
def test_bands_of_coarse_meters_have_the_unit_of_the_readings_before_their_step_is_known(tracker):
    rng = np.random.default_rng(5)
    u = np.column_stack([rng.normal(size=(200, 2)), np.ones(200)])
    y = np.round(u @ [1.0, 3.0, 5.0] + 0.1 * rng.normal(size=200))
    run = track(MODEL, tracker, y, u, gate=True)
    assert run.state["floor"] > 0.0
    for unit in (2.0**-20, 2.0**10):
        np.testing.assert_allclose(
            track(MODEL, tracker, y * unit, u, gate=True).std[20:] / unit, run.std[20:], rtol=1e-6
        )


def test_bands_of_theta_hold_for_a_coarse_meter():
    covered = []
    for seed in range(6):
        y, u = meter(seed)
        run = track(MODEL, AdaptiveKalman(), y, u)
        covered.append(np.mean(np.abs(run.theta - [2.0, -1.0, 32.0])[400:] < 1.96 * run.std[400:]))
    assert np.mean(covered) > 0.93


def test_readings_that_are_fine_have_no_resolution():
    rng = np.random.default_rng(6)
    u = rng.normal(size=(T, 3))
    fine = u @ [1.0, 0.5, -1.0] + 0.1 * rng.normal(size=T)
    held = np.repeat(fine[::5], 5)
    off = np.where(np.arange(T) // 100 % 2 == 0, 0.0, fine)
    for y in (fine, held, off, np.clip(fine, -1.0, 1.0)):
        run = track(MODEL, RLS(0.99), y, u, gate=True)
        assert run.state["floor"] == 0.0
    assert "Resolution" not in str(run.summary())


@pytest.mark.parametrize("tracker", [AdaptiveKalman(), Bank()], ids=lambda one: type(one).__name__)
def test_equal_rows_at_the_start_claim_nothing(tracker):
    y, u = meter(7)
    y[:30], u[:30] = 32.0, [1.0, 0.0, 1.0]
    run = track(MODEL, tracker, y, u, gate=True)
    assert not (run.innovation_std[:200] < 1e-3).any()
    assert not (run.std[:200] < 1e-3).any()


def test_structures_and_settings_are_compared_on_coarse_readings():
    y, u = meter(8)
    wide = u[:, :2]
    chosen = select([Regression(2, intercept=True), Regression(2)], y, wide)
    assert all(abs(row.loglik) < 100.0 * T for row in chosen.rows)
    assert chosen.model() == Regression(2, intercept=True)
    tuned = tune(MODEL, FLS(), y, u, bounds=(1.0, 1e6))
    assert np.isfinite(tuned.loglik)
    assert track(MODEL, tuned.tracker, y, u, gate=True).innovation_std[-1] > 0.25


def coarse_record(seed, quantum, held):
    """One parameter, the exact value of a constant, and readings of a coarse meter in noise of 0.3."""
    rng = np.random.default_rng(seed)
    x = np.ones(400) if held == 400 else 1.0 + 0.5 * np.repeat(rng.normal(size=400 // held), held)
    theta = 5.0 * rng.random()
    return quantum * np.round((theta * x + 0.3 * rng.normal(size=400)) / quantum), x, theta


@pytest.mark.parametrize(
    ("quantum", "held", "fewest"),
    [(1.0, 400, 38), (1.0, 20, 38), (2.0, 20, 38), (2.0, 1, 38), (5.0, 1, 20)],
)
def test_bands_of_coarse_meters_do_not_count_one_error_of_rounding_as_many(quantum, held, fewest):
    """The variance of what readings share does not shrink with their number; without it 0.3 to 0.9 of them cover.

    With the last quantum readings alternate between two values, and their variance says nothing about the noise.
    """
    inside = []
    for seed in range(40):
        y, x, theta = coarse_record(seed, quantum, held)
        run = track(Regression(1), AdaptiveKalman(), y, x)
        if np.isfinite(run.std[-1, 0]):
            inside.append(abs(run.theta[-1, 0] - theta) <= 1.96 * run.std[-1, 0])
    assert len(inside) >= fewest
    assert np.mean(inside) >= 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / len(inside))


def test_a_bank_counts_one_error_of_rounding_once_as_well():
    x, inside, errors = 3.0 * np.sin(np.arange(1000) / 60.0), [], []
    for seed in range(6):
        y = np.round(3.0 + 1.5 * x + 0.05 * np.random.default_rng(seed).normal(size=1000))
        run = track(Regression(1, intercept=True), Bank(), y, x)
        away = np.abs(run.theta - [1.5, 3.0])[100:]
        inside.append(np.mean(away <= 1.96 * run.std[100:]))
        errors.append(np.mean(away**2))
    assert np.mean(inside) > 0.93  # as many readings of their own: 0.70
    assert np.sqrt(np.mean(errors)) < 0.2  # 1.15


def test_equal_steps_that_an_input_explains_are_no_rounding():
    """Machines of 75 kW that are switched one by one, on a meter that reads exactly 0 when none runs."""
    rng = np.random.default_rng(0)
    running = np.zeros(600)
    for t in range(1, 600):
        running[t] = np.clip(running[t - 1] + rng.choice([-1.0, 1.0]), 0.0, 3.0)
    power = np.where(running > 0.0, 75.0 * running + 0.3 * rng.normal(size=600), 0.0)
    run = track(Regression(1), AdaptiveKalman(), power, running)
    assert run.std[-1, 0] < 2.0  # it may have jumped while none runs
    assert np.abs(run.theta[50:, 0] - 75.0).max() < 0.1

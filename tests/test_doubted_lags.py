"""Outliers in output lags: those of the sensor are cleaned, those of the plant are not, and later samples decide."""

import numpy as np
import pytest

from driftfit import ARX, AdaptiveKalman, Live, track

T, NOISE, THETA = 1000, 0.3, (1.2, -0.5, 1.0, 0.5)
MODEL = ARX(2, 2)


def record(kind, seed, ny=1):
    """y (T, ny) of a plant with outliers of 3 to 9 standard deviations, u (T,), and what y was expected to be."""
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=T), NOISE * rng.normal(size=(T, ny))
    spikes = NOISE * rng.uniform(3.0, 9.0, (T, ny)) * rng.choice([-1, 1], (T, ny)) * (rng.random((T, ny)) < 0.03)
    x, expected = np.zeros((T, ny)), np.zeros((T, ny))
    v += spikes * (kind == "plant")
    for t in range(2, T):
        expected[t] = np.stack([x[t - 1], x[t - 2], np.full(ny, u[t - 1]), np.full(ny, u[t - 2])], axis=1) @ THETA
        x[t] = expected[t] + v[t]
    return x + spikes * (kind == "sensor"), u, expected, spikes


def errors(kind):
    theta, ahead, inside = [], [], []
    for seed in range(6):
        y, u, expected, _ = record(kind, seed)
        run = track(MODEL, AdaptiveKalman(), y[:, 0], u)
        theta.append((run.theta - THETA)[100:])
        ahead.append((run.prediction - expected[:, 0])[100:])
        inside.append(np.abs(theta[-1]) < 1.96 * run.std[100:])
    return *(float(np.sqrt(np.mean(np.square(one)))) for one in (theta, ahead)), float(np.mean(inside))


@pytest.mark.parametrize(
    ("kind", "most"), [("sensor", (0.035, 0.25)), ("plant", (0.025, 0.07)), ("none", (0.021, 0.043))]
)
def test_outliers_of_the_sensor_are_cleaned_in_the_lags_and_those_of_the_plant_are_not(kind, most):
    theta, ahead, inside = errors(kind)
    assert theta < most[0]  # raw lags: 0.08 after outliers of the sensor
    assert ahead < most[1]  # raw lags: 0.45
    assert inside > 0.95


@pytest.mark.parametrize(("kind", "low", "high"), [("sensor", 0.7, 1.0), ("plant", 0.0, 0.2)])
def test_which_kind_of_outlier_a_record_has_is_learned(kind, low, high):
    y, u, *_ = record(kind, 3)
    state = track(MODEL, AdaptiveKalman(), y[:, 0], u).state
    assert low < state["false_share"][0] < high


def test_the_next_sample_decides():
    """Before it no reading is certain to be wrong; after it half of the large outliers are, and no ordinary reading."""
    before, after, ordinary = [], [], []
    for seed in (0, 1):
        y, u, _, spikes = record("sensor", seed)

        def doubts(t, y=y, u=u):
            """Of the reading at t, at that sample and at the next one."""
            at, later = (track(MODEL, AdaptiveKalman(), y[:stop, 0], u[:stop]).state for stop in (t + 1, t + 2))
            return at["doubt"][0, 0], later["doubt"][0, 1]

        large = [doubts(t) for t in np.flatnonzero(np.abs(spikes[:, 0]) > 5.0 * NOISE) if 100 < t < T - 2]
        usual = [doubts(t) for t in range(100, T - 2, 80) if not spikes[t - 2 : t + 3].any()]
        before, after = np.append(before, [at for at, _ in large]), np.append(after, [later for _, later in large])
        ordinary += usual
    assert len(after) >= 40
    assert len(ordinary) >= 15
    assert before.max() < 0.95
    assert (after > 0.95).mean() >= 0.5
    assert (after > before).mean() > 0.9
    assert np.max(ordinary) < 0.01


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_modes_and_units_agree_with_outliers_in_the_lags(unit):
    y, u, *_ = record("sensor", 2)
    y, plain = y[:300, 0] * unit, track(MODEL, AdaptiveKalman(), y[:300, 0], u[:300])
    run, live = track(MODEL, AdaptiveKalman(), y, u[:300]), Live(MODEL, AdaptiveKalman())
    theta = [live.update(*one) and live.theta.copy() for one in zip(y, u, strict=False)]
    np.testing.assert_array_equal(theta, run.theta)
    np.testing.assert_allclose(run.theta[50:, :2], plain.theta[50:, :2], rtol=0, atol=1e-6)
    fleet = track(MODEL, AdaptiveKalman(), np.stack([y, y]), np.stack([u[:300]] * 2)[..., None], by="row")
    np.testing.assert_array_equal(fleet[1].theta, run.theta)


def test_an_outlier_of_one_output_is_cleaned_in_the_lags_of_the_other():
    rng = np.random.default_rng(5)
    x, u = np.zeros((T, 2)), rng.normal(size=T)
    for t in range(1, T):
        x[t] = [0.6 * x[t - 1, 0] + u[t - 1], 0.4 * x[t - 1, 1] + 0.8 * x[t - 1, 0]] + 0.1 * rng.normal(size=2)
    y = x.copy()
    y[rng.random(T) < 0.04, 0] += 0.8
    run = track(ARX(1, 1, ny=2), AdaptiveKalman(), y, u)
    expected = [0.6 * x[:-1, 0] + u[:-1], 0.4 * x[:-1, 1] + 0.8 * x[:-1, 0]]
    for o in (0, 1):  # raw lags: 0.10 and 0.13
        assert np.sqrt(np.mean((run[o].prediction[1:] - expected[o])[100:] ** 2)) < 0.06


def test_a_filled_lag_adds_its_variance():
    inside = []
    for seed in range(4):
        y, u, *_ = record("none", seed)
        y[np.random.default_rng(0).random(T) < 0.15] = np.nan
        run = track(MODEL, AdaptiveKalman(), y[:, 0], u)
        z = (run.innovation[1:] / run.innovation_std[1:])[np.isnan(y[:-1, 0])]
        inside.append(np.mean(np.abs(z[20:][np.isfinite(z[20:])]) < 1.96))
    assert 0.93 < np.mean(inside) < 0.98  # 0.82 where a filled lag counts as measured

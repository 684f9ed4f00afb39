"""The verdict in any unit, under large offsets, without noise, and on readings of which most are equal."""

import numpy as np
import pytest
from scipy import signal
from test_verdict import judged, p_of, record

from driftfit import Kalman, Regression, track


@pytest.mark.parametrize("seed", [12, 24, 29])
def test_counts_of_which_nine_of_ten_are_zero_decide_nothing_and_raise_nothing(seed):
    """The scale of Huber's fit vanishes, and with it the information matrix, which could not be inverted."""
    rng, later = np.random.default_rng(seed), np.arange(400) >= 200
    phi = np.column_stack([rng.normal(size=400), np.ones(400)])
    steady, risen = (rng.poisson(rate, size=400).astype(float) for rate in (0.05, np.where(later, 0.2, 0.05)))
    for y in (steady, risen):
        found = judged(phi, y)
        assert found is None or 0.0 <= found.test.p <= 1.0
    assert judged(phi, steady) is None


@pytest.mark.parametrize("unit", [1e-12, 1e9])
def test_the_unit_of_y_changes_no_p_value(unit):
    """Noise with lags and a gain that wanders, as an instrument reads it in volts, and in nanovolts."""
    rng = np.random.default_rng(3)
    u, v = rng.normal(size=(600, 2)), np.append(0.0, signal.lfilter([1.0], [1.0, -0.5], rng.normal(size=599)))
    y = u @ [1.0, -0.5] + np.cumsum(0.02 * rng.normal(size=600)) * u[:, 0] + v + 2.0
    phi = np.column_stack([np.ones(600), u])
    one, other = judged(phi, y), judged(phi, unit * y)
    assert len(one.model.noise.lags) == len(other.model.noise.lags) > 0
    assert [other.test.p, *other.test.p_each] == pytest.approx([one.test.p, *one.test.p_each], rel=1e-8)


@pytest.mark.parametrize("slope", [0.0, 2.0])
def test_rounding_errors_are_not_compared(slope):
    """Outputs that constants explain without error, of which some predictors are wrong by 1e-16, others by 2e-16."""
    x = np.column_stack([np.ones(200), np.random.default_rng(5).normal(size=200)])
    for y in (x @ [1.0, slope], np.zeros(200)):
        result = track(Regression(2), Kalman(q=0.0, r=1.0), y, x).verdict()
        assert result.pays is False
        assert result.constants.p == 0.5
        assert "predict the output without error" in str(result)


def test_noise_far_below_an_offset_is_noise_unless_it_is_rounding():
    phi, y = record(300, 12)
    X = np.column_stack([phi, np.ones(300)])
    p = p_of(X, y)
    assert p_of(X, 1.7e9 + 0.01 * y) == pytest.approx(p, rel=0.02)
    assert judged(X, 1.7e9 + X @ np.arange(4.0)) is None


@pytest.mark.parametrize("offset", [30.0, 1e3, 1e7])
@pytest.mark.parametrize("moved", ["slope about the mean", "slope through zero", "level"])
def test_inputs_far_from_zero_do_not_hide_which_parameter_moved(moved, offset):
    """A slope through zero and the constant are then nearly collinear, and a change about the mean changes both."""
    rng = np.random.default_rng(2)
    u, later = rng.normal(size=(600, 2)), np.arange(600) >= 300
    about = u + offset if moved == "slope through zero" else u
    y = 3.0 + about @ [1.0, 0.5] + later * (0.3 if moved == "level" else about[:, 0]) + 0.3 * rng.normal(size=600)
    found = track(Regression(2, intercept=True), Kalman(q=0.0, r=0.09), y, u + offset).verdict()
    steps = {moved.name: moved.after - moved.before for moved in found.parameters if moved.moves}
    if moved == "level":
        assert list(steps) == ["intercept"]
        assert abs(steps["intercept"] - 0.3) < 0.08
        return
    assert abs(steps["theta1"] - 1.0) < 0.08
    assert ("intercept" in steps) == (moved == "slope about the mean")
    assert "theta2" not in steps


def test_a_slope_through_zero_that_comes_back_has_its_own_values():
    """About the mean of the input it would be steps of the level, with dates of their own."""
    rng = np.random.default_rng(0)
    u, t = 50.0 + rng.normal(size=1200), np.arange(1200)
    y = 5.0 + np.where((t >= 400) & (t < 800), 3.0, 2.0) * u + 0.5 * rng.normal(size=1200)
    slope = track(Regression(1, intercept=True), Kalman(q=0.0, r=0.25), y, u).verdict().parameters[0]
    assert slope.moves
    np.testing.assert_allclose([slope.before, slope.after, slope.last], [2.0, 3.0, 2.0], atol=0.05)


@pytest.mark.parametrize("kind", ["a gain drawn at every sample", "noise that grows with the input", "bursts"])
def test_residuals_that_grow_with_a_regressor_are_reported_and_are_no_drift(kind):
    """One distribution of y has both explanations, so the verdict names them; bursts of both in turn are neither."""
    named, drifts = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u, v, later = rng.normal(size=(600, 2)), rng.normal(size=600), np.arange(600)
        gain = 1.0 + (rng.choice([-0.8, 0.8], 600) if kind[0] == "a" else 0.0)
        if kind[0] == "n":
            v *= 0.5 + 0.8 * np.abs(u[:, 0])
        elif kind == "bursts":
            u, v = u * np.where(later // 130 % 2, 3.0, 1.0)[:, None], v * np.where(later // 70 % 2, 2.0, 1.0)
        found = track(Regression(2), Kalman(q=0.0, r=1.0), gain * u[:, 0] + 0.5 * u[:, 1] + v, u).verdict()
        named.append(found.spread_with)
        drifts.append(found.drifts)
        assert ("from sample to sample" in " ".join(found.sentences)) == bool(found.spread_with)
    assert sum(drifts) <= 2
    assert named.count(()) == 8 if kind == "bursts" else named.count(("theta1",)) >= 8 - sum(drifts)

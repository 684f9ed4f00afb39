"""Coloured noise in `AdaptiveKalman`: the previous innovation explains the next output."""

import numpy as np
import pytest

from driftfit import ARX, AdaptiveKalman, Live, Regression, track
from driftfit.systems.arc_furnace import switching

MODEL, NOISE, T = ARX(2, 2), 0.3, 1200


def record(c, seed, drift=0.02):
    """ARMAX: v_t + c v_(t-1) drives the plant, and its gains walk."""
    rng = np.random.default_rng(seed)
    u, v, y = rng.normal(size=T), NOISE * rng.normal(size=T), np.zeros(T)
    theta = np.array([1.1, -0.5, 1.0, 0.5]) + np.cumsum(rng.normal(size=(T, 4)) * [0.0, 0.0, drift, drift], axis=0)
    for t in range(2, T):
        y[t] = theta[t] @ [y[t - 1], y[t - 2], u[t - 1], u[t - 2]] + v[t] + c * v[t - 1]
    return y, u, theta


@pytest.mark.parametrize(("c", "bias"), [(0.7, 0.03), (-0.6, 0.05)])
def test_lags_are_not_biased_and_bands_hold(c, bias):
    error, inside, smoothed, found = [], [], [], []
    for seed in range(6):
        y, u, theta = record(c, seed)
        run = track(MODEL, AdaptiveKalman(), y, u)
        late, off = slice(200, None), run.theta - theta
        error.append(off[late])
        inside.append(np.abs(off[late]) < 1.96 * run.std[late])
        smoothed.append((run.smooth().theta - theta)[late])
        found.append(run.state["colour"])
    assert np.abs(np.mean(error, axis=(0, 1))[:2]).max() < bias  # without: 0.06 and 0.12
    assert np.mean(inside) > 0.89  # without: 0.88 and 0.76
    assert np.mean(np.square(smoothed)) < np.mean(np.square(error))
    assert abs(np.mean(found) - c) < 0.15


def test_white_innovations_leave_everything_as_it_is():
    coloured = [track(MODEL, AdaptiveKalman(), *record(0.0, seed)[:2]).state["colour"] for seed in range(8)]
    assert np.max(np.abs(coloured)) < 0.1
    assert np.count_nonzero(coloured) <= 2


def test_a_stream_has_the_same_bits_with_gaps_and_outliers():
    y, u, _ = record(0.7, 1)
    y[300:306], y[500], u[700] = np.nan, 80.0, np.nan
    run, live = track(MODEL, AdaptiveKalman(), y, u), Live(MODEL, AdaptiveKalman())
    steps = np.array([live.update(y[t], u[t])[:3] for t in range(T)])
    np.testing.assert_array_equal(steps[:, 0], run.prediction)
    np.testing.assert_array_equal(steps[:, 2], run.innovation_var)
    assert abs(run.state["colour"]) > 0.4
    assert "Coloured noise" in dict(AdaptiveKalman().remarks(run))
    assert np.abs(run.innovation[501:505]).max() < 6.0 * NOISE  # the outlier is not carried into the next prediction


@pytest.mark.parametrize(("half", "unit"), [(100, 1.0), (130, 1e6)])
def test_innovations_after_a_jump_are_no_colour(half, unit):
    """Where regressors are smooth, the innovations until a jump is followed have one sign."""
    found = []
    for seed in range(6):
        rng, arc = np.random.default_rng(3 + seed), switching(seed=seed, half=half)
        run = track(
            Regression(2), AdaptiveKalman(), unit * arc.i, np.column_stack([arc.u, rng.normal(size=arc.u.size)])
        )
        found.append(np.sqrt(np.mean((((run.theta[:, 0] / unit) - arc.g) * arc.u)[200:] ** 2)))
    assert np.median(found) < 0.14  # without bounds and weights 0.36, with white innovations presumed 0.11
    assert np.max(found) < 0.26

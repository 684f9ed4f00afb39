"""Records that no setting prepares for: stuck sensors, signals far above the noise, coarse meters, strange units."""

import numpy as np
import pytest

from driftfit import ARX, FLS, RLS, AdaptiveKalman, Bank, Kalman, track

T, THETA = 500, (1.1, -0.5, 1.0, 0.5)
PLANT = ARX(2, 2)
TRACKERS = [AdaptiveKalman(), RLS(0.98), RLS(0.98, kind="directional"), FLS(1e4), Bank()]


def plant(noise=0.1, seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(2, T):
        y[t] = THETA[0] * y[t - 1] + THETA[1] * y[t - 2] + THETA[2] * u[t - 1] + THETA[3] * u[t - 2]
        y[t] += noise * rng.normal()
    return y, u


@pytest.mark.parametrize("tracker", [*TRACKERS, Kalman(q=1e-5, r=0.01)], ids=repr)
@pytest.mark.parametrize("level", [0.0, 5.0])
def test_bands_of_a_sensor_that_is_stuck_at_first_are_infinite_until_it_moves(tracker, level):
    y, u = plant()
    y[:60] = level
    run = track(PLANT, tracker, y, u)
    assert not np.isnan(run.std).any()
    assert tracker == Kalman(q=1e-5, r=0.01) or np.isinf(run.std[59]).all()
    assert np.isfinite(run.std[75:]).all()
    assert np.abs(run.theta[-1] - THETA).max() < 0.1


@pytest.mark.parametrize("tracker", TRACKERS, ids=repr)
def test_bands_are_infinite_where_parameters_are_known_and_the_noise_is_not(tracker):
    """As many samples as parameters, and then a gap."""
    y, u = plant()
    y[6:50] = np.nan
    run = track(PLANT, tracker, y, u)
    assert np.isinf(run.std[6:50]).all()
    assert np.isfinite(run.std[-1]).all()

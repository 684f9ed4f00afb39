"""More parameters than a row of P is summed in order for: the same filter, and the same bits in every mode."""

import numpy as np
import pytest

from driftfit import HammersteinWiener, Kalman, Live, Regression, track
from driftfit.models.hammerstein_wiener.curves.basis import Polynomial
from driftfit.run.parallel_lanes import FEWEST, width_of
from driftfit.run.program import MOST, Program
from driftfit.trackers.parts.covariance import NARROW

N = NARROW + 3


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(2)
    u = rng.normal(size=(90, N))
    return u @ rng.normal(size=N) + 0.1 * rng.normal(size=90), u


def test_a_wide_filter_is_the_textbook_filter(record):
    y, u = record
    run = track(Regression(N), Kalman(q=1e-3, r=0.01, p0=4.0), y, u)
    theta, P = np.zeros(N), 4.0 * np.eye(N)
    for t, phi in enumerate(u):
        P += 1e-3 * np.eye(N)
        g = P @ phi
        s = phi @ g + 0.01
        theta, P = theta + g * (y[t] - phi @ theta) / s, P - np.outer(g, g) / s
        assert run.theta[t] == pytest.approx(theta, rel=1e-8, abs=1e-8)
        assert run.std[t] == pytest.approx(np.sqrt(np.diag(P)), rel=1e-8)


def test_a_stream_of_a_wide_model_has_the_bits_of_the_record(record):
    y, u = record
    tracker = Kalman(q=1e-3, r=0.01)
    run, live = track(Regression(N), tracker, y, u), Live(Regression(N), tracker)
    for t in range(len(y)):
        live.update(y[t], u[t])
        assert np.array_equal(live.theta, run.theta[t])


K = Kalman(q=1e-3, r=0.01)


@pytest.mark.parametrize(
    ("tracker", "n", "lanes"), [(K, MOST, 32), (K, MOST + 1, 1), (Kalman(q=1e-3, r=0.01, form="sqrt"), 2, 1)]
)
def test_lanes_of_a_fleet_have_the_bits_of_single_runs(tracker, n, lanes):
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=(FEWEST, 40, n)), rng.normal(size=(FEWEST, 40))
    y[2, 5:9], u[3, 30] = np.nan, np.nan
    assert width_of(Program(Regression(n), tracker), FEWEST) == lanes
    if lanes > 1:
        fleet = track(Regression(n), tracker, y, u, by="row")
        for k in range(FEWEST):
            run = track(Regression(n), tracker, y[k], u[k])
            for name in ("theta", "std", "innovation_std"):
                assert np.array_equal(getattr(fleet[k], name), getattr(run, name), equal_nan=True)


def test_series_of_a_model_that_takes_one_lane_at_a_time_run_one_by_one():
    model = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2)).bind(1)
    assert width_of(Program(model, Kalman(q=1e-3, r=0.01)), 1000) == 1

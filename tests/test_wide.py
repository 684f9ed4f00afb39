"""More parameters than a row of P is summed in order for: the same filter, and the same bits in every mode."""

import numpy as np
import pytest

from driftfit import Kalman, Live, Regression, track
from driftfit.trackers.parts.diffuse import NARROW

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

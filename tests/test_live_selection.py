"""Orders and bases chosen on line: the weights of the record, and a change of structure that is found."""

import copy

import numpy as np
import pytest
from numpy.testing import assert_allclose

from driftfit import (
    ARX,
    FLS,
    RLS,
    AdaptiveKalman,
    AugmentedFLS,
    Bank,
    HammersteinWiener,
    Kalman,
    Live,
    LiveSelection,
    grid,
    select,
)
from driftfit.engine.drivers import drivers
from driftfit.models.hammerstein_wiener.basis import PiecewiseLinear

K = Kalman(q=1e-4, r=4e-4)
CANDIDATES = [
    *grid(HammersteinWiener, na=1, nb=2, input=[None, PiecewiseLinear([-0.4, 0.4])]),
    HammersteinWiener(2, 2),
]
LINEAR, STUCK = 0, 1
"""Places of the two structures that were true, both with na = 1."""


def record(seed, T=600):
    """y, u: a valve that begins to stick about 0 at half of the record, before a lag of first order."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1.0, 1.0, T), np.zeros(T)
    v = np.where(np.arange(T) < T // 2, u, np.sign(u) * np.maximum(np.abs(u) - 0.4, 0.0))
    for t in range(2, T):
        y[t] = 0.6 * y[t - 1] + 0.5 * v[t - 1] + 0.2 * v[t - 2] + 0.02 * rng.normal()
    return y, u


def test_the_weights_are_those_of_the_record(tmp_path):
    y, u = record(0)
    y[100], u[200] = np.nan, np.inf
    expected = select(CANDIDATES, y, u, tracker=K).average(0.98)
    live = LiveSelection(CANDIDATES, K, forgetting=0.98)
    weights, result = np.empty((600, len(CANDIDATES))), np.empty(600)
    for t in range(600):
        if t == 350:
            live.save(tmp_path / "state")
            live = LiveSelection.load(tmp_path / "state")
        weights[t] = live.weights
        result[t] = live.update(y[t], u[t])
    assert_allclose(weights, expected.weights, atol=1e-9)
    known = np.isfinite(expected.y_hat)
    assert known.sum() > 580
    assert_allclose(result[known], expected.y_hat[known], atol=1e-9)
    assert repr(CANDIDATES[STUCK].bind(1)) in repr(live)


def test_it_finds_the_structure_and_finds_it_again_after_a_change():
    """Twenty records: the linear valve is found before the change, the one that sticks within 22 samples after it."""
    before, after, late = [], [], []
    for seed in range(20):
        y, u = record(seed)
        live, best = LiveSelection(CANDIDATES, K, forgetting=0.98), np.empty(600, int)
        for t in range(600):
            live.update(y[t], u[t])
            best[t] = live.streams.index(live.best)
        before.append(best[299] == LINEAR)
        late.append(best[599] == STUCK)
        after.append(int(np.argmax(best[300:] == STUCK)))
    assert (sum(before), sum(late)) == (19, 20)
    assert max(after) <= 22


def test_candidates_that_cannot_be_weighed_are_refused():
    for arguments, message in (
        (([], K), "at least one model"), ((CANDIDATES, K, 0.0), "forgetting must be in"),
        ((CANDIDATES, AugmentedFLS(mu=1.0)), "with one variance"), ((CANDIDATES, Bank()), "with one variance"),
        (([HammersteinWiener(1, 1, ny=2)], AdaptiveKalman()), "one output"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            LiveSelection(*arguments)


ORDERS = [ARX(2, 2), ARX(1, 1), ARX(0, 1, nk=2, intercept=True)]


@pytest.mark.parametrize(
    "tracker",
    [Kalman(q=1e-3, r=0.01), Kalman(q=1e-3, r=0.01, p0=2.0, form="sqrt"), FLS(100.0), RLS(0.99)],
    ids=lambda one: type(one).__name__,
)
def test_candidates_give_the_bits_that_they_give_alone(tracker):
    """Also with missing and wrong readings, gaps in time, known factors, what-if questions and resets in between."""
    y, u = record(1, 200)
    y[20:25], y[60], u[90], y[120] = np.nan, 40.0, np.nan, -9.0
    before = drivers.cache_info().misses
    live = LiveSelection(ORDERS, tracker, dt=1.0)
    assert drivers.cache_info().misses - before <= (1 if tracker.pads else 3)
    alone = [Live(model, tracker, dt=1.0) for model in ORDERS]
    time = np.cumsum(np.where(np.arange(200) == 140, 3.0, 1.0))
    for t in range(200):
        if t in (1, 4, 30, 80):
            live = [copy.deepcopy, lambda one: LiveSelection.from_bytes(one.to_bytes())][t % 4 % 2](live)
            for one, own in zip(live.streams, alone, strict=True):
                np.testing.assert_array_equal(one.predict(0.3), own.predict(0.3))
                for stream in (one, own):
                    stream.reset(0, theta=0.1)
        known = {"time": time[t], "weight": 0.5 if t % 7 == 0 else 1.0}
        live.update(y[t], u[t], **known)
        for one, own in zip(live.streams, alone, strict=True):
            own.update(y[t], u[t], **known)
            np.testing.assert_array_equal(one.theta, own.theta)
    for one, own in zip(live.streams, alone, strict=True):
        assert one.to_bytes() == own.to_bytes()
        np.testing.assert_array_equal(one.cov, own.cov)
        assert repr(one) == repr(own).replace("Live", "SharedStream")
        for stream in (one, own):
            stream.update_many(y[:20], u[:20], time=time[-1] + 1.0 + np.arange(20.0))
        assert one.update(0.1, 0.2) == own.update(0.1, 0.2)

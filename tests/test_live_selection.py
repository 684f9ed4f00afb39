"""Orders and bases chosen on line: the weights of the record, and a change of structure that is found."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from driftfit import (
    AdaptiveKalman,
    AugmentedFLS,
    Bank,
    HammersteinWiener,
    Kalman,
    LiveSelection,
    grid,
    select,
)
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
    """Eight records: the linear valve is found before the change, the one that sticks within 22 samples after it."""
    before, after, late = [], [], []
    for seed in range(8):
        y, u = record(seed)
        live, best = LiveSelection(CANDIDATES, K, forgetting=0.98), np.empty(600, int)
        for t in range(600):
            live.update(y[t], u[t])
            best[t] = live.streams.index(live.best)
        before.append(best[299] == LINEAR)
        late.append(best[599] == STUCK)
        after.append(int(np.argmax(best[300:] == STUCK)))
    assert (sum(before), sum(late)) == (8, 8)
    assert max(after) <= 22


def test_candidates_that_cannot_be_weighed_are_refused():
    for arguments, message in (
        (([], K), "at least one model"), ((CANDIDATES, K, 0.0), "forgetting must be in"),
        ((CANDIDATES, AugmentedFLS(mu=1.0)), "with one variance"), ((CANDIDATES, Bank()), "with one variance"),
        (([HammersteinWiener(1, 1, ny=2)], AdaptiveKalman()), "one output"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            LiveSelection(*arguments)

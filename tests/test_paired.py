"""The comparison with rivals that a verdict carries, and its test for paired errors."""

import numpy as np
import pytest
from scipy import stats
from support import arx_record, damaged

from driftfit import ARX, Kalman, track
from driftfit.judge.statistics.paired import newey_west, paired


def test_comparison_is_that_of_the_summary():
    y, u = damaged(*arx_record(400, 5))
    run = track(ARX(2, 2), Kalman(q=1e-3, r=0.1), y, u)
    result, comparison = run.verdict(), run.summary().comparison
    rms = {rival.name: rival.rms for rival in result.rivals}
    assert (result.rms, rms["persistence"], rms["constant LS"], rms["constant ARX"]) == comparison[:4]
    assert result.scored == comparison.samples
    assert result.samples == int(run.ok.sum())


def test_paired_is_the_textbook_formula():
    rng = np.random.default_rng(3)
    own, rival = rng.normal(size=(2, 300))
    d = rival**2 - own**2
    centred, lags = d - d.mean(), int(4 * 3 ** (2 / 9))
    v = np.mean(centred**2) + 2 * sum(
        (1 - k / (lags + 1)) * np.sum(centred[k:] * centred[:-k]) / 300 for k in range(1, lags + 1)
    )
    got = paired("rival", rival, own)
    assert newey_west(d) == pytest.approx(v, rel=1e-12)
    assert got.t == pytest.approx(d.mean() / np.sqrt(v / 300), rel=1e-12)
    assert got.p == pytest.approx(stats.norm.sf(got.t), rel=1e-9)
    assert got.rms == pytest.approx(np.sqrt(np.mean(rival**2)))


def test_paired_where_every_difference_is_the_same_and_in_any_unit():
    """Persistence on a ramp is wrong by one step at every sample."""
    better, worse = (
        paired("persistence", *pair) for pair in ((np.ones(50), np.zeros(50)), (np.zeros(50), np.ones(50)))
    )
    assert (better.t, better.p, worse.t, worse.p) == (np.inf, 0.0, -np.inf, 1.0)
    assert paired("itself", np.ones(50), np.ones(50))[2:] == (0.0, 0.5)
    own, rival = np.random.default_rng(3).normal(size=(2, 300))
    assert paired("rival", 1e-90 * rival, 1e-90 * own)[2:] == pytest.approx(paired("rival", rival, own)[2:], rel=1e-9)

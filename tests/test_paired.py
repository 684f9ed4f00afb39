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

"""Verdicts and alarms on readings of a coarse sensor, whose errors of rounding last as long as an input is held."""

import numpy as np
import pytest

from driftfit import RLS, Live, Regression, track
from driftfit.judge.evidence import Evidence
from driftfit.judge.regressors import regressors
from driftfit.judge.statistics.coarse_readings import drawn_within, step_of
from driftfit.judge.statistics.robust import orthonormal


def coarse(seed, noise, held, unit=1.0, moved=0.0):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([0.0, 5.0, 20.0, -10.0], 600 // held), held)
    y = 3700.3 - 2.03 * u + moved * (np.arange(600) >= 300) + noise * rng.normal(size=600)
    return track(Regression(["I"], intercept=True), RLS(1.0), unit * np.round(y), u)


@pytest.mark.parametrize(("noise", "held"), [(0.2, 10), (0.3, 40)])
def test_constants_are_not_rejected_because_their_readings_are_rounded(noise, held):
    runs = [coarse(seed, noise, held) for seed in range(12)]
    assert sum(Evidence(run).p < 0.05 for run in runs) <= 2
    assert sum(len(run.segment().breaks) > 0 for run in runs) <= 2


@pytest.mark.parametrize("moved", [0.5, 1.0, 5.0])
def test_a_change_of_a_coarse_sensor_is_found(moved):
    verdicts = [coarse(seed, 0.2, 10, 0.01, moved).verdict() for seed in (6, 7, 8)]
    assert all(verdict.drifts for verdict in verdicts)
    assert [verdict.moving for verdict in verdicts].count(("intercept",)) >= 2


def test_the_step_is_that_of_all_readings():
    rng = np.random.default_rng(0)
    held = np.repeat(rng.choice(5, 100), 4)
    assert step_of(30.0 + 0.6 * held) == pytest.approx(0.6)
    assert step_of(np.where(held == 3, 21.0, 30.0 * (held % 2))) == pytest.approx(3.0)  # 0, 21, 30
    assert step_of(np.where(held == 3, np.nan, 1.8 * held + 32.0)) == pytest.approx(1.8)
    assert step_of(rng.normal(size=400)) == step_of(np.zeros(9)) == step_of(np.zeros(0)) == 0.0


def test_readings_of_a_fine_sensor_and_loud_ones_remain_as_they_are():
    rng = np.random.default_rng(1)
    u = np.repeat(rng.normal(size=60) * 9.0, 5)
    Q = orthonormal(np.column_stack([u, np.ones(300)])).Q
    fine = track(Regression(1, intercept=True), RLS(1.0), 2.0 * u + 0.2 * rng.normal(size=300), u)
    assert regressors(fine).step is None
    loud, quiet = (np.round(2.0 * u + noise * rng.normal(size=300)) for noise in (1.0, 0.2))
    assert drawn_within(Q, loud, np.ones(300)) is loud
    z = drawn_within(Q, quiet, np.ones(300))
    assert (np.abs(z - quiet) <= 0.5 + 1e-9).all()
    assert np.std(z - Q @ (Q.T @ z) / 300) == pytest.approx(0.2, rel=0.25)
    np.testing.assert_array_equal(z, drawn_within(Q, quiet, np.ones(300)))
    np.testing.assert_allclose(1e-3 * z, drawn_within(Q, 1e-3 * quiet, np.full(300, 1e-3)), atol=1e-9)


def test_alarms_of_a_coarse_sensor_are_those_of_changes_in_a_record_and_in_a_stream(tmp_path):
    runs = [coarse(seed, 0.2, 10) for seed in range(12)]
    assert sum(len(run.detect(reference=250).onsets) > 0 for run in runs) <= 2
    run = coarse(3, 0.2, 10, 0.1, 1.0)
    record = run.detect(reference=250)
    assert record.rule.rounding[:2] == pytest.approx((0.1, 0.02), rel=0.2)
    assert 300 <= record.onsets[0] < 310
    live = Live(run.model, RLS(1.0))
    for t in range(250):
        live.update(run.y[t], run.u[t])
    alarm = live.detect(record.rule, wait=0)
    found = []
    for t in range(250, 400):
        if t == 320:  # a stream that is saved goes on with the same numbers
            live.save(tmp_path / "stream")
            live = Live.load(tmp_path / "stream")
            (alarm,) = live.alarms
        live.update(run.y[t], run.u[t])
        found.append(alarm.statistic.copy())
    np.testing.assert_array_equal(np.array(found), record.statistic[250:400])

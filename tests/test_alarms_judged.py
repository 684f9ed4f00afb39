"""What frozen alarms judge: readings that the gate refused, samples after missing ones; and how they end."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from driftfit import AdaptiveKalman, Kalman, Live, Regression, track
from driftfit.judge.alarms.bootstrap import limits, simulated
from driftfit.judge.alarms.detect import asked_for
from driftfit.judge.alarms.frozen import frozen_model, noise_model
from driftfit.judge.alarms.groups import look
from driftfit.run.live.reference_model import CLIP, EVEN, SCALE, K

HELD = Kalman(q=0.0, r=1.0)
GAIN = Regression(["gain"], intercept=True)


@pytest.mark.parametrize("tracker", [HELD, AdaptiveKalman()], ids=["Kalman", "AdaptiveKalman"])
def test_a_sensor_that_fails_again_and_again_is_reported(tracker):
    """Every second reading is 0, which the gate refuses; readings that are missing are not judged."""
    rng, at = np.random.default_rng(1), np.arange(1400)
    u, v = rng.normal(size=(2, 1400))
    y = np.where((at >= 1000) & (at % 2 == 1), 0.0, 2.0 * u + 50.0 + v)
    y[1300:1320] = np.nan
    run = track(GAIN, tracker, y, u, gate=True)
    assert not run.ok[1101:1200:2].any()
    for kind in ("glr", "cusum"):
        alarms = run.detect(kind, every=1000.0, reference=800, records=16)
        assert 1000 <= alarms.onsets[alarms.onsets >= 1000][0] < 1030
        live = Live(GAIN, tracker, gate=True)
        alarm = live.detect(alarms.rule)
        for t in range(1400):
            live.update(y[t], u[t])
        whole = run.detect(alarms.rule)
        np.testing.assert_array_equal(alarm.statistic, whole.statistic[-1])
        assert [onset.sample for onset in alarm.onsets()] == whole.onsets.tolist()
        missing = track(GAIN, tracker, np.where(at % 2 == 1, np.nan, y), u, gate=True).detect(alarms.rule, start=1000)
        assert not missing.active.any()


def test_codes_in_the_reference_are_normal_and_a_stuck_sensor_is_not():
    """Five readings in a hundred are codes; AdaptiveKalman refuses them, and readings that repeat the one before."""
    begun = 0
    for seed in range(4):
        rng = np.random.default_rng([seed, 11])
        u, v = rng.normal(size=(2, 2300))
        y = 2.0 * u + 1.0 + v
        y[rng.random(2300) < 0.05] = 9999.0
        begun += len(track(GAIN, AdaptiveKalman(), y, u).detect(every=500.0, reference=300, records=32).onsets)
    assert begun < 40  # 16 are set
    y = 2.0 * u + 1.0 + v
    y[150:250] = y[150]
    stuck = track(GAIN, AdaptiveKalman(), y, u).detect(reference=500, records=8)
    assert stuck.rule.reference.theta[0] == pytest.approx(2.0, abs=0.2)


def test_samples_after_missing_ones_are_judged_under_coloured_noise():
    rng, at = np.random.default_rng(2), np.arange(1500)
    u, e = rng.normal(size=1500), signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=1500))
    y = 2.0 * u + 1.0 + e + 1.5 * (at >= 1200)
    y[(at >= 1000) & (at % 2 == 1)] = np.nan
    run = track(GAIN, HELD, y, u)
    assert len(run.detect(reference=800, records=8).rule.reference.ar) == 1
    for kind in ("glr", "cusum"):
        begun = run.detect(kind, every=1000.0, reference=800, records=32).onsets
        assert 1200 < begun[begun >= 1100][0] < 1260


@pytest.mark.parametrize("missing", ["every third", "three in ten"])
def test_the_autoregression_of_a_reference_with_missing_samples(missing):
    rng = np.random.default_rng(3)
    phi, e = rng.normal(size=(900, 2)), signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=900))
    ok = np.arange(900) % 3 != 0 if missing == "every third" else rng.random(900) > 0.3
    found, rows = frozen_model(phi, phi @ [1.0, 2.0] + e, ok)
    assert found.ar == pytest.approx([0.6], abs=0.12)
    assert len(rows.x) == np.sum(ok[1:] & ok[:-1])
    assert found.numbers[SCALE] == pytest.approx(0.8, rel=0.15)


def test_the_sums_of_a_long_fault_end_soon_after_it():
    rng, at = np.random.default_rng(4), np.arange(2400)
    u, v = rng.normal(size=(2, 2400))
    run = track(GAIN, HELD, 2.0 * u + 1.0 + v + 5.0 * ((at >= 700) & (at < 1700)), u)
    alarms = run.detect("cusum", reference=600, records=16)
    assert alarms.active[720:1700].all()
    assert alarms.cause(1000) == alarms.cause(1690) == "intercept"
    assert not alarms.active[2100:].any()


def test_the_scale_of_a_meter_that_mostly_repeats():
    """The median of the residuals of its readings is nearly 0."""
    rng = np.random.default_rng(5)
    readings = np.where(rng.random(400) < 0.75, 0.0, rng.choice([-1.0, 1.0], 400)) + 1e-3 * rng.normal(size=400)
    numbers, _ = noise_model(readings, 2)
    assert 0.2 < numbers[SCALE] < 0.7
    assert numbers[K] > 0.5


def test_long_windows_have_lower_limits():
    """Otherwise all windows are judged by the same limit."""
    rng = np.random.default_rng(6)
    u, v = rng.normal(size=(2, 1200))
    alarms = track(GAIN, HELD, 2.0 * u + 1.0 + v, u).detect(reference=500, records=8)
    model = alarms.rule.reference
    assert model.numbers[EVEN] == 0.5
    frozen = list(alarms.rule.frozen)
    frozen[4] = tuple(0.0 if k == EVEN else one for k, one in enumerate(frozen[4]))
    earlier = alarms.run.detect(replace(alarms.rule, frozen=tuple(frozen)), start=500)
    judged = slice(900, None)  # all windows are complete, the longest have the same statistic
    assert (alarms.statistic[judged] <= earlier.statistic[judged] + 1e-12).all()
    assert (alarms.statistic[judged, 0] ** 2 >= earlier.statistic[judged, 0] ** 2 - np.log(48.0) - 1e-9).all()


def test_what_references_leave_unsure_does_not_grow_with_groups_of_alarms():
    """The models of 64 references that are nearly exact: their rates differ by chance alone."""
    rng = np.random.default_rng(7)
    unsure = []
    for seed in range(3):
        phi = rng.normal(size=(4000, 2))
        found, rows = frozen_model(phi, phi @ [1.0, 2.0] + rng.normal(size=4000), np.ones(4000, bool))
        unsure.append(limits(simulated(found, rows, seed), False, 1000.0)[2])
    assert np.mean(unsure) < 0.5


def test_louder_noise_is_found_soon_and_heavy_tails_are_clipped():
    rng, late = np.random.default_rng(8), []
    for seed in range(9):
        u, v = np.random.default_rng([seed, 40]).normal(size=(2, 1300))
        y = 2.0 * u + 1.0 + v * np.where(np.arange(1300) >= 1100, 1.5, 1.0)
        begun = track(GAIN, HELD, y, u).detect(every=1000.0, reference=1000, records=32).onsets
        late.append(np.append(begun[begun >= 1100], 1300)[0] - 1100)
    assert np.median(late) < 36
    clips = [
        [noise_model(draw(300), 2)[0][CLIP] for _ in range(20)]
        for draw in (rng.standard_normal, lambda size: rng.standard_t(2, size))
    ]
    assert np.mean(clips[0]) > 3.7
    assert np.mean(clips[1]) < 3.4


def test_a_code_is_no_lag_of_the_noise():
    """Of none after it, and in the reference it says nothing of the autoregression."""
    rng = np.random.default_rng(12)
    phi, e = rng.normal(size=(1500, 2)), signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=1500))
    phi[:, 1] = 1.0
    y = phi @ [2.0, 1.0] + e
    y[1200] = 9999.0
    alarms = track(Regression(2), HELD, y, phi, gate=True).detect(every=1000.0, reference=800, records=32)
    assert not alarms.active[1200:1216].any()
    y[10:800:40] = 9999.0
    found, rows = frozen_model(phi[:800], y[:800], np.ones(800, bool), 1)
    assert found.ar == pytest.approx([0.6], abs=0.1)
    assert found.numbers[SCALE] == pytest.approx(0.8, rel=0.15)
    assert np.sum(np.abs(rows.x) > 30.0) == 20


def test_limits_allow_for_the_error_of_the_autoregression():
    """The correlation that whitening leaves differs from record to record, by 0.046 for AR(0.6) and N = 300."""
    rng = np.random.default_rng(14)
    phi, e = rng.normal(size=(300, 2)), signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=300))
    found, rows = frozen_model(phi, phi @ [1.0, 2.0] + e, np.ones(300, bool))
    assert len(found.ar) == 1
    g = simulated(found, rows, 0).g
    left = np.mean(g[:, 1:] * g[:, :-1], axis=1) / np.mean(g * g, axis=1)
    assert 0.042 < np.std(left) < 0.075  # 0.028 without


@pytest.mark.filterwarnings("ignore:track. y. .* like .*fault code")  # so do those of a t distribution
def test_members_of_a_group_have_the_same_clip_and_tails():
    rng, looks = np.random.default_rng(15), []
    asked = asked_for("glr", 1000.0)
    for k in range(24):
        u, v = rng.normal(size=700), rng.normal(size=700) if k % 2 else rng.standard_t(2, 700)
        looks.append(look(track(GAIN, HELD, 2.0 * u + 1.0 + v, u), asked, 500))
    clips, kinds = {}, {}
    for k, one in enumerate(looks):
        clips.setdefault(one.like, set()).add(float(one.rule.reference.numbers[CLIP]))
        kinds.setdefault(one.like, set()).add(k % 2)
    assert all(len(one) == 1 for one in (*clips.values(), *kinds.values()))
    assert len(clips) < 20

"""What frozen alarms judge: readings that the gate refused, samples after missing ones; and how they end."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from driftfit import ARX, AdaptiveKalman, Kalman, Live, Regression, track
from driftfit.judge.alarms.bootstrap import Normal, Source, limits, simulated
from driftfit.judge.alarms.detect import asked_for
from driftfit.judge.alarms.fleet_alarms import like
from driftfit.judge.alarms.frozen import frozen_model, noise_model
from driftfit.judge.alarms.reference import modelled
from driftfit.run.live.reference_model import CLIP, EVEN, SCALE, K

HELD = Kalman(q=0.0, r=1.0)
GAIN = Regression(["gain"], intercept=True)


def reference(phi, y, ok=None):
    """Rows of a reference: regressors, y, whether they are usable, variance factor, interval."""
    one = np.ones(len(y))
    return np.column_stack([phi, y, one if ok is None else ok, one, one])


@pytest.mark.parametrize("tracker", [HELD, AdaptiveKalman()], ids=["Kalman", "AdaptiveKalman"])
def test_a_sensor_that_fails_again_and_again_is_reported(tracker):
    """Every second reading is 0, which the gate refuses; readings that are missing are not judged."""
    rng, at = np.random.default_rng(1), np.arange(1400)
    u, v = rng.normal(size=(2, 1400))
    y = np.where((at >= 1000) & (at % 2 == 1), 0.0, 2.0 * u + 50.0 + v)
    y[1300:1320] = np.nan
    run = track(GAIN, tracker, y, u, gate=True)
    assert not run.ok[1101:1200:2].any()
    alarms = run.detect(every=1000.0, reference=800, records=16)
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
    begun = run.detect(every=1000.0, reference=800, records=32).onsets
    assert 1200 < begun[begun >= 1100][0] < 1260


@pytest.mark.parametrize("missing", ["every third", "three in ten"])
def test_the_autoregression_of_a_reference_with_missing_samples(missing):
    rng = np.random.default_rng(3)
    phi, e = rng.normal(size=(900, 2)), signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=900))
    ok = np.arange(900) % 3 != 0 if missing == "every third" else rng.random(900) > 0.3
    found, known = frozen_model(reference(phi, phi @ [1.0, 2.0] + e, ok))
    assert found.ar == pytest.approx([0.6], abs=0.12)
    assert len(known.x) == np.sum(ok[1:] & ok[:-1])
    assert found.numbers[SCALE] == pytest.approx(0.8, rel=0.15)


def test_an_alarm_ends_soon_after_a_long_fault_and_does_not_flicker():
    """It ends where all statistics are below the limits of twice as many false alarms."""
    rng, at = np.random.default_rng(4), np.arange(2400)
    u, v = rng.normal(size=(2, 2400))
    run = track(GAIN, HELD, 2.0 * u + 1.0 + v + 5.0 * ((at >= 700) & (at < 1700)), u)
    alarms = run.detect(reference=600, records=16)
    assert alarms.active[720:1700].all()
    assert alarms.cause(1000) == alarms.cause(1690) == "intercept"
    assert alarms.change(1000).since == 700
    assert not alarms.active[2200:].any()
    rule = replace(alarms.rule, growth=(1.0, 1.0, 1.0), limits=(4.0, 4.0, 4.0))
    assert rule.ends == pytest.approx(np.sqrt(16.0 - np.log(2.0)))
    one = np.array([3.95, 4.1, 3.95, 3.9, 3.95, 4.1])[:, None] * [1.0, 0.0, 0.0]
    assert rule.active(one).tolist() == [False, True, True, False, False, True]
    assert rule.active(one, before=True).tolist() == [True, True, True, False, False, True]


def test_the_scale_of_a_meter_that_mostly_repeats():
    """The median of the residuals of its readings is nearly 0."""
    rng = np.random.default_rng(5)
    readings = np.where(rng.random(400) < 0.75, 0.0, rng.choice([-1.0, 1.0], 400)) + 1e-3 * rng.normal(size=400)
    numbers, _ = noise_model(readings, 2)
    assert 0.2 < numbers[SCALE] < 0.7
    assert numbers[K] > 0.5


def test_long_windows_have_lower_limits():
    rng = np.random.default_rng(6)
    u, v = rng.normal(size=(2, 1200))
    alarms = track(GAIN, HELD, 2.0 * u + 1.0 + v, u).detect(reference=500, records=8)
    numbers = alarms.rule.reference.numbers
    frozen = list(alarms.rule.frozen)
    assert frozen[4][EVEN] == 0.5
    frozen[4] = (*frozen[4][:EVEN], 0.0)
    alike = alarms.run.detect(replace(alarms.rule, frozen=tuple(frozen)), start=500)
    assert np.array_equal(alike.rule.reference.numbers[:EVEN], numbers[:EVEN])
    judged = slice(900, None)  # all windows are complete, the longest have the same statistic
    assert (alarms.statistic[judged] <= alike.statistic[judged] + 1e-12).all()
    assert (alarms.statistic[judged, 0] ** 2 >= alike.statistic[judged, 0] ** 2 - np.log(48.0) - 1e-9).all()


def test_what_references_leave_unsure_does_not_grow_with_groups_of_alarms():
    """The models of 64 references that are nearly exact: their rates differ by chance alone."""
    rng = np.random.default_rng(7)
    unsure = []
    for seed in range(3):
        phi = rng.normal(size=(4000, 2))
        rows = reference(phi, phi @ [1.0, 2.0] + rng.normal(size=4000))
        unsure.append(limits(simulated(Normal(rows, (), *frozen_model(rows)), seed), 1000.0)[2])
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
    found, known = frozen_model(reference(phi[:800], y[:800]), 1)
    assert found.ar == pytest.approx([0.6], abs=0.1)
    assert found.numbers[SCALE] == pytest.approx(0.8, rel=0.15)
    assert np.sum(np.abs(known.x) > 30.0) == 20


def test_simulated_records_are_those_of_the_reference():
    """Inputs in their order, their own outputs as lags, noise of the same colour and size, a reference of their own."""
    rng = np.random.default_rng(14)
    u, e = np.repeat(rng.normal(size=60), 10), signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=600))
    y = signal.lfilter([0.0, 1.0], [1.0, -0.7], u) + signal.lfilter([1.0], [1.0, -0.7], e)
    rule, normal, *_ = modelled(track(ARX(1, 1), HELD, y, u), asked_for("glr", 1000.0), 600)
    assert normal.delays == ((0, 1),)
    made = Source(normal, 0).record(500)
    N = len(normal.rows)
    assert made[1:, 0] == pytest.approx(made[:-1, 3])
    assert np.array_equal(made[:N, 1], normal.rows[:, 1])
    whole = np.concatenate([normal.rows[:, 1]] * 2)
    assert any(np.array_equal(made[N:, 1], whole[k : k + 500]) for k in range(N))
    found, own = frozen_model(made[:N], 2, [0], 1)[0], rule.reference
    assert found.theta[:2] == pytest.approx(own.theta[:2], abs=0.25)
    assert not np.array_equal(found.theta, own.theta)
    assert found.ar == pytest.approx(own.ar, abs=0.2)
    assert found.numbers[SCALE] == pytest.approx(own.numbers[SCALE], rel=0.15)


def test_a_reference_that_changes_is_said_to():
    rng, at = np.random.default_rng(16), np.arange(1000)
    u, v = rng.normal(size=(2, 1000))
    alarms = [
        track(GAIN, HELD, (2.0 + size * (at >= 300)) * u + 1.0 + v, u).detect(reference=600, records=8)
        for size in (0.0, 1.0)
    ]
    assert alarms[0].doubt == ""
    assert "gain of the reference changes at 299" in alarms[1].doubt
    assert "Reference gain of the reference changes" in " ".join(str(alarms[1]).split())


@pytest.mark.filterwarnings("ignore:track. y. .* like .*fault code")  # so do those of a t distribution
def test_members_of_a_group_have_the_same_clip_and_tails():
    rng, references = np.random.default_rng(15), []
    for k in range(24):
        u, v = rng.normal(size=700), rng.normal(size=700) if k % 2 else rng.standard_t(2, 700)
        references.append(modelled(track(GAIN, HELD, 2.0 * u + 1.0 + v, u), asked_for("glr", 1000.0), 500))
    clips, kinds = {}, {}
    for k, one in enumerate(references):
        group = like(one.rule, one.normal)
        clips.setdefault(group, set()).add(float(one.rule.reference.numbers[CLIP]))
        kinds.setdefault(group, set()).add(k % 2)
    assert all(len(one) == 1 for one in (*clips.values(), *kinds.values()))
    assert len(clips) < 20

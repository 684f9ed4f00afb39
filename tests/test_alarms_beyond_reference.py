"""Alarms on a frozen reference model whose inputs are far from zero, or beyond those of the reference."""

import numpy as np
import pytest
from scipy import signal

from driftfit import Kalman, Live, Regression, track
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.reference_model import LEARNED

HELD = Kalman(q=0.0, r=1.0)
GAIN = Regression(["gain"], intercept=True)


@pytest.mark.parametrize("offset", [10.0, 100.0, 1e5])
def test_a_change_is_named_and_sized_where_an_input_is_far_from_zero(offset):
    """A slope about the mean of the input, one through zero, which shifts y by many deviations, and the level."""
    named, late = [], []
    for seed in range(3):
        rng, after = np.random.default_rng(seed), np.arange(1300) >= 1000
        w, v = rng.normal(size=(2, 1300))
        y = 2.0 * w + 1.0 + v
        rule = track(GAIN, HELD, y, offset + w).detect(every=1000.0, reference=900, records=64).rule
        for name, size, change in (("gain", 0.8, w), ("gain", 0.8, offset + w), ("intercept", 0.8, 1.0)):
            found = track(GAIN, HELD, y + size * after * change, offset + w).detect(rule, start=900)
            begun = int(found.onsets[found.onsets >= 1000][0])
            settled = found.change(1200)
            named.append((settled.name == name, settled.low < size < settled.high))
            late.append(begun - 1000)
    right, covered = np.sum(named, axis=0)
    assert right >= 8
    assert covered >= 7
    assert np.median(late) < 30


@pytest.mark.parametrize("before", [0.0, 3.3, 1e5])
@pytest.mark.parametrize("size", [1.0, 1e-9])
def test_an_input_that_was_dead_in_the_reference_raises_no_alarm_when_it_moves(before, size):
    """Its coefficient is unknown there, whatever its unit: the second sample shows it, and later ones are judged."""
    rng, T = np.random.default_rng(1), 1500
    u = before * size + np.where((np.arange(T) >= 700) & (np.arange(T) < 1000), size * rng.normal(size=T), 0.0)
    y = 2.0 + 5.0 * u / size + rng.normal(size=T) + 3.0 * (np.arange(T) >= 1200)
    run = track(GAIN, HELD, y, u)
    alarms = run.detect(reference=600)
    assert alarms.onsets[0] >= 1200
    assert alarms.unseen == 2
    assert "2 samples: a regressor moves that did not" in str(alarms)


MOVEMENTS = {"noise": lambda t, w: w, "step": lambda t, w: 3.0, "waves": lambda t, w: 2.0 * np.sin(t / 60.0)}


@pytest.mark.parametrize("before", [0.0, 0.2])
@pytest.mark.parametrize("movement", MOVEMENTS)
def test_an_input_that_moves_for_good_after_the_reference_hides_no_fault(before, movement):
    """It was 0, or moved less: the alarm was silent from then on, or several times as frequent as set. Faults of the
    other input and of its own gain are found."""
    false, other, own, t = 0, 0, 0, np.arange(2500)
    for seed in range(8):
        rng = np.random.default_rng([seed, 11])
        u, w, v = rng.normal(size=(2500, 2)), rng.normal(size=2500), rng.normal(size=2500)
        u[:, 1] = before * u[:, 1] + np.where(t >= 1100, MOVEMENTS[movement](t, w), 0.0)
        y, model = u @ [1.0, 3.0] + 1.0 + v, Regression(2, intercept=True)
        alarms = track(model, HELD, y, u).detect(every=1000.0, reference=1000, records=64)
        assert alarms.unseen <= 2
        false += len(alarms.onsets)
        for fault, found in ((u[:, 0], "other"), (u[:, 1], "own")):
            active = track(model, HELD, y + 0.8 * fault * (t >= 2000), u).detect(alarms.rule, start=1000).active
            other += found == "other" and bool(active[2000:2200].any())
            own += found == "own" and bool(active[2000:2400].any())
    assert false <= 26  # 12 are set, give or take the errors of the references
    assert (other, own) == (8, 8)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_several_inputs_that_begin_to_move_one_after_the_other_are_learned(scale):
    """From first movements a billion times smaller than later ones, and in units far apart."""
    rng, t = np.random.default_rng(1), np.arange(1500)
    u, w = rng.normal(size=(1500, 3)), rng.normal(size=(1500, 2)) * [scale, 1.0 / scale]
    size = np.where(t < 610, 1e-9, 1.0)[:, None]
    u[:, 1:] = w * size * np.column_stack([t >= 600, t >= 700])
    y = u[:, 0] + 1.0 + 2.0 * (u[:, 1:] / [scale, 1.0 / scale]).sum(axis=1) + rng.normal(size=1500) + (t >= 1300)
    alarms = track(Regression(3, intercept=True), HELD, y, u).detect(every=3000.0, reference=500, records=64)
    assert alarms.unseen <= 4
    assert np.isfinite(alarms.statistic[520:]).all()
    assert alarms.onsets[0] >= 1300
    assert alarms.active[1300:1400].any()


@pytest.mark.parametrize("moved", [0.03, 1e-4])
def test_an_input_that_hardly_moved_in_the_reference_hides_no_fault_when_it_does(moved):
    """What is then left of y is the error of its gain, many times as many alarms as set, until the first samples have
    corrected it. Faults of other parameters are found as before."""
    false, found = 0, 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u, later = rng.normal(size=(1500, 2)), np.arange(1500) >= 800
        u[~later, 1] *= moved
        fault = np.where(np.arange(1500) >= 1200, 0.5, 0.0)
        y = u @ [1.0, 2.0] + 1.0 + 0.5 * rng.normal(size=1500) + fault
        run = track(Regression(2, intercept=True), Kalman(q=0.0, r=0.25), y, u)
        alarms = run.detect(every=1000, reference=400, records=64)
        assert alarms.unseen <= 5
        onsets = alarms.onsets[alarms.onsets >= 800]
        false += int(np.sum(onsets < 1200))
        found += bool(alarms.active[1200:1300].any())
    assert false <= 9  # 3 are set, give or take the errors of the references
    assert found == 8


def test_inputs_far_beyond_those_of_the_reference_are_judged():
    """All of them are 20 times as large: none of the two thousand samples resembles the reference."""
    false, found = 0, 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u, v, at = rng.normal(size=(2500, 2)), rng.normal(size=2500), np.arange(2500)
        u[at >= 500] *= 20.0
        run = track(Regression(2, intercept=True), HELD, u @ [1.0, -1.0] + v + 1.0 * (at >= 2300), u)
        alarms = run.detect(every=500.0, reference=500, records=64)
        assert alarms.unseen <= 5
        false += int(np.sum(alarms.onsets < 2300))
        found += bool(alarms.active[2300:2400].any())
    assert false <= 36  # 22 are set
    assert found == 6


def test_false_readings_of_an_input_do_not_correct_its_gain():
    """One reading in a hundred is thirty deviations off, which y does not follow."""
    false = 0
    for seed in range(6):
        rng = np.random.default_rng([seed, 300])
        u = rng.normal(size=2300)
        y = 0.3 * u + 1.0 + rng.normal(size=2300)
        bad = (np.arange(2300) >= 300) & (rng.random(2300) < 0.01)
        u[bad] += 30.0 * rng.choice([-1.0, 1.0], bad.sum())
        alarms = track(GAIN, HELD, y, u, gate=True).detect(every=1000.0, reference=300, records=64)
        false += len(alarms.onsets)
    assert false <= 20  # 12 are set


@pytest.mark.parametrize("moves", [0.0, 1.0])
def test_a_large_input_without_response_is_reported(moves):
    """A stuck valve: the input goes far beyond its range, and y does not follow; the gate blames the input."""
    for seed in range(4):
        rng, stuck = np.random.default_rng([seed, 7]), np.arange(1200) >= 1000
        u, v = rng.normal(size=(2, 1200))
        u = np.where(stuck, 12.0 + moves * u, u)
        run = track(GAIN, HELD, np.where(stuck, 1.0, 0.6 * u + 1.0) + 0.5 * v, u, gate=True)
        assert not run.ok[1000:1005].any()
        alarms = run.detect(every=1000.0, reference=800, records=64)
        assert alarms.active[1010:1020].all()


def test_an_input_sensor_that_fails_again_and_again_is_reported_and_single_false_readings_are_not():
    found, begun = 0, 0
    for seed in range(4):
        rng, at = np.random.default_rng([seed, 8]), np.arange(2000)
        u, v = rng.normal(size=(2, 2000))
        y, code = 2.0 * u + 1.0 + v, rng.random(2000) < 0.2
        single = track(GAIN, HELD, y, np.where((at >= 800) & (at % 60 == 0), 9999.0, u), gate=True)
        alarms = single.detect(every=1000.0, reference=800, records=64)
        begun += len(alarms.onsets)
        often = track(GAIN, HELD, y, np.where((at >= 1000) & code, 9999.0, u), gate=True)
        found += bool(often.detect(alarms.rule, start=800).active[1000:1100].any())
    assert begun <= 10  # 5 are set
    assert found == 4


def test_what_is_not_judged_under_coloured_noise():
    """A single reading of an input that was 0 in the reference, whose whitened rows differ from 0 until its lags do
    not, shows its gain in the second of these rows.
    """
    rng, T = np.random.default_rng(3), 1500
    moves = (np.arange(T) >= 700) & (np.arange(T) < 1000)
    u, e = np.where(moves, rng.normal(size=T), 0.0), signal.lfilter([0.8], [1.0, -0.6], rng.normal(size=T))
    y = 2.0 + 5.0 * u + e
    y[[900, 1200]] = np.nan
    alarms = track(GAIN, HELD, y, u).detect(reference=600, records=8)
    p = len(alarms.rule.reference.ar)
    assert p == 1
    assert alarms.unseen == 2


def test_a_stream_learns_and_centres_as_the_record_does():
    """Also after it was saved while it learned; a state of another version is refused."""
    rng = np.random.default_rng(6)
    u = rng.normal(size=(900, 2))
    u[:600, 1] *= 1e-3
    u[:, 0] += 50.0
    y = u @ [0.5, 2.0] + rng.normal(size=900)
    model, tracker = Regression(2), Kalman(q=0.0, r=1.0)
    run = track(model, tracker, y, u)
    record = run.detect(reference=500, records=8)
    live = Live(model, tracker, warm_start=track(model, tracker, y[:500], u[:500]))
    alarm = live.detect(record.rule)
    for t in range(500, 900):
        live.update(y[t], u[t])
        np.testing.assert_array_equal(alarm.statistic, record.statistic[t])
        if t in (550, 603):
            live = Live.from_bytes(live.to_bytes())
            (alarm,) = live.alarms
    state = alarm.plain()
    assert not (alarm._memory.known[LEARNED] == 0.0).all()
    with pytest.raises(ValueError, match=r"another version.*run.detect\(.*\)\.rule"):
        LiveAlarm.of({**state, "memory": state["memory"][1:]}, tracker, model.names)

"""The gate in front of three trackers (`benchmarks/gate.py`): what is a change, what is a code, and what each costs."""

from functools import lru_cache

import numpy as np
import pytest

from benchmarks.gate import NAMES, Bench, measured
from benchmarks.gate_cases import AT, CODES, LEVEL, MODELS, REAL, STARTS, honest, level_50, record
from driftfit.readings.gate import INPUT, REFUSED, SIGNAL, USED, Gate
from driftfit.readings.screen import screen

SEEDS = range(10)
TRACKERS = range(len(NAMES))


@lru_cache
def bench(model):
    return Bench(*MODELS[model], Gate())


def runs(make, seeds=SEEDS, gated=True):
    """(case, run) for every seed and tracker."""
    for seed in seeds:
        case = make(np.random.default_rng(seed))
        for kind in TRACKERS:
            yield case, bench(case.model).run(kind, case.y, case.u, gated, q=case.q, r=case.r)


JUMPS = [name for name in REAL if name.startswith(("jump", "level by", "ARX gain"))]
CLEAN = [
    "walks", "hetero", "t3", "steps", "rest, moves", "rare", "tails", "floods", "test", "test at 3",
    "another level from 7", "rest at 50, moves", "a flood that bends", "pulses 5, 1, 4", "at rest inside its range",
    "healthy, 5 mV", "whole numbers, noise 0.15", "whole numbers, noise 0.3", "whole numbers, noise 0.6",
    "quantum .2, ARX",
]  # fmt: skip
KEPT_OUT = [
    "9999", "9999 for 8", "9999 for 8, any sign", "-999, ARX", "9999 for 8, ARX", "by turns, ARX",
    "with good between, ARX", "0 for 50", "0 for 50, for 8", "flickering rail", "one of the first ten, and more",
    "9999 for 60", "9999 for 8, coarse",
]  # fmt: skip
NO_HARM = [
    "9999 for 20, ARX", "9999 for 60, ARX", "20 at the start", "50 at the start", "20 at the start, level",
    "0 in u at 50", "-999 in u", "-999 in u for 3", "0 in u at 50, no lags", *list(STARTS)[::3],
]  # fmt: skip


@pytest.mark.parametrize("name", JUMPS)
def test_a_change_of_any_size_costs_three_samples_at_most(name):
    for _, run in runs(REAL[name]):
        assert np.sum(run.reason != USED) <= 3


def test_levels_that_repeat_in_all_digits_are_followed():
    for _, run in runs(REAL["levels without noise"], range(2)):
        for at in (100, 200, 300):
            assert np.sum(run.reason[at : at + 99] != USED) <= 16
            assert (run.reason[at + 16 : at + 99] == USED).all()


@pytest.mark.parametrize("name", CLEAN)
def test_nothing_is_refused_where_nothing_is_wrong(name):
    """Then a tracker with a gate is the tracker without one, bit for bit."""
    for (_, run), (_, plain) in zip(runs(REAL[name]), runs(REAL[name], gated=False), strict=True):
        assert not run.reason.any()
        if not run.tile["floor"].any():
            np.testing.assert_array_equal(run.theta, plain.theta)


@pytest.mark.parametrize("name", [*JUMPS[:4], "pulses 1, 100", "t3 on a level", "no response, moves"])
def test_no_reading_is_held_back_that_s_allows(name):
    for _, run in runs(REAL[name]):
        e, s = run.errors[run.reason == REFUSED].T
        assert (e * e > 25.0 * s).all()


@pytest.mark.parametrize("name", KEPT_OUT)
def test_no_code_is_let_in(name):
    for case, run in runs(CODES[name]):
        assert (run.reason[case.bad] != USED).all()
        assert np.sum(run.reason[~case.bad] != USED) == 0


@pytest.mark.parametrize("name", NO_HARM)
def test_codes_do_no_more_harm_than_a_gap(name):
    """In inputs, at every place of the start, and for long: errors are those without the codes."""
    cases = [(CODES | STARTS)[name](np.random.default_rng(seed)) for seed in SEEDS]
    for kind in TRACKERS:
        assert np.median([measured(bench(case.model), case, kind)[2] for case in cases]) < 1.01


@pytest.mark.parametrize("name", ["code 0, then rest", "code 1, then rest", "code 1, then noisy rest"])
def test_a_code_before_a_rest(name):
    """Nothing contradicts it until the plant moves; a1 = .09 for .90 without the first samples. Where the plant rests
    with noise, the samples that are kept decide in four of five records."""
    found = np.array([abs(run.theta[-1, 0] - 0.9) < 0.02 for _, run in runs(CODES[name])])
    assert np.mean(found) > (0.75 if "noisy" in name else 0.99)


@pytest.mark.parametrize("name", ["pulses 8, 25", "pulses 1, 100"])
def test_rare_pulses_are_followed_at_the_third(name):
    for case, run in runs(REAL[name]):
        at = np.flatnonzero((case.u[:, 0] > 0.0) & (np.arange(len(case.y)) >= case.at))
        assert np.sum(run.reason != USED) <= 2
        assert (run.reason[at[2:]] == USED).all()


@pytest.mark.parametrize("name", ["no response, moves", "no response, rests"])
def test_an_input_that_stays_without_a_response_is_believed_after_six_samples(name):
    for _, run in runs(REAL[name]):
        assert set(np.flatnonzero(run.reason % SIGNAL == INPUT)) <= set(range(AT, AT + 10))
        assert np.sum(run.reason % SIGNAL == INPUT) == 6


@pytest.mark.parametrize("name", ["frozen for 40", "frozen for 40, ARX"])
def test_a_frozen_sensor_is_left_out_from_the_third_repeat(name):
    for case, run in runs(CODES[name]):
        assert np.sum(run.reason[case.bad] == USED) <= 3
        assert not run.reason[~case.bad].any()


def test_events_that_nothing_predicts_are_not_left_out_for_ever():
    """Counts that are nearly always 0, and rain."""
    for seed in range(3):
        g = np.random.default_rng(seed)
        rain = (g.random(1000) < 0.1) * g.exponential(3.0, 1000)
        for y, most in ((g.poisson(0.1, 1000) * 1.0, 5), (rain, 30)):
            run = bench(LEVEL).run(1, y, g.normal(size=(1000, 1)), True, 0.0, 1.0)
            assert np.sum(run.reason != USED) <= most


@pytest.mark.parametrize(
    ("quantum", "noise", "floor"), [(1.0, 0.3, 1.0 / 12.0), (0.5, 0.1, 0.25 / 12.0), (0.0, 0.1, 0.0)]
)
def test_the_floor_of_a_coarse_meter(quantum, noise, floor):
    g = np.random.default_rng(0)
    case = record(LEVEL, g, e=noise * g.normal(size=600))
    y = quantum * np.round(case.y / quantum) if quantum else case.y
    run = bench(LEVEL).run(1, y, case.u, True, 0.0, 1.0)
    assert run.tile["floor"][0, 0] == pytest.approx(floor)


def looked_at(case):
    whole = np.array([0]), np.array([len(case.y)])
    return any(screen(signal, *whole).any() for signal in (case.y, *case.u.T))


@pytest.mark.parametrize("make", [honest("tails"), honest("steps"), level_50(honest("t3", LEVEL))])
def test_the_screen_is_silent_where_nothing_is_wrong(make):
    case = make(np.random.default_rng(1))
    assert not looked_at(case)


def test_settings_are_checked():
    assert Gate(far=np.inf) != Gate()
    assert repr(Gate(hold=8)) == "Gate(hold=8)"
    with pytest.raises(ValueError, match="Gate: hold must be a whole number"):
        Gate(hold=0.5)
    with pytest.raises(ValueError, match="Gate: far must be finite"):
        Gate(far=-1.0)

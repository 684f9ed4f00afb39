"""Changes while an input rests, or two move together: the record may not tell which parameter moved."""

import numpy as np
import pytest

from driftfit import RLS, AdaptiveKalman, Regression, track

CONSTANT = RLS(1.0)


def resting(seed, slope, back, tracker=CONSTANT, since=350):
    """An intercept or a slope that moves by 1.3 at the output while the input rests at 20 from 300 to 450."""
    rng = np.random.default_rng(seed)
    u = 5.0 * rng.normal(size=600)
    u[300:450] = 20.0
    moved = np.zeros(600)
    moved[since : 450 if back else 600] = 1.3
    y = 3.7 + 2.0 * u + moved * (u / 20.0 if slope else 1.0) + 0.1 * rng.normal(size=600)
    return track(Regression(["u"], intercept=True), tracker, y, u)


@pytest.mark.parametrize("slope", [False, True])
def test_a_change_that_ends_with_the_rest_of_an_input_may_be_of_either(slope):
    found = [
        [{m.name, *m.instead} for m in resting(seed, slope, True).verdict().parameters if m.moves] for seed in range(6)
    ]
    assert sum({"u", "intercept"} in names for names in found) >= 5
    verdict = resting(1, slope, True).verdict()
    assert "(or u: a change of it explains the record as well)" in verdict.sentences[1]


@pytest.mark.parametrize("slope", [False, True])
def test_a_change_that_outlasts_the_rest_is_of_one(slope):
    for seed in range(4):
        (moved,) = [m for m in resting(seed, slope, False).verdict().parameters if m.moves]
        assert (moved.name, moved.instead) == ("u" if slope else "intercept", ())


def test_inputs_that_move_together_during_a_change():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u = 2.0 * rng.normal(size=(600, 2))
        u[300:450, 1] = u[300:450, 0]
        b = 1.0 + 0.3 * ((np.arange(600) >= 350) & (np.arange(600) < 450))
        y = b * u[:, 0] + 2.0 * u[:, 1] + 1.0 + 0.1 * rng.normal(size=600)
        moved = [m for m in track(Regression(2, intercept=True), RLS(1.0), y, u).verdict().parameters if m.moves]
        assert moved
        assert all({"theta1", "theta2"} <= {m.name, *m.instead} for m in moved)


@pytest.mark.parametrize(("since", "back"), [(350, True), (300, True), (300, False)])
def test_smoothed_bands_contain_a_change_of_either_parameter_during_a_rest(since, back):
    for seed in (0, 1, 2):
        smoothed = resting(seed, False, back, AdaptiveKalman(), since).smooth()
        assert (np.abs(smoothed.theta[400] - [2.0, 5.0]) < 3.0 * smoothed.std[400]).all()
        assert (smoothed.std[400] < [0.1, 2.0]).all()
        assert (smoothed.std[200] < [0.01, 0.05]).all()

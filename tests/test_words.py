"""Sentences about changes are read back: their dates and values are those of the table beside them, and are true."""

import re

import numpy as np
import pytest

from driftfit import RLS, Regression, track

T = 400
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")


def told(kind, seed=103):
    """The verdict on a gain that moves beside an intercept that does not."""
    rng, t = np.random.default_rng(seed), np.arange(T)
    path = {
        "step": 2.0 * (t >= 250), "temporary": 2.0 * ((t >= 150) & (t < 260)),
        "gradual": 3.0 * np.clip((t - 100) / 200.0, 0.0, 1.0), "wandering": np.cumsum(0.15 * rng.normal(size=T)),
        "steps": 2.0 * (t >= 100) - 3.0 * (t >= 220),
    }[kind]  # fmt: skip
    u = rng.normal(size=T)
    y = 1.0 + (5.0 + path) * u + 0.5 * rng.normal(size=T)
    return track(Regression(["u"], intercept=True), RLS(1.0), y, u), 5.0 + path


@pytest.mark.parametrize("kind", ["step", "temporary", "gradual", "wandering", "steps"])
def test_numbers_of_sentences_stand_in_the_table_and_in_the_range_of_their_parameter(kind):
    run, path = told(kind)
    verdict = run.verdict()
    said = next(one for one in verdict.sentences if one.startswith("What moves"))
    printed = str(verdict)
    table = set(NUMBER.findall(printed[printed.index("Changes") : printed.index("Weights")]))
    assert set(NUMBER.findall(said)) <= table
    assert {event.kind for event in verdict.events} == {"step" if kind == "steps" else kind}
    for event in verdict.events:
        for move in event.moves:
            assert move.name == "u"
            for text in move.values:
                assert text in said
                assert path.min() - 0.4 < float(text) < path.max() + 0.4
    (moved,) = (one for one in verdict.parameters if one.moves)
    assert moved.name == "u"


def test_dates_of_words_are_those_of_segments():
    run, _ = told("steps")
    dates = [event.at for event in run.verdict().events]
    assert dates == [one.at for one in run.segment().breaks] == pytest.approx([100, 220], abs=3)
    assert "a random walk" in run.segment().better or not run.segment().better
    walk, _ = told("wandering")
    assert "a random walk" in str(walk.segment())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_level_that_rises_far_is_not_the_noise(seed):
    """An autoregression with a root of almost 1 explains a ramp as well as the ramp itself does."""
    rng, t = np.random.default_rng(seed), np.arange(T)
    u, rise = rng.normal(size=T), 4.0 * np.clip((t - 120) / 160.0, 0.0, 1.0)
    verdict = track(Regression(["u"], intercept=True), RLS(1.0), rise + u + 0.5 * rng.normal(size=T), u).verdict()
    assert verdict.drifts
    assert verdict.moving == ("intercept",)
    assert verdict.events[0].kind == "gradual"

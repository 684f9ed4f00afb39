"""The judge of the default tracker (`benchmarks/ablation.py`): its oracle, its scores, and how pieces are left out."""

import numpy as np
import pytest

from benchmarks.held_out.judge import Outcome, played, scenarios, scored
from benchmarks.held_out.oracle import oracle
from benchmarks.held_out.pieces import PIECES, Piece, Without, copied
from driftfit import AdaptiveKalman

BENT = {name: piece for name, piece in PIECES.items() if not piece.edits}


def test_a_scenario_is_the_same_in_every_run():
    assert len(scenarios()) == 46
    first, again, other = (played("room", seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.y, again.y)
    assert not np.allclose(first.y, other.y)


@pytest.mark.parametrize("name", ["single_walk", "kelvin_arx", "offset_10000", "room", "gaps"])
def test_readings_are_regressors_times_parameters_and_noise(name):
    case = played(name, 0)
    y = np.sum(case.phi * case.theta, axis=1) + case.noise
    known = np.isfinite(y) & np.isfinite(case.y)
    assert known.sum() > 700
    np.testing.assert_allclose(y[known], case.y[known], rtol=1e-9, atol=1e-9)


def test_the_oracle_of_constants_is_least_squares():
    case = played("kelvin_arx", 0)
    constant = type(case)(**{**vars(case), "kind": "constant"})
    phi, y = case.phi[1:], case.y[1:]
    np.testing.assert_allclose(oracle(constant)[0][-1], np.linalg.lstsq(phi, y, rcond=None)[0], rtol=1e-6)


def test_scores_tell_certain_errors_from_honest_ones():
    case = played("common_walk", 0)

    def off(by, std):
        ones = np.ones(len(case.y))
        return scored(case, lambda _: Outcome(case.theta + by, std + 0.0 * case.theta, case.y, ones))

    assert off(0.0, 1.0)["error"] == 0.0
    assert off(0.1, 0.03) | {"seconds": 0.0} == pytest.approx(
        {"error": 0.1 * np.sqrt(np.trace(case.weight())), "step": 0.0, "moving": 0.0, "still": np.nan, "output": 1.0,
         "wrong": 0.0, "seconds": 0.0, "ahead": np.nan, "width": np.nan}, nan_ok=True,
    )  # fmt: skip
    assert off(0.1, 0.01)["wrong"] == 1.0


@pytest.mark.parametrize("name", sorted(PIECES.keys() - BENT.keys()))
def test_what_a_piece_replaces_is_there(name, tmp_path):
    piece = PIECES[name]
    assert piece.lines() > 0 or not piece.functions
    copy = copied(piece, tmp_path) / "driftfit"
    for file, old, new in piece.edits:
        text = (copy / file).read_text()
        assert new in text
        assert old not in text


def test_an_edit_of_text_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match="0 times the text that a piece replaces"):
        copied(Piece(edits=(("tracking.py", "no such text", ""),)), tmp_path)


@pytest.mark.parametrize("name", sorted(BENT))
def test_modes_that_are_left_out_are_never_entered(name):
    whole, state = AdaptiveKalman().state(4), Without(piece=name).state(4)
    jump = whole["ratio"] >= 1.0
    assert state["mu"].sum() == pytest.approx(1.0)
    assert any(not np.array_equal(whole[field], state[field]) for field in whole)
    out = state["arrive"] < 1e-20
    assert (state["mu"][out] < 1e-20).all()
    if not out[jump].all():
        assert state["arrive"][jump].sum() == pytest.approx(whole["arrive"][jump].sum())

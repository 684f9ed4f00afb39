"""Fault codes where the output has a curve: any reading could be explained by it, so readings are judged themselves."""

import numpy as np
import pytest

from driftfit import RLS, AdaptiveKalman, ExtendedKalman, HammersteinWiener, PiecewiseLinear, track

LEVEL = 50.0
PLANT = HammersteinWiener(1, 2, input=PiecewiseLinear([0.0]), output=PiecewiseLinear([LEVEL]), intercept=True)


def record(seed, u=None):
    """y about 50 +- 5, bent at 50, and u."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=600) if u is None else u
    bent, x = u + 0.5 * np.maximum(u, 0.0), np.zeros(len(u))
    for t in range(2, len(u)):
        x[t] = 0.6 * x[t - 1] + bent[t - 1] + 0.5 * bent[t - 2] + 0.05 * rng.normal()
    return LEVEL + 2.7 * np.where(x > 0.0, 0.7 * x, x), u


def gated(*given):
    return track(*given, gate=True)


def error(tracker, y, u, after, truth):
    run = gated(PLANT, tracker, y, u)
    return run, np.sqrt(np.nanmean((run.prediction - truth)[after : after + 200] ** 2))


@pytest.mark.parametrize("tracker", [AdaptiveKalman(), RLS(1.0)], ids=repr)
@pytest.mark.parametrize("code", [-999.0, 0.0, 1e6])
@pytest.mark.parametrize("at", [[300], [20, 150, 300], [300, 301, 302], [8]], ids=str)
def test_a_code_in_the_output_is_no_part_of_its_curve(tracker, code, at):
    found = []
    for seed in range(3):
        y, u = record(seed)
        codes, gaps = y.copy(), y.copy()
        codes[at], gaps[at] = code, np.nan
        after = max(max(at) + 4, 30)  # what was reported before the first samples were judged stays
        run, wrong = error(tracker, codes, u, after, y)
        _, missing = error(tracker, gaps, u, after, y)
        found.append(wrong < 1.5 * missing)
        assert len(run.left_out) <= len(at) + 1
    assert sum(found) >= 2


def test_responses_to_large_inputs_and_new_levels_are_learned():
    """Rare pulses after small noise, and an output that steps: nothing is refused for long."""
    rng = np.random.default_rng(1)
    pulses = np.where(rng.random(600) < 0.02, 20.0, 0.0) + 0.1 * rng.normal(size=600)
    for y, u in (record(1, pulses), record(2)):
        stepped = y + np.where(np.arange(600) > 400, 150.0, 0.0)
        assert len(gated(PLANT, RLS(1.0), y, u).left_out) <= 3
        assert gated(PLANT, RLS(1.0), stepped, u).ok[410:].mean() > 0.97


def test_minimal_parameters_and_the_likelihood_of_a_single_knot():
    y, u = record(3)
    y[[300, 301]] = -999.0
    run = gated(PLANT, ExtendedKalman(q=1e-7, r=0.02, theta0=0.3), y, u)
    assert len(run.left_out) == 2
    assert np.isfinite(run.loglik)
    assert any(name == "Left out" for name, _ in run.summary().remarks)


@pytest.mark.parametrize("signal", ["y", "u"])
@pytest.mark.parametrize("output", [None, PiecewiseLinear([LEVEL])], ids=["linear", "bent"])
def test_a_code_does_not_mislead_the_filter_of_minimal_parameters(signal, output):
    plant = HammersteinWiener(1, 2, input=PiecewiseLinear([0.0]), output=output, intercept=True)
    tracker = ExtendedKalman(q=1e-7, r=0.02, theta0=0.3)
    for seed in range(2):
        y, u = record(seed)
        codes, gaps = {"y": y.copy(), "u": u.copy()}, {"y": y.copy(), "u": u.copy()}
        for at, code in (([100], -999.0), ([200, 201, 202], 9999.0), ([350], 0.0 if signal == "y" else 30.0)):
            codes[signal][at], gaps[signal][at] = code, np.nan
        run, missing = (gated(plant, tracker, record["y"], record["u"]) for record in (codes, gaps))
        wrong, least = (np.sqrt(np.nanmean((one.prediction - y)[360:] ** 2)) for one in (run, missing))
        assert wrong < 1.2 * least
        assert any(name == ("Left out" if signal == "y" else "Inputs left out") for name, _ in run.summary().remarks)

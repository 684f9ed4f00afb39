"""What the gate leaves out as a fault code is missing for the methods with which it is compared, too."""

import numpy as np
import pytest

from driftfit import ARX, RLS, AdaptiveKalman, HammersteinWiener, Polynomial, Regression, track
from driftfit.judge.compare import compare

T = 400
PLAIN, LAGS = Regression(1), ARX(1, 1)
LATER, START = (90, 91, 180, 300), (3,)
HELD = RLS(0.99)


def record(model, drift=0.0):
    """A system whose coefficient of the input grows by ``drift``."""
    rng = np.random.default_rng(5)
    u, e = rng.normal(size=T), 0.3 * rng.normal(size=T)
    y, b = 2.0 * u + e, 1.0 + drift * np.linspace(0.0, 1.0, T)
    for t in range(1, T if model is LAGS else 0):
        y[t] = 0.7 * y[t - 1] + b[t] * u[t - 1] + e[t]
    return (y if model is LAGS else y + drift * np.linspace(0.0, 1.0, T) * u), u


def replaced(y, places, code):
    y = y.copy()
    y[list(places)] = code
    return y


def errors(run):
    """How many samples are compared, and the errors of all but the run: in the verdict, and in the summary."""
    verdict, shown = run.verdict(), compare(run)
    return [verdict.scored, *(rival.rms for rival in verdict.rivals), *shown[1:]]


@pytest.mark.parametrize("code", [-999.0, 9999.0])
@pytest.mark.parametrize("places", [LATER, START])
@pytest.mark.parametrize("tracker", [HELD, AdaptiveKalman()], ids=["RLS", "AdaptiveKalman"])
@pytest.mark.parametrize("model", [PLAIN, LAGS], ids=["Regression", "ARX"])
def test_codes_are_missing_readings(model, tracker, places, code):
    y, u = record(model)
    run = track(model, tracker, replaced(y, places, code), u, gate=True)
    missing = track(model, tracker, replaced(y, places, np.nan), u, gate=True)
    assert errors(run) == pytest.approx(errors(missing), rel=0.02)
    assert run.verdict().p == pytest.approx(missing.verdict().p, rel=0.2)
    assert not run.verdict().pays


def test_a_code_in_an_input_soon_after_the_start_is_not_learned_by_rivals():
    y, u = record(LAGS)
    run, whole = (track(LAGS, AdaptiveKalman(), y, one) for one in (replaced(u, (15,), -1e6), u))
    assert run.left_out.counts == {"Left out at the start": 1}
    assert errors(run)[1:] == pytest.approx(errors(whole)[1:], rel=0.02)


@pytest.mark.parametrize("tracker", [HELD, AdaptiveKalman()], ids=["RLS", "AdaptiveKalman"])
def test_a_start_is_not_scored_however_late_it_is(tracker):
    """The first readings were those after the samples that are not scored, and least squares fitted a code."""
    y, u = record(LAGS)
    y[:120] = np.nan
    y[123] = 9999.0
    made = compare(track(LAGS, tracker, y, u, gate=True))
    assert made.tracked < 1.1 * made.constant_ls
    assert made.constant_ls < 0.4
    assert made.samples == T - 120 - 50


def test_a_drift_is_still_found():
    y, u = record(PLAIN, 2.0)
    verdict = track(PLAIN, AdaptiveKalman(), replaced(y, LATER, 9999.0), u).verdict()
    assert verdict.drifts
    assert verdict.pays


def test_units_do_not_matter():
    y, u = record(LAGS)
    y = replaced(y, LATER, 9999.0)
    plain, small = (track(LAGS, HELD, unit * y, u / unit, gate=True).verdict() for unit in (1.0, 1e-6))
    assert small.p == pytest.approx(plain.p, rel=1e-6)
    assert 1e6 * small.constants.rms == pytest.approx(plain.constants.rms, rel=1e-6)


@pytest.mark.parametrize("model", [PLAIN, LAGS], ids=["Regression", "ARX"])
def test_nobody_learns_from_a_code_in_an_input(model):
    y, u = record(model)
    verdict, clean = (track(model, HELD, y, one, gate=True).verdict() for one in (replaced(u, (120, 250), 9999.0), u))
    for rival, other in zip(verdict.rivals, clean.rivals, strict=True):
        assert rival.rms < 1.2 * other.rms
    assert not verdict.drifts


@pytest.mark.filterwarnings("ignore:y has a root mean square")
def test_a_curve_of_the_output_has_the_code_in_its_regressors():
    y, u = record(LAGS)
    curve = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2))
    verdict = track(curve, AdaptiveKalman(), replaced(y, LATER, 9999.0), u).verdict()
    assert not verdict.pays
    assert all(rival.rms < 2.0 for rival in verdict.rivals)


def test_several_series():
    y, u = record(PLAIN)
    faulty = replaced(y, LATER, 9999.0)
    fleet = track(PLAIN, AdaptiveKalman(), np.stack([y, faulty]), np.stack([u, u]), by="row")
    assert not any(row.pays for row in fleet.verdict().rows)
    assert all(unit.persistence < 10.0 for unit in fleet.summary().units)

"""Behind the gate one fault code, in y or in an input, at any place and of any size, does no tracker any harm."""

import numpy as np
import pytest
from scipy.signal import lfilter

from driftfit import (
    ARMAX,
    ARX,
    FLS,
    OE,
    RLS,
    AdaptiveKalman,
    BoxJenkins,
    InstrumentalVariables,
    JointKalman,
    Kalman,
    ParticleFilter,
    Regression,
    StateSpace,
    track,
)

T, THETA = 500, (1.1, -0.5, 1.0, 0.5)
PLANT = ARX(2, 2)
LINES = StateSpace("y = theta.a1 * y[-1] + theta.a2 * y[-2] + theta.b1 * u[-1] + theta.b2 * u[-2]", start=0.0)
PRIOR = {"q": 1e-7, "r": 0.01, "p0": 1.0}
DIFFUSE = [
    RLS(0.99), RLS(1.0), RLS(0.99, kind="directional"), Kalman(q=1e-7, r=0.01), Kalman(q=1e-7, r=0.01, form="sqrt"),
    InstrumentalVariables(0.99), FLS(1e5),
]  # fmt: skip
PAIRS = [
    *((PLANT, one) for one in DIFFUSE), (PLANT, Kalman(**PRIOR)),
    (LINES, JointKalman(**PRIOR)), (LINES, ParticleFilter(20, **PRIOR)),
]  # fmt: skip
CODES = (99.0, 9999.0, -1e6, 1e9)


def plant(scale=1.0, seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(2, T):
        y[t] = THETA[0] * y[t - 1] + THETA[1] * y[t - 2] + THETA[2] * u[t - 1] + THETA[3] * u[t - 2]
        y[t] += 0.1 * rng.normal()
    return scale * y, u


def broken(places, scale=1.0):
    """y and u (cases, T), each with one code at one place of one signal; the first is whole."""
    y, u = plant(scale)
    rows = [(y, u)]
    for at in places:
        for code in CODES:
            bad = [y.copy(), u.copy()]
            bad[0][at] = code * scale
            rows.append((bad[0], u))
            bad[1][at] = code
            rows.append((y, bad[1]))
    return [np.stack(part) for part in zip(*rows, strict=True)]


def gated(*given, **more):
    return track(*given, gate=True, **more)


def named(pair):
    return f"{type(pair[0]).__name__}, {pair[1]!r}"


@pytest.mark.parametrize("pair", PAIRS, ids=named)
def test_a_fault_code_in_the_middle_does_no_harm(pair):
    fleet = gated(*pair, *broken([15, 100, 350]), by="row")
    whole = fleet[0].theta
    for k in range(1, len(fleet)):
        away = np.abs(fleet[k].theta - whole)[:, :4].max(1)
        assert away[200] < 0.03 if k < 17 else away[400] < 0.02, k
        assert away[-1] < 0.01, k
        assert len(fleet[k].left_out), k


@pytest.mark.parametrize("tracker", DIFFUSE, ids=repr)
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_a_fault_code_at_the_start_does_no_harm_in_any_unit(tracker, scale):
    if scale != 1.0 and isinstance(tracker, Kalman | FLS):
        pytest.skip("q, r and mu are in units")
    fleet = gated(PLANT, tracker, *broken([0, 2, 3, 5, 8], scale), by="row")
    unit = np.array([1.0, 1.0, scale, scale])
    for k in range(1, len(fleet)):
        away = np.abs(fleet[k].theta - fleet[0].theta) / unit
        assert away[60].max() < 0.02, k
        assert away[-1].max() < 0.001, k


@pytest.mark.parametrize("model", [Regression(1), ARX(1, 1)], ids=repr)
@pytest.mark.parametrize("tracker", [RLS(0.99), Kalman(q=1e-7, r=0.01)], ids=repr)
def test_no_sample_is_between_those_judged_together_and_those_judged_alone(model, tracker):
    """With few parameters a start had fewer samples than the judging of single samples waits for."""
    _, u = plant()
    y = lfilter([0.0, 1.0], [1.0, -0.7], u) + 0.1 * np.random.default_rng(1).normal(size=T)
    y[2] = y[1]  # a reading that repeats itself counts once
    rows = np.repeat([y[:200], u[:200]], 21, axis=0).reshape(2, 21, -1)
    rows[0, range(1, 21), range(20)] = 9999.0
    fleet = gated(model, tracker, *rows, by="row")
    assert max(np.abs(fleet[k].theta[-1] - fleet[0].theta[-1]).max() for k in range(21)) < 0.05


@pytest.mark.parametrize(
    ("model", "tracker"),
    [(one, RLS(0.99)) for one in (OE(1, 1), BoxJenkins(), ARMAX(2, 2, 1))] + [(OE(1, 1), AdaptiveKalman())],
    ids=repr,
)
@pytest.mark.parametrize("at", [1, 3, 6, 7, 8])
def test_models_that_compute_signals_begin_without_the_fault(model, tracker, at):
    """What they compute with a wrong estimate is in later regressors."""
    y, u = plant()
    y, u = y[:200], u[:200]
    clean = gated(model, tracker, y, u).theta[-1]
    found = gated(model, tracker, np.where(np.arange(200) == at, 1e7, y), u).theta[-1]
    np.testing.assert_allclose(found, clean, atol=0.2)


FILTERED = pytest.mark.xfail(reason="filters of refused inputs are held instead of continued", strict=True)


@pytest.mark.parametrize(
    ("model", "tracker", "codes"),
    [
        *((one, RLS(0.99), codes) for one in (OE(2, 2), ARMAX(2, 2, 1)) for codes in (1, 4, 10)), (PLANT, RLS(1.0), 10),
        *((OE(2, 2), InstrumentalVariables(0.99), codes) for codes in (1, 4)),
        pytest.param(OE(2, 2), InstrumentalVariables(0.99), 10, marks=FILTERED),
    ],
)  # fmt: skip
def test_an_input_with_codes_and_a_simulated_output(model, tracker, codes):
    y, u = plant()
    u[250 : 250 + codes] = 9999.0
    run, whole = gated(model, tracker, y, u), gated(model, tracker, *plant())
    assert np.abs(run.theta[-1] - whole.theta[-1]).max() < 0.05


@pytest.mark.parametrize(
    "tracker",
    [RLS(0.9), RLS(1.0, p0=100.0), RLS(0.99, kind="directional"), Kalman(q=0.0, r=0.01, p0=100.0)],
    ids=["diffuse", "prior", "directional", "Kalman"],
)
def test_a_sample_with_an_innovation_has_a_variance(tracker):
    """Regressors that agree in all digits leave P without any: its next variance is below 0, and the noise scale was
    learned from that."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        x, bad = rng.normal(size=(300, 2)), rng.random(300) < 0.1
        code = 10.0 ** rng.uniform(0.0, 20.0, 300) * rng.choice([-1.0, 1.0], 300)
        x[bad] = np.stack([code, code + 1.0], axis=1)[bad]
        run = gated(Regression(2), tracker, x[:, 0] - x[:, 1] + 0.1 * rng.normal(size=300), x)
        assert not np.isnan(run.innovation_std[np.isfinite(run.innovation)])[10:].any()
        assert np.isfinite(run.theta).all()

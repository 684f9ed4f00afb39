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


@pytest.mark.parametrize("model", [Regression(1), ARX(1, 1), PLANT], ids=repr)
@pytest.mark.parametrize("tracker", [RLS(0.99), Kalman(q=1e-7, r=0.01)], ids=repr)
def test_no_sample_is_between_those_judged_together_and_those_judged_alone(model, tracker):
    """With few parameters a start had fewer samples than the judging of single samples waits for."""
    y, u = plant()
    if model is not PLANT:
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


@pytest.mark.parametrize("signal", [0, 1])
def test_a_fault_code_at_the_very_first_reading_does_no_harm(signal):
    """It is in one equation only, as a lag, and may leave the residuals of the others little larger."""
    clean = np.array([plant(seed=seed) for seed in range(40)]).swapaxes(0, 1)[..., :200]
    bad = clean.copy()
    bad[signal, :, 0] = 9999.0
    whole, fleet = (gated(PLANT, RLS(1.0), *both, by="row") for both in (clean, bad))
    assert max(np.abs(fleet[k].theta[-1] - whole[k].theta[-1]).max() for k in range(40)) < 0.05


@pytest.mark.parametrize("tracker", DIFFUSE, ids=repr)
def test_two_fault_codes_among_the_first_ten_samples_do_no_harm(tracker):
    """They are in six of the first eight equations, so the start waits for more."""
    y, u = plant()
    two = y.copy()
    two[[2, 7]] = 9999.0
    fleet = gated(PLANT, tracker, np.stack([y, two]), np.stack([u, u]), by="row")
    assert np.abs(fleet[1].theta - fleet[0].theta)[60].max() < 0.02
    assert fleet[1].left_out.sample.tolist() == [2, 7]


@pytest.mark.parametrize("tracker", [RLS(0.98), Kalman(q=1e-4, r=0.01)], ids=repr)
def test_what_is_no_fault_is_learned_from(tracker):
    """A large test, a gain that changes, and a new level a hundred deviations away, which costs a few samples."""
    rng = np.random.default_rng(3)
    u = 0.01 * rng.normal(size=T)
    u[200], u[300:] = 10.0, rng.normal(size=200)
    noise = 0.1 * rng.normal(size=T)
    run = gated(Regression(1), tracker, 2.0 * u + noise, u)
    assert not len(run.left_out)
    assert abs(run.theta[200, 0] - 2.0) < 0.05
    u = rng.normal(size=T)
    run = gated(Regression(1), tracker, np.where(np.arange(T) < 250, 2.0, -4.0) * u + noise, u)
    assert not len(run.left_out)
    run = gated(Regression(0, intercept=True), tracker, np.where(np.arange(T) < 250, 0.0, 10.0) + noise)
    assert len(run.left_out) <= 3
    assert abs(run.theta[-1, 0] - 10.0) < 0.1


RUNS = {
    "one code": lambda y: np.full_like(y, 9999.0),
    "of either sign": lambda y: np.where(np.arange(y.size).reshape(y.shape) * 7 % 5 < 3, -999.0, 999.0),
    "in turn": lambda y: np.where(np.arange(y.shape[1]) % 2 == 0, 9999.0, -999.0) + 0.0 * y,
    "with good readings between": lambda y: np.where(np.arange(y.shape[1]) % 4 == 3, y, -999.0),
    "after a gap": lambda y: np.where(np.arange(y.shape[1]) < 5, np.nan, -999.0) + 0.0 * y,
}


@pytest.mark.parametrize("run", list(RUNS))
@pytest.mark.parametrize("tracker", DIFFUSE, ids=repr)
def test_a_run_of_codes_is_a_gap(tracker, run):
    """Up to the sixteenth repeat, after which nothing may tell a code from a level."""
    y, u = np.array([plant(seed=seed) for seed in range(8)]).swapaxes(0, 1)
    bad = y.copy()
    bad[:, 200:216] = RUNS[run](bad[:, 200:216])
    gaps, fleet = (
        gated(PLANT, tracker, np.where(bad == y, y, np.nan), u, by="row"),
        gated(PLANT, tracker, bad, u, by="row"),
    )
    for k in range(8):
        np.testing.assert_allclose(fleet[k].theta, gaps[k].theta, atol=1e-9)
        assert len(fleet[k].left_out) == np.sum(np.isfinite(bad[k]) & (bad[k] != y[k]))


@pytest.mark.filterwarnings("ignore:.*2 values look like fault codes")  # the two that the jump costs behind a gate
@pytest.mark.parametrize("tracker", [RLS(0.99), Kalman(q=1e-4, r=0.01)], ids=repr)
@pytest.mark.parametrize("level", [100.0, 1e4])
@pytest.mark.parametrize("gap", [0, 5])
def test_a_new_level_costs_two_samples_also_after_a_gap(tracker, level, gap):
    """After that the tracker does as well as without a gate, within a tenth."""
    y, u = plant(seed=1)
    y[250:] += level
    y[250 : 250 + gap] = np.nan
    model = ARX(2, 2, intercept=True)
    run, off = gated(model, tracker, y, u), track(model, tracker, y, u)
    assert len(run.left_out) <= 3
    errors = [np.median(np.abs(one.innovation[300:])) for one in (run, off)]
    assert errors[0] < 1.1 * errors[1]


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

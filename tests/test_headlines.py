"""Sentences to act on: in constant systems tracking does not pay, and columns that say nothing are named."""

import numpy as np
import pytest
from scipy import signal

from driftfit import RLS, BoxJenkins, ExtendedKalman, HammersteinWiener, Kalman, Polynomial, Regression, track
from driftfit.show.report import page

T = 300


def transfer_record(seed, moves=0.0, mean=10.0):
    """A constant Box-Jenkins system around a mean; or its gain is larger by ``moves`` in the second half."""
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=(2, T))
    gain = np.where(np.arange(T) < T // 2, 1.0, 1.0 + moves)
    y = signal.lfilter([0.0, 1.0], [1.0, -0.8], gain * u) + 0.3 * signal.lfilter([1.0, 0.5], [1.0, -0.6], e)
    return mean + y, u


def test_constants_of_a_transfer_function_are_not_those_of_its_poor_start():
    """Its first regressors are those of filters that are not known yet, which a tracker forgets."""
    runs = [track(BoxJenkins(offset=True), RLS(1.0), *transfer_record(seed)) for seed in range(4)]
    verdicts = [run.verdict() for run in runs]
    assert [one.pays for one in verdicts] == [False] * 4
    assert sum(bool(one.drifts) for one in verdicts) <= 1
    assert all(one.rivals[1].rms < 0.36 for one in verdicts)  # the noise is 0.3; it was 0.5 to 0.65
    moved = track(BoxJenkins(offset=True), RLS(1.0), *transfer_record(0, 0.8)).verdict()
    assert moved.drifts


@pytest.mark.filterwarnings("ignore:y has a root mean square")
@pytest.mark.parametrize("output", [None, Polynomial(2)], ids=["linear", "curved"])
def test_a_few_fault_codes_are_no_drift_of_a_hammerstein_wiener_system(output):
    model = HammersteinWiener(1, 2, input=Polynomial(2), output=output)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u, e = rng.uniform(-1.0, 1.0, size=500), 0.02 * rng.normal(size=500)
        y = signal.lfilter([0.0, 0.6, 0.3], [1.0, -0.5], u + 0.4 * u * u) + signal.lfilter([1.0], [1.0, -0.5], e)
        y[rng.choice(np.arange(60, 490), 4, replace=False)] = 9999.0
        run = track(model, ExtendedKalman(q=1e-6, r=4e-4), y, u, gate=True)
        verdict = run.verdict()
        assert verdict.drifts is False
        assert verdict.pays is False
        assert verdict.rms < 0.03
        assert np.isfinite(verdict.rivals[2].rms)
        assert "4 samples far outside" in str(run.summary())


def columns(kind, moves):
    """A regression on two inputs, a column that says nothing new, and a constant; and the expected group."""
    rng = np.random.default_rng(1)
    u, w, e = rng.normal(size=(3, 400))
    b = np.where(np.arange(400) < 200, 1.0, 1.0 + moves)
    third, group, held = {
        "repeated": (u, ("theta1", "theta3"), "theta3"),
        "in another unit": (1.8 * u + 32.0, ("theta1", "theta3", "intercept"), "theta3"),
        "a sum": (u - 2.0 * w, ("theta1", "theta2", "theta3"), "theta3"),
        "constant": (np.full(400, 7.0), ("theta3", "intercept"), "theta3"),
        "zero": (np.zeros(400), (), "theta3"),
    }[kind]
    return b * u + w + 2.0 + 0.5 * e, np.column_stack([u, w, third]), group, held


@pytest.mark.filterwarnings("ignore:.*could not be learned")
@pytest.mark.parametrize("kind", ["repeated", "in another unit", "a sum", "constant", "zero"])
def test_a_column_that_says_nothing_new_is_named_and_the_rest_is_judged(kind):
    for moves in (0.0, 1.0):
        y, u, group, held = columns(kind, moves)
        run = track(Regression(3, intercept=True), Kalman(q=1e-3, r=0.25), y, u)
        verdict = run.verdict()
        assert verdict.drifts is bool(moves)
        assert verdict.held == (held,)
        assert verdict.dependent == ((group,) if group else ())
        assert not verdict.parameters[2].moves
        assert verdict.moving == (("theta1",) if moves else ())
        named = " and ".join([", ".join(group[:-1]), group[-1]]) if group else held
        assert named in " ".join(verdict.sentences)
        assert verdict.samples == 400
    assert "No drift" not in str(verdict)
    run.diagnose().plot()


def test_a_report_does_not_say_no_of_a_parameter_that_was_not_judged():
    y, u, *_ = columns("zero", 1.0)
    text = page(track(Regression(3, intercept=True), Kalman(q=1e-3, r=0.25), y, u))
    row = text[text.index("<td>theta3") :].split("</tr>")[0]
    assert "<td>no</td>" not in row


def test_a_record_without_any_regressor_can_tell_nothing():
    y = np.random.default_rng(0).normal(size=300)
    verdict = track(Regression(2), RLS(0.99), y, np.zeros((300, 2))).verdict()
    assert verdict.drifts is None
    assert "cannot show" in str(verdict)


def regression_record(seed, size, growth=0.0, noise=0.3):
    """A gain that is 1, and 1 + size in the second half; the noise grows by exp(growth) over the record."""
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=(2, T))
    gain = np.where(np.arange(T) < T // 2, 1.0, 1.0 + size)
    return gain * u + noise * np.exp(growth * np.linspace(-0.5, 0.5, T)) * e, u


@pytest.mark.parametrize("growth", [5.0, -5.0])
def test_the_date_of_a_headline_is_that_of_its_interval_whatever_the_noise(growth):
    """Noise that grows over the record moved the extreme point of the path to where the record is noisiest."""
    for seed in range(8):
        verdict = track(Regression(1), RLS(1.0), *regression_record(seed, 0.5, growth, 0.1)).verdict()
        (moved,) = verdict.parameters
        assert moved.earliest <= moved.at <= moved.latest
        assert abs(moved.at - T // 2) < 15
        assert f"at {moved.at} " in verdict.sentences[1]


def test_a_count_that_stops_growing_is_dated_where_it_does():
    rng = np.random.default_rng(5)
    y = np.full(T, 50.0)
    for t in range(1, T):
        y[t] = rng.poisson((1.05 if t < T // 2 else 0.97) * y[t - 1] + 1.0)
    (moved,) = track(Regression(1), RLS(1.0), y[1:], y[:-1]).verdict().parameters
    assert (moved.earliest, moved.at, moved.latest) == (149, 149, 149)  # without its first sample


def test_steps_of_two_parameters_at_one_event_have_one_date():
    """The interval of each is not cut off at the step of the other."""
    rng = np.random.default_rng(0)
    for _ in range(4):
        u, e = rng.normal(size=(2, 400))
        t = np.arange(400)
        y = (1.0 + 0.4 * (t >= 200)) * u + 0.3 * (t >= 206) + 0.3 * e
        slope, level = track(Regression(1, intercept=True), RLS(1.0), y, u).verdict().parameters
        assert slope.at == level.at
        assert 199 <= slope.at <= 207


@pytest.mark.parametrize("kind", ["exact", "rare"])
def test_a_step_that_leaves_no_noise_to_test_is_named(kind):
    y, u = regression_record(0, 0.5, noise=0.0)
    if kind == "rare":
        chance = np.where(np.arange(400) < 200, 0.02, 0.5)
        y, u = (np.random.default_rng(4).random(401)[1:] < chance).astype(float), np.ones(400)
    verdict = track(Regression(1), RLS(1.0), y, u).verdict()
    (moved,) = verdict.parameters
    assert moved.moves
    assert verdict.p < 1e-4
    assert 0.2 < moved.after - moved.before < 0.6
    assert abs(moved.at - len(y) // 2) <= (0 if kind == "exact" else 12)

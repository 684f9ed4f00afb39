"""The model put to use: poles, gains, responses against scipy and by hand; predictions and simulation."""

import numpy as np
import pytest
from scipy import signal
from support import arx_record, damaged

from driftfit import ARX, AugmentedFLS, Kalman, Regression, track
from driftfit.use.simulate import fit
from driftfit.use.system import fieller, jacobian

K = Kalman(q=1e-3, r=0.01)


@pytest.fixture(scope="module")
def run():
    return track(ARX(2, 2), K, *arx_record(400, 6))


@pytest.fixture(scope="module")
def still():
    return track(ARX(2, 2), Kalman(q=0.0, r=0.01), *arx_record(400, 6))


def test_poles_are_the_roots(run):
    got = run.poles()
    assert got.shape == (400, 2)
    for t in (50, 399):
        expected = np.roots([1.0, *-run.theta[t, :2]])
        assert np.sort_complex(got[t]) == pytest.approx(np.sort_complex(expected))
    assert run.largest_pole(at=-1).value[0] == pytest.approx(np.abs(got[-1, 0]))
    assert run.poles(at=-1) == pytest.approx(got[-1:])


def test_gain_and_its_error_are_the_textbook_formulas(run):
    a, b = run.theta[-1, :2].sum(), run.theta[-1, 2:].sum()
    J = np.array([*[b / (1 - a) ** 2] * 2, *[1 / (1 - a)] * 2])
    got, several = run.dc_gain(at=-1), run.dc_gain()
    assert got.value[0, 0] == pytest.approx(b / (1 - a))
    assert got.std[0, 0] == pytest.approx(np.sqrt(J @ run.cov(-1) @ J), rel=1e-4)
    assert several.std[-1] == pytest.approx(got.std[0])
    (effect,) = run.long_run()
    assert (effect.value, effect.std) == (pytest.approx(b / (1 - a)), pytest.approx(got.std[0, 0]))
    assert effect.low < effect.value < effect.high


def test_fieller_is_the_interval_that_inverts_the_test():
    theta, cov, z = np.array([0.6, 1.0]), np.array([[0.004, 0.001], [0.001, 0.003]]), 1.96
    top, over = np.array([0.0, 1.0]), np.array([-1.0, 0.0])
    low, high = fieller(theta, cov, top, over, 1.0, z)
    for g in (low, high):
        c = top - g * over
        assert (theta[1] - g * (1.0 - theta[0])) ** 2 == pytest.approx(z * z * c @ cov @ c)
    assert fieller(np.array([1.0, 1.0]), cov, top, over, 1.0, z) == (-np.inf, np.inf)


def test_responses_are_those_of_scipy(run):
    system = run.to_scipy()
    _, (step,) = signal.dstep(system, n=30)
    _, (impulse,) = signal.dimpulse(system, n=30)
    assert run.step_response(30).value[0] == pytest.approx(step[:, 0])
    assert run.impulse_response(30).value[0] == pytest.approx(impulse[:, 0])
    w, H = signal.dfreqresp(system, w=[0.1, 1.0, 3.0])
    got = run.frequency_response(w)
    assert got.magnitude[0] == pytest.approx(np.abs(H))
    assert np.exp(1j * got.phase[0]) == pytest.approx(H / np.abs(H))
    assert run.poles(at=-1)[0] == pytest.approx(np.sort_complex(system.poles)[::-1])


def test_bands_are_those_of_drawn_parameters(still):
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(still.theta[-1], still.cov(-1), 4000)
    steps = np.array(
        [signal.lfilter([0.0, *b], [1.0, *-a], np.ones(12)) for a, b in zip(drawn[:, :2], drawn[:, 2:], strict=True)]
    )
    got = still.step_response(12)
    assert got.std[0, 1:] == pytest.approx(steps.std(axis=0)[1:], rel=0.06)
    H = np.array(
        [signal.freqz([0.0, *b], [1.0, *-a], [0.3, 1.5])[1] for a, b in zip(drawn[:, :2], drawn[:, 2:], strict=True)]
    )
    response = still.frequency_response([0.3, 1.5])
    assert response.log_magnitude_std[0] == pytest.approx(np.log(np.abs(H)).std(axis=0), rel=0.06)
    assert response.phase_std[0] == pytest.approx(np.angle(H / H.mean(axis=0)).std(axis=0), rel=0.06)


def test_gains_and_responses_print_tables(run):
    """A row for each sample, twenty at most, or for each step of the response of one sample."""
    gain, step = run.dc_gain(), run.step_response(8)
    for found, value, std, count in (
        (gain, gain.value[-1, 0], gain.std[-1, 0], 20),
        (step, step.value[0, -1], step.std[0, -1], 8),
    ):
        lines = str(found).rstrip().splitlines()
        assert lines[-1].split()[1:] == [f"{value:.4g}", f"{std:.3g}"]
        assert len(lines) == 4 + count
        assert repr(found) == str(found).strip("\n")
    assert gain[0] is gain.value


def test_several_inputs_by_name():
    y, u = arx_record(300, 2)
    both = np.column_stack([u, np.random.default_rng(4).normal(size=300)])
    run = track(ARX(1, (1, 2), nk=(1, 0), inputs=["gas", "air"]), K, y, both)
    assert run.dc_gain(at=-1).value.shape == (1, 2)
    assert run.step_response(5, "air").value == pytest.approx(run.step_response(5, 1).value)
    assert [effect.name for effect in run.long_run()] == ["gas", "air"]
    with pytest.raises(ValueError, match="there is gas, air"):
        run.step_response(5, "water")
    with pytest.raises(ValueError, match="must be 0"):
        run.step_response(5, 2)


def test_jacobian_of_a_known_function():
    theta = np.array([[1.0, 2.0], [3.0, 4.0]])
    got = jacobian(lambda x: np.stack([x[:, 0] * x[:, 1], x[:, 0] ** 2], axis=1), theta, np.full((2, 2), 0.1))
    assert got[0] == pytest.approx(np.array([[2.0, 1.0], [2.0, 0.0]]))


def test_one_step_ahead_is_the_prediction_of_the_run(run):
    got = run.ahead(1)
    assert got.y_hat[3:] == pytest.approx(run.prediction[3:])
    assert got.y_std[10:] == pytest.approx(run.innovation_std[10:])


def test_last_steps_ahead_are_the_forecast(run):
    y, u = arx_record(400, 6)
    before = track(ARX(2, 2), K, y[:395], u[:395])
    expected = before.forecast(5, u[395:])
    assert run.ahead(5).y_hat[-1] == pytest.approx(expected.y_hat[-1])


def test_bands_ahead_cover():
    covered = []
    for seed in range(5):
        y, u = arx_record(1000, 20 + seed)
        got = track(ARX(2, 2), Kalman(q=0.0, r=0.01), y, u).ahead(8)
        low, high = got.band(0.95)
        covered.append(np.mean(((y > low) & (y < high))[100:]))
    assert 0.93 < np.mean(covered) < 0.97


def test_ahead_with_holes_gaps_and_regressions():
    y, u = damaged(*arx_record(300, 5))
    assert np.isfinite(track(ARX(2, 2), K, y, u).ahead(3).y_hat).any()
    time = np.cumsum(np.where(np.arange(300) == 200, 5.0, 1.0))
    y, u = arx_record(300, 5)
    got = track(ARX(2, 2), K, y, u, time=time).ahead(3)
    assert np.isnan(got.y_hat[200:204]).all()
    assert np.isfinite(got.y_hat[[199, 204]]).all()
    plain = track(Regression(1, intercept=True), K, y, u).ahead(4)
    run = track(Regression(1, intercept=True), K, y, u)
    assert plain.y_hat[100] == pytest.approx(np.array([u[100], 1.0]) @ run.theta[96])
    assert np.isnan(track(ARX(2, 2), AugmentedFLS(mu=10.0), y, u).ahead(2).y_std).all()


def test_simulation_is_the_difference_equation_with_the_band_of_drawn_parameters(still):
    rng = np.random.default_rng(1)
    u = rng.normal(size=40)
    got = still.simulate(u)
    theta = still.theta[-1]
    assert got.y_hat == pytest.approx(signal.lfilter([0.0, *theta[2:]], [1.0, *-theta[:2]], u))
    drawn = rng.multivariate_normal(theta, still.cov(-1), 4000)
    outputs = np.array([signal.lfilter([0.0, *x[2:]], [1.0, *-x[:2]], u) for x in drawn])
    assert got.theta_std[5:] == pytest.approx(outputs.std(axis=0)[5:], rel=4.0 / np.sqrt(2.0 * len(drawn)))
    psi = signal.lfilter([1.0], [1.0, *-theta[:2]], np.eye(1, 40)[0])
    assert got.y_std**2 == pytest.approx(got.theta_std**2 + 0.01 * np.cumsum(psi**2), rel=1e-6)


def test_simulation_from_given_outputs(still):
    y, u = arx_record(60, 9)
    got = still.simulate(u, y=y[:10])
    assert got.y_hat[:10] == pytest.approx(y[:10])
    assert not got.y_std[:10].any()
    assert np.abs(got.y_hat - y).max() < 1.0
    with pytest.raises(ValueError, match="inputs"):
        still.simulate(np.ones((5, 2)))


def test_what_is_not_an_arx_model_says_so(run):
    plain = track(Regression(1), Kalman(q=1e-3, r=0.1), run.y, run.u)
    for question in (plain.poles, plain.dc_gain, plain.long_run, lambda: plain.step_response(3), plain.to_scipy):
        with pytest.raises(ValueError, match="belong to runs of ARX"):
            question()
    with pytest.raises(IndexError, match="within the record"):
        run.dc_gain(at=400)
    with pytest.raises(ValueError, match="ahead"):
        run.ahead(0)


def test_fit_is_that_of_the_field():
    y = np.array([1.0, 2.0, 4.0, np.nan, 3.0])
    assert fit(y, y) == 100.0
    assert fit(y, np.full(5, 2.5)) == pytest.approx(0.0)
    known = y[[0, 1, 2, 4]]
    expected = 100.0 * (1.0 - 1.0 / np.sqrt(np.sum((known - 2.5) ** 2)))
    assert fit(y, y + np.array([0.0, 1.0, 0.0, 5.0, 0.0])) == pytest.approx(expected)
    assert np.isnan(fit([2.0, 2.0], [1.0, 3.0]))
    assert np.isnan(fit([np.nan], [1.0]))
    with pytest.raises(ValueError, match="shape"):
        fit([1.0, 2.0], [1.0])


def test_picture_of_the_system_shows_what_is_computed(run):
    step, magnitude, plane, gain, *_ = run.plot_system(at=[100, 399], h=12).axes
    drawn = [line.get_ydata() for line in step.lines]
    assert np.allclose(drawn, run.step_response(12, at=[100, 399]).value)
    assert [text.get_text() for text in step.get_legend().get_texts()] == ["100", "399"]
    _, high = run.step_response(12, at=[100, 399]).band(0.95)
    (area,) = {round(float(c.get_paths()[0].get_extents().y1), 9) for c in step.collections[1:]}
    assert area == pytest.approx(high[1].max())
    assert np.allclose(magnitude.lines[1].get_ydata(), run.frequency_response(at=399).magnitude[0])
    points = np.concatenate([c.get_offsets() for c in plane.collections])
    assert {complex(*p) for p in points.round(9)} >= {complex(p) for p in run.poles(at=[60])[0].round(9)}
    assert np.allclose(gain.lines[0].get_ydata(), run.dc_gain().value[:, 0])
    with pytest.raises(ValueError, match="ARX"):
        track(Regression(1), K, np.ones(60), np.ones(60)).plot_system()


def test_picture_of_a_validation_says_the_fit(run):
    y, u = arx_record(100, 7)
    signal, error = run.plot_validation(y, u).axes
    result = run.simulate(u, y=y[:2])
    assert np.allclose(signal.lines[1].get_ydata(), result.y_hat)
    assert np.allclose(error.lines[0].get_ydata(), y - result.y_hat)
    assert signal.get_title(loc="left") == f"fit {fit(y[2:], result.y_hat[2:]):.1f} %"

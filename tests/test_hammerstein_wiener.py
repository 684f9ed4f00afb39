"""Stage one of Hammerstein-Wiener models: columns, the exact regression, missing data, bases, warnings."""

import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from support import same

from driftfit import ARX, RLS, ExtendedKalman, Kalman, Live, Track, track
from driftfit.engine.drivers import TrackerSteps, unknown
from driftfit.engine.kernel import kernel, nothing
from driftfit.models.hammerstein_wiener.basis import BSpline, Legendre, PiecewiseLinear, Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.systems.drift import RandomWalk
from driftfit.systems.hammerstein_wiener import CUBIC, NotMonotoneError, example, invert, simulate
from driftfit.trackers.base import Tracker

SMALL = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2))
K = Kalman(q=1e-5, r=1e-4, p0=1e4, theta0=0.01)
PAPER = Kalman(q=10.0, r=0.01, p0=1e8, theta0=0.01)


@kernel
def copy(o, s, l):
    for i in range(s.phi.shape[0]):
        o.phi[i, l] = s.phi[i, l]
    o.y[l] = s.y[l]


@dataclass(frozen=True)
class Still(Tracker):
    """Keeps theta0 and shows the regression; it compiles in a moment, whatever the order."""

    theta0: tuple = ()
    covariance = False
    outputs = ("phi", "y")

    def state(self, n):
        return {"theta": np.array(self.theta0) if self.theta0 else np.zeros(n)}

    @property
    def steps(self):
        return TrackerSteps(nothing, nothing, nothing, unknown, store=copy)


def seen_by(model, y, u):
    """phi (T, n) and z (T,) as a tracker sees them."""
    run = track(model, Still(), y, u)
    return run.written("phi"), run.written("y")


def rows(model, y, u):
    """phi and z by the equations of the model, a list of columns at a time; NaN where a lag lies before the record."""
    T = len(y)

    def late(x, k):
        return np.concatenate([np.full(min(k, T), np.nan), x[: max(T - k, 0)]])

    f, g = model.into.value(u), model.out.value(y)
    a, b, nk = range(1, model.na + 1), range(model.nb), model.nk
    columns = [late(g[:, 0], i) for i in a] + [-late(f[:, 0], nk + j) for j in b]
    columns += [g[:, k] for k in range(1, model.out.n)]
    columns += [-late(f[:, k], nk + j) for k in range(1, model.into.n) for j in b]
    columns += [late(g[:, k], i) for k in range(1, model.out.n) for i in a]
    return np.stack(columns + ([np.ones(T)] if model.intercept else []), axis=1), -g[:, 0]


def test_columns_are_those_written_by_hand():
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(2, 6))
    phi, z = seen_by(CUBIC, y, u)
    by_hand = [
        y[4], y[3], -u[4], -u[3], y[5] ** 2, y[5] ** 3,
        -(u[4] ** 2), -(u[3] ** 2), -(u[4] ** 3), -(u[3] ** 3), y[4] ** 2, y[3] ** 2, y[4] ** 3, y[3] ** 3,
    ]  # fmt: skip
    np.testing.assert_allclose(phi[5], by_hand, rtol=1e-15)
    assert z[5] == -y[5]
    assert CUBIC.names == (
        "A1", "A2", "b1", "b2", "d2", "d3", "b1*c2", "b2*c2", "b1*c3", "b2*c3", "A1*d2", "A2*d2", "A1*d3", "A2*d3",
    )  # fmt: skip


ORDERS = [(2, 2, 3, 3, 1), (3, 1, 4, 1, 2), (0, 3, 2, 4, 0)]


@pytest.mark.parametrize(("na", "nb", "n_in", "n_out", "nk"), ORDERS)
def test_the_regression_is_exact_without_noise(na, nb, n_in, n_out, nk):
    """Item 1 of the specification: with constants, and with lagged products of a random walk."""
    c, d = [0.3, -0.2, 0.05][: n_in - 1], [0.1, 0.3, 0.02][: n_out - 1]
    if n_out == 2:
        d = [0.05]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = HammersteinWiener(na, nb, nk, Polynomial(n_in), Polynomial(n_out))
    rng = np.random.default_rng(1)
    a, b = [-0.5, 0.2, -0.1][:na], [0.3, -0.2, 0.1][:nb]
    u = rng.uniform(-1.0, 1.0, 200)
    constant = simulate(model, a, b, c, d, T=200, rng=rng, u=u)
    walks = [[RandomWalk(x, 1e-3) for x in group] for group in (a, b, c, d)]
    walking = simulate(model, *walks, T=200, rng=rng, u=u)
    for s in (constant, walking):
        phi, z = rows(model, s.y, s.u)
        residual = np.sum(phi * s.theta, axis=1) - z
        used = np.isfinite(residual)
        assert used[max(na, nk + nb) :].all()
        assert np.abs(residual[used]).max() <= 1e-12
        got, _ = seen_by(model, s.y, s.u)
        assert same(got[used], phi[used])


def test_walking_parameters_need_lagged_products():
    squares = []
    for seed in range(6):
        s = example(1, seed, T=600)
        phi, z = rows(s.model, s.y, s.u)
        assert np.abs(np.sum(phi * s.theta, axis=1) - z)[2:].max() <= 1e-12
        now = s.model.structure.products(s.xi)
        squares.append(np.mean((np.sum(phi * now, axis=1) - z)[2:] ** 2))
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.008, abs=0.0005)  # the digit that section 3 gives


def test_the_signs_of_the_input_columns_matter():
    """Item 2: without the minus signs least squares gives -b."""
    s = simulate(CUBIC, [-0.6, 0.4], [0.7, -0.36], [0.4, -0.7], [-0.4, 0.6], T=400, rng=np.random.default_rng(2))
    phi, z = rows(s.model, s.y, s.u)
    phi, z = phi[2:].copy(), z[2:]
    phi[:, [2, 3, 6, 7, 8, 9]] *= -1.0
    assert np.abs(phi @ s.theta[3] - z).max() > 0.1
    np.testing.assert_allclose(np.linalg.lstsq(phi, z, rcond=None)[0][2:4], [-0.7, 0.36], atol=1e-9)


@pytest.mark.parametrize("theta0", [0.01, 10.0, 1000.0])
def test_any_start_is_forgotten_within_thirty_samples(theta0):
    """Item 12, on the products."""
    s = example(2, 1, T=260)
    run = track(s.model, Kalman(q=10.0, r=0.01, p0=1e8, theta0=theta0), s.y, s.u)
    error = np.linalg.norm(run.theta[:, :6] - s.model.structure.products(s.xi)[:, :6], axis=1)
    assert error[5] > 1.0
    assert (error[30:] < 0.05).all()


def test_hammerstein_and_wiener_are_the_general_model_with_identities():
    """Item 14, column for column."""
    rng = np.random.default_rng(5)
    y, u = rng.normal(size=(2, 40))
    for given, written in (
        ({"input": Polynomial(3)}, {"input": Polynomial(3), "output": Polynomial(1)}),
        ({"output": Polynomial(3)}, {"input": Polynomial(1), "output": Polynomial(3)}),
    ):
        short, long = (HammersteinWiener(2, 2, **bases) for bases in (given, written))
        assert short.names == long.names
        assert same(seen_by(short, y, u)[0][2:], rows(short, y, u)[0][2:])
        assert same(seen_by(long, y, u)[0], seen_by(short, y, u)[0])
        one, other = (track(m, Still((0.1,) * short.n), y, u).prediction for m in (short, long))
        assert same(one, other)


def test_identity_blocks_are_an_arx_with_other_signs():
    rng = np.random.default_rng(6)
    y, u = rng.normal(size=(2, 60))
    phi, z = seen_by(HammersteinWiener(2, 2), y, u)
    lags, _ = seen_by(ARX(2, 2), y, u)
    assert same(phi * [1, 1, -1, -1], lags)
    assert same(z, -y)
    theta = (0.5, -0.2, 0.3, 0.1)
    run = track(HammersteinWiener(2, 2), Still((-0.5, 0.2, 0.3, 0.1)), y, u)
    expected = np.sum(lags * theta, axis=1)
    np.testing.assert_allclose(run.prediction[2:], expected[2:], rtol=1e-14)


def test_the_prediction_is_the_root_of_the_equation():
    s = example(1, 2, T=400)
    run = track(s.model, PAPER, s.y, s.u)
    t = np.arange(60, 400)
    theta = run.theta[t - 1]
    phi, _ = rows(s.model, s.y, s.u)
    right = -np.sum(np.delete(phi[t] * theta, [4, 5], axis=1), axis=1)
    root = run.prediction[t]
    inside = (root > s.y[:60].min()) & (root < s.y[:60].max())
    assert inside.mean() > 0.9
    level = root + theta[:, 4] * root**2 + theta[:, 5] * root**3
    np.testing.assert_allclose(level[inside], right[inside], atol=1e-9)
    assert np.sqrt(np.mean((s.y - run.prediction)[t] ** 2)) == pytest.approx(0.0323 * s.y.std(), rel=0.01)
    equation = -s.y[t] - np.sum(phi[t] * theta, axis=1)
    np.testing.assert_allclose(run.innovation[t], equation, rtol=1e-7, atol=1e-12)


def test_a_missing_value_makes_the_samples_it_touches_unusable():
    s = example(1, 4, T=300)
    clean = track(s.model, K, s.y, s.u)
    for signal, needed in (("y", [100, 101, 102]), ("u", [101, 102])):
        record = {"y": s.y.copy(), "u": s.u.copy()}
        record[signal][100] = np.nan
        run = track(s.model, K, **record)
        assert np.flatnonzero(~run.ok)[2:].tolist() == needed == list(s.model.touched(100, signal))
        assert same(run.theta[:100], clean.theta[:100])
        assert same(run.theta[needed], np.repeat(run.theta[needed[0] - 1][None], len(needed), axis=0))
        before = run.std[needed[0] - 1]
        np.testing.assert_allclose(run.std[102], np.sqrt(before**2 + 1e-5 * len(needed)), rtol=1e-12)
        np.testing.assert_allclose(run.theta[-1], clean.theta[-1], atol=3e-5)
    hole = s.y.copy()
    hole[100] = np.nan
    assert np.isfinite(track(s.model, K, hole, s.u).prediction[100])  # its lags are there
    both = s.u.copy()
    both[200] = np.inf
    assert np.flatnonzero(~track(s.model, K, hole, both).ok)[2:].tolist() == [100, 101, 102, 201, 202]


def test_live_and_fleet_say_what_the_record_says(tmp_path):
    s = example(1, 5, T=200)
    y = s.y.copy()
    y[[50, 51, 90]] = np.nan
    run = track(s.model, K, y, s.u)
    live = Live(s.model, K)
    for t in range(200):
        if t == 95:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
        result = live.update(float(y[t]), float(s.u[t]))
        assert same(result[:2], (run.prediction[t], run.innovation[t]))
        assert same(live.theta, run.theta[t])
    fleet = track(s.model, K, np.stack([y, s.y]), np.stack([s.u, s.u]), by="row")
    assert same(fleet[0].theta, run.theta)
    run.save(tmp_path / "run")
    assert same(Track.load(tmp_path / "run").prediction, run.prediction)
    for kind in (y.tolist(), y.astype(np.float32), y.astype(object)):
        assert track(s.model, K, kind, s.u).ok.sum() == run.ok.sum()


def test_a_hammerstein_fleet_in_lanes_is_each_series_alone():
    model = SMALL
    rng = np.random.default_rng(7)
    ys, us = [], []
    for seed in range(12):
        s = simulate(
            model, [-0.5], [0.5], [0.2], [0.05], T=80, rng=rng, u=np.random.default_rng(seed).uniform(-1, 1, 80)
        )
        ys.append(s.y)
        us.append(s.u)
    fleet = track(model, K, np.stack(ys), np.stack(us), by="row")
    for key in (0, 5, 11):
        alone = track(model, K, ys[key], us[key])
        for name in ("theta", "prediction", "innovation_std"):
            assert same(getattr(fleet[key], name), getattr(alone, name)), name


def test_other_trackers_follow_it_too():
    rng = np.random.default_rng(4)
    u = rng.uniform(-1.5, 1.5, 800)
    s = simulate(SMALL, [-0.5], [0.5], [RandomWalk(0.3, 2e-3)], [0.1], T=800, rng=rng, u=u)
    run = track(SMALL, RLS(0.95), s.y, s.u)
    phi, z = rows(SMALL, s.y, s.u)
    for t in (100, 799):  # least squares with weights 0.95^(t - k)
        k = np.arange(1, t + 1)
        root = 0.95 ** (0.5 * (t - k))
        least = np.linalg.lstsq(phi[k] * root[:, None], z[k] * root, rcond=None)[0]
        np.testing.assert_allclose(run.theta[t], least, atol=1e-12)
    assert np.median(np.abs(run.theta[100:, :2] - s.theta[100:, :2])) == pytest.approx(7.25e-4, rel=0.01)
    scored = run.summary().comparison
    assert scored.tracked == pytest.approx(0.00656 * scored.persistence, rel=0.01)
    assert scored.tracked == pytest.approx(0.4247 * scored.constant_ls, rel=0.01)


def test_noise_aware_variances():
    """Section 8, a slow twin of the factor."""
    s = example(3, 1, T=200, snr_db=20.0)
    sigma = s.sigma
    model = HammersteinWiener(2, 2, input=Polynomial(3), output=Polynomial(3), output_noise=sigma)
    run = track(model, Kalman(q=4e-6, r=1.0, p0=1.0, theta0=0.01), s.y, s.u, keep="cov")
    phi, _ = rows(model, s.y, s.u)
    for t in (3, 4, 50, 199):
        before = run.theta[t - 1]
        slope = [1.0 + 2.0 * before[4] * s.y[t - i] + 3.0 * before[5] * s.y[t - i] ** 2 for i in range(3)]
        r = sigma**2 * np.sum(np.array([1.0, before[0], before[1]]) ** 2 * np.array(slope) ** 2) + 1e-4
        M = run.cov(t - 1) + 4e-6 * np.eye(14)
        np.testing.assert_allclose(run.innovation_std[t] ** 2, phi[t] @ M @ phi[t] + r, rtol=1e-7)
    live = Live(model, Kalman(q=4e-6, r=1.0, p0=1.0, theta0=0.01))
    for t in range(200):
        live.update(float(s.y[t]), float(s.u[t]))
    assert same(live.theta, run.theta[-1])


def test_inversion_and_what_cannot_be_inverted():
    """Item 4 of the specification."""
    rng = np.random.default_rng(9)
    w = rng.normal(size=50) * 2.0
    d = np.repeat([[1.0, -0.4, 0.6]], 50, axis=0)
    y = invert(Polynomial(3), d, w)
    assert np.abs(y - 0.4 * y**2 + 0.6 * y**3 - w).max() <= 1e-12
    for basis, weights in (
        (Polynomial(3), [1.0, -1.2, 0.3]), (Polynomial(2), [1.0, 0.6]), (PiecewiseLinear([0.5]), [1.0, -1.5]),
    ):  # fmt: skip
        with pytest.raises(NotMonotoneError, match="sample 0"):
            invert(basis, np.array([weights]), [-0.9 if basis == Polynomial(2) else 0.45])
    with pytest.raises(NotMonotoneError, match="does not reach w"):
        invert(Polynomial(2), np.array([[1.0, 0.1]]), [-10.0])
    with pytest.raises(NotMonotoneError, match="unstable from sample 0"):
        simulate(HammersteinWiener(1, 1), [-1.5], [1.0], T=200, rng=rng)


def test_what_does_not_fit_warns_and_names_the_remedy():
    with pytest.warns(UserWarning, match=r"use Legendre\(5"):
        Polynomial(5)
    rng = np.random.default_rng(10)
    y, u = rng.normal(size=(2, 50))
    with pytest.warns(UserWarning, match=r"u has a root mean square of .* use Legendre\(2"):
        track(HammersteinWiener(1, 1, input=Polynomial(2)), Still(), y, 100.0 * u)
    with_code = np.append(100.0 * u[:-1], -99999.0)  # which would give the basis a range that no other value reaches
    with pytest.warns(UserWarning, match=rf"use Legendre\(2, \({min(100.0 * u[:-1]):g}, {max(100.0 * u[:-1]):g}\)\)"):
        track(HammersteinWiener(1, 1, input=Polynomial(2)), Still(), y, with_code)
    track(HammersteinWiener(1, 1, input=Polynomial(2)), Still(), y, np.append(u[:-1], -999.0))  # no warning
    with pytest.warns(UserWarning, match=r"samples of y lie outside .* Legendre and are beyond"):
        track(HammersteinWiener(1, 1, output=Legendre(2, (-1, 1))), Still(), y, u)
    with pytest.warns(UserWarning, match=r"samples of u lie outside .* BSpline and are missing"):
        run = track(HammersteinWiener(1, 1, input=BSpline(2, (-1, 0, 1))), Still(), y, u)
    assert np.flatnonzero(~run.ok[2:]).tolist() == [t - 1 for t in np.flatnonzero(np.abs(u[:-1]) > 1) if t > 0]
    for wrong, message in (
        (lambda: PiecewiseLinear([0.0, 1.0, 1.0]), "strictly increasing"),
        (lambda: Legendre(3, (1, 1)), "low below high"),
        (lambda: HammersteinWiener(1, 0), "nb must be a whole number of at least 1"),
        (lambda: HammersteinWiener(1, 1, output=DeadZone(1.0)), "not one-to-one"),
        (lambda: HammersteinWiener(1, 1, input="cubic"), "takes one of"),
        (lambda: HammersteinWiener(1, 1, output_noise=0.0), "output_noise"),
        (lambda: HammersteinWiener(1, 1, input=[None]).bind(2), "1 input"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()


@pytest.mark.parametrize("u", [np.zeros(80), np.full(80, 0.7)])
def test_dull_inputs_leave_a_finite_state(u):
    run = track(SMALL, K, np.zeros(80) + u, u)
    assert np.isfinite(run.theta).all()
    assert np.isfinite(run.std).all()


def test_the_likelihood_of_y_integrates_to_one():
    """Item 13: the estimate after the sample belongs into the Jacobian, the one before is only first order."""
    d, M, R = np.array([-0.2, 0.3]), 2e-3 * np.eye(2), 0.05
    model = HammersteinWiener(0, 1, output=Polynomial(3))
    y = np.linspace(-6.0, 6.0, 20_001)
    phi = np.stack([y**2, y**3], axis=1)
    e = 1.0 - y - phi @ d
    s = np.einsum("ti,ij,tj->t", phi, M, phi) + R
    after = d + (phi @ M) * (e / s)[:, None]
    density = np.exp(-0.5 * e * e / s) / np.sqrt(2.0 * np.pi * s)
    theta = np.concatenate([np.zeros((len(y), 1)), after], axis=1)
    assert np.trapezoid(density * model.slope(theta, y), y) == pytest.approx(1.0, abs=1e-4)
    theta[:, 1:] = d
    assert np.trapezoid(density * model.slope(theta, y), y) == pytest.approx(1.01369, abs=1e-4)


def test_forecasts_have_the_unit_of_the_output():
    """The spread of outputs h samples ahead is that of the forecast: constants known, equation noise.

    Of records whose future stays in the range of their past: nothing is believed of the curve beyond it.
    """
    rng = np.random.default_rng(11)
    model, e = HammersteinWiener(1, 1, output=Polynomial(3)), 0.02
    weights = (-0.8, 0.5, 0.4, 0.6)
    errors, result = [], []
    for _ in range(500):
        u = np.concatenate([rng.normal(size=40), np.zeros(5)])
        s = simulate(model, [weights[0]], [weights[1]], [], weights[2:], T=45, rng=rng, u=u, equation_noise=e)
        theta0 = (*weights, weights[0] * weights[2], weights[0] * weights[3])
        run = track(model, Kalman(q=0.0, r=e * e, p0=1e-12, theta0=theta0), s.y[:40], s.u[:40])
        ahead = run.forecast(5, s.u[40:])
        if s.y[:40].min() < s.y[40:].min() and s.y[40:].max() < s.y[:40].max():
            errors.append(s.y[40:] - ahead.y_hat)
            result.append(ahead.y_std)
    assert len(errors) > 440
    ratio = np.sqrt(np.mean((np.array(errors) / np.array(result)) ** 2, axis=0))
    assert (np.abs(ratio - 1.0) < 0.1).all()  # three standard errors
    assert np.mean(result, axis=0)[4] == pytest.approx(1.97 * np.mean(result, axis=0)[0], rel=0.02)


def test_a_run_is_continued_only_with_its_own_model():
    rng = np.random.default_rng(12)
    y, u = rng.uniform(-1.0, 1.0, (2, 60))
    run = track(SMALL, K, y[:30], u[:30])
    again = track(SMALL, K, y[30:], u[30:], warm_start=run)
    assert same(again.theta, track(SMALL, K, y, u).theta[30:])
    with pytest.raises(ValueError, match="followed"):
        track(HammersteinWiener(1, 1, input=Legendre(2, (-1, 1)), output=Polynomial(2)), K, y, u, warm_start=run)


@pytest.mark.filterwarnings("ignore:y has a root mean square")
@pytest.mark.parametrize("code", [-999.0, 20.0])
def test_a_run_of_fault_codes_spoils_neither_theta_nor_the_grid(code):
    """A refused code is no lag, and the grid on which the output block is inverted does not become as wide as it is."""
    s, tracker = example(1, 2, T=500), RLS(0.99)
    whole = track(s.model, tracker, s.y, s.u, gate=True)
    for count in (1, 3, 15):
        y = s.y.copy()
        y[200 : 200 + count] = code
        run = track(s.model, tracker, y, s.u, gate=True)
        assert set(range(200, 200 + count)) <= set(run.left_out.sample)
        assert len(run.left_out) <= count + 3
        error = np.median(np.abs(run.prediction - s.y)[300:])
        assert error < 1.2 * np.median(np.abs(whole.prediction - s.y)[300:])


def test_minimal_parameters_are_plotted():
    """There are fewer of them than regressors."""
    pytest.importorskip("matplotlib")
    s = example(1, 2, T=100)
    run = track(s.model, ExtendedKalman(q=1e-5, r=1e-2), s.y, s.u)
    assert len(run.plot().axes) == len(run.names) + 2


@pytest.mark.filterwarnings("ignore:y has a root mean square")
@pytest.mark.parametrize("factor", [30.0, 300.0])
def test_another_range_of_the_output_is_learned(factor):
    """An output that crosses zero is often as small as before."""
    s = example(1, 2, T=600)
    run = track(s.model, RLS(0.99), np.where(np.arange(600) < 200, s.y, factor * s.y), s.u, gate=True)
    assert len(run.left_out) <= 3
    assert np.mean(run.ok[300:]) > 0.8

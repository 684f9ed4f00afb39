"""Filters on minimal parameters, hand-off, free run, diagnostics, the furnace."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support import same

from driftfit import Kalman, Live, Regression, track, tune
from driftfit.models.hammerstein_wiener.basis import Legendre, Polynomial
from driftfit.models.hammerstein_wiener.extended_kalman import ExtendedKalman
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_error import OutputError
from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.systems.arc_furnace import THRESHOLDS, A, furnace, length, resistance
from driftfit.systems.drift import RandomWalk
from driftfit.systems.hammerstein_wiener import simulate
from driftfit.use.blocks import diagnose_blocks, free_run, reflected

SMALL = HammersteinWiener(1, 2, input=Polynomial(2), output=Polynomial(2))
P2 = Polynomial(2)
K = Kalman(q=1e-5, r=1e-4, p0=1e2, theta0=0.01)
SIGMA = 0.03


def record(T=400, seed=0, noise=0.0):
    """A small system whose every parameter walks, and measurement noise."""
    rng = np.random.default_rng(seed)
    laws = [[RandomWalk(x, 1e-3) for x in group] for group in ((-0.5,), (0.5, -0.3), (0.3,), (0.1,))]
    s = simulate(SMALL, *laws, T=T, rng=rng, u=rng.uniform(-1.0, 1.0, T))
    return s._replace(y=s.y0 + noise * rng.normal(size=T))


def naive_ekf(model, phi, z, q, r, p0, xi, inflation):
    """The filter by its equations, with full matrices and the Joseph form."""
    P = p0 * np.eye(len(xi))
    path = []
    for x, value in zip(phi, z, strict=True):
        if np.isfinite(x).all() and np.isfinite(value):
            P = P + q * np.eye(len(xi))
            H = x @ model.structure.jacobian(xi)
            h = H @ P @ H
            s = (1.0 + inflation) * h + r
            k = P @ H / s
            xi = xi + k * (value - x @ model.structure.products(xi))
            left = np.eye(len(xi)) - np.outer(k, H)
            P = left @ P @ left.T + (s - h) * np.outer(k, k)
        path.append(xi)
    return np.array(path), P


TWO = HammersteinWiener(
    1, [2, 1], nk=[1, 2], input=[Polynomial(2), Polynomial(3)], output=Polynomial(2), intercept=True
)
"""xi = (a1, b1, b2, b1[u2], c2, c2[u2], c3[u2], d2, l)."""
TRUTH = np.array([-0.5, 0.5, -0.3, 0.4, 0.3, 0.2, -0.1, 0.1, 0.05])


def two_inputs(T=200, seed=4, noise=0.0):
    """y, u (T, 2) of `TWO` with the coefficients `TRUTH`, written out."""
    rng = np.random.default_rng(seed)
    u, w = rng.uniform(-1.0, 1.0, (T, 2)), np.zeros(T)
    v = u[:, 0] + 0.3 * u[:, 0] ** 2, u[:, 1] + 0.2 * u[:, 1] ** 2 - 0.1 * u[:, 1] ** 3
    for t in range(2, T):
        w[t] = 0.5 * w[t - 1] + 0.5 * v[0][t - 1] - 0.3 * v[0][t - 2] + 0.4 * v[1][t - 2] - 0.05
    y = (np.sqrt(1.0 + 0.4 * w) - 1.0) / 0.2
    return y + noise * rng.normal(size=T), u


def test_the_extended_filter_of_several_inputs_is_its_naive_twin():
    y, u = two_inputs()
    ekf = ExtendedKalman(q=1e-5, r=1e-4, p0=0.1, theta0=TRUTH + 0.1)
    run = track(TWO, ekf, y, u)
    phi, (x, z) = np.full((200, TWO.n), np.nan), u.T
    for t in range(2, 200):
        first = [y[t - 1], -x[t - 1], -x[t - 2], -z[t - 2], y[t] ** 2]
        phi[t] = [*first, -(x[t - 1] ** 2), -(x[t - 2] ** 2), -(z[t - 2] ** 2), -(z[t - 2] ** 3), y[t - 1] ** 2, 1.0]
    path, P = naive_ekf(TWO, phi, -y, 1e-5, 1e-4, 0.1, TRUTH + 0.1, 0.0)
    assert_allclose(run.theta, path, rtol=1e-8, atol=1e-10)
    assert_allclose(run.cov(-1), P, rtol=1e-6, atol=1e-12)
    assert run.names == ("A1", "b1[u1]", "b2[u1]", "b1[u2]", "c2[u1]", "c2[u2]", "c3[u2]", "d2", "intercept")
    assert_allclose(run.theta[-1], TRUTH, atol=0.02)
    root, xi = run.prediction[100], run.theta[99]
    right = -np.delete(phi[100] * TWO.structure.products(xi), 4).sum()
    assert root + xi[7] * root**2 == pytest.approx(right, abs=1e-9)
    found = run.blocks()
    assert same(found.xi, run.theta)
    assert_allclose(found.std.c[:, [1, 3, 4]], run.std[:, 4:7])


def naive_output_error(y, u, q, r, p0, xi, q_w=1e-6, p_w=0.5):
    """The output-error filter of `TWO` by its equations, with full matrices; state (w, xi).

    The first ten outputs are not used."""
    x, P = np.r_[0.0, xi], np.diag(np.r_[p_w, np.full(9, p0)])
    path, result = [], []
    for t in range(len(y)):
        y_hat = np.nan
        if t >= 2:
            a, b, b2, bz, c, cz, cz3, d, l = x[1:]
            if t == 2:
                x[0] = y[1] + d * y[1] ** 2
            one, two, other = u[t - 1, 0], u[t - 2, 0], u[t - 2, 1]
            v, v2, vz = one + c * one**2, two + c * two**2, other + cz * other**2 + cz3 * other**3
            slopes = [-x[0], v, v2, vz, b * one**2 + b2 * two**2, bz * other**2, bz * other**3, 0.0, -1.0]
            F = np.eye(10)
            F[0] = np.r_[-a, slopes]
            P = F @ (P + np.diag(np.r_[0.0, np.full(9, q)])) @ F.T
            P[0, 0] += q_w
            x[0] = -a * x[0] + b * v + b2 * v2 + bz * vz - l
            y_hat = (np.sqrt(1.0 + 4.0 * d * x[0]) - 1.0) / (2.0 * d)
            H = np.zeros(10)
            H[0], H[8] = 1.0, -(y_hat**2)
            H /= 1.0 + 2.0 * d * y_hat
            if np.isfinite(y[t]) and t >= 10:
                k = P @ H / (H @ P @ H + r)
                x = x + k * (y[t] - y_hat)
                left = np.eye(10) - np.outer(k, H)
                P = left @ P @ left.T + r * np.outer(k, k)
        path.append(x[1:].copy())
        result.append(y_hat)
    return np.array(path), np.array(result), P[1:, 1:]


def test_the_output_error_filter_of_several_inputs_is_its_naive_twin():
    y, u = two_inputs(noise=SIGMA)
    y[:10] = np.resize([1.2, 1.2, -1.2, -1.2], 10)  # so that the grid spans all later outputs
    y[[60, 61, 120]] = np.nan
    late = np.r_[np.zeros(10), np.ones(190)]
    run = track(TWO, OutputError(q=1e-6, r=SIGMA**2, p0=0.01, theta0=TRUTH + 0.05), y, u, weights=late)
    path, result, P = naive_output_error(y, u, 1e-6, SIGMA**2, 0.01, TRUTH + 0.05)
    assert_allclose(run.theta[2:], path[2:], rtol=1e-7, atol=1e-9)
    assert_allclose(run.prediction[10:], result[10:], atol=1e-7)
    assert_allclose(run.cov(-1), P, rtol=1e-5, atol=1e-10)
    assert np.abs(run.theta[-1] - TRUTH).max() < 3.0 * run.std[-1].max()


@pytest.mark.parametrize("kind", [ExtendedKalman, OutputError])
def test_an_idle_second_input_changes_nothing(kind):
    """Its b and c keep their prior, all others are those of the model with one input; a missing one is marked."""
    s = record(150, noise=SIGMA)
    one, two = SMALL, HammersteinWiener(1, [2, 1], input=[Polynomial(2), Polynomial(2)], output=Polynomial(2))
    alone = track(one, kind(q=1e-6, r=1e-3, p0=0.05, theta0=0.1), s.y, s.u)
    idle = np.zeros(150)
    both = track(two, kind(q=1e-6, r=1e-3, p0=0.05, theta0=0.1), s.y, np.column_stack([s.u, idle]))
    assert_allclose(both.theta[:, [0, 1, 2, 4, 6]], alone.theta, rtol=1e-9, atol=1e-12)
    assert same(both.theta[:, [3, 5]], np.full((150, 2), 0.1))
    idle[[80, 81]] = np.nan
    holes = track(two, kind(q=1e-6, r=1e-3, p0=0.05, theta0=0.1), s.y, np.column_stack([s.u, idle]))
    assert np.flatnonzero(~holes.ok[2:]).tolist() == [79, 80]
    assert np.isfinite(holes.theta).all()


def handed_over(model, first, then, y, u, at):
    """The recipe of the page: the filter goes on from the separation of stage one after sample ``at``."""
    found, after = track(model, first, y, u).blocks("gls"), np.arange(len(y)) > at
    return track(model, replace(then, theta0=found.xi[at], p0=found.xi_cov[at]), y, u, weights=after, drift=after)


@pytest.mark.parametrize("kind", [ExtendedKalman, OutputError])
def test_minimal_filters_go_on_from_stage_one(kind):
    y, u = two_inputs(400)
    found = handed_over(TWO, K, kind(q=1e-6, r=1e-6), y, u, 150)
    assert same(found.ok, np.arange(400) > 150)
    assert_allclose(found.theta[-1], TRUTH, atol=0.02)


def test_minimal_filters_want_their_model():
    for tracker in (ExtendedKalman(q=1e-5, r=1e-4), OutputError(q=1e-5, r=1e-4)):
        with pytest.raises(ValueError, match="HammersteinWiener"):
            track(Regression(1), tracker, [1.0, 2.0], [1.0, 1.0])
        with pytest.raises(ValueError, match="where those of the output block are"):
            track(HammersteinWiener(0, 1, input=P2, output=P2), tracker, [1.0, 2.0], [1.0, 1.0])


@pytest.mark.parametrize("kind", [ExtendedKalman, OutputError])
def test_as_many_products_as_minimal_parameters(kind):
    """One b for a curve of two functions: theta holds b1*c2 and xi c2, which have the same number of entries."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=400)
    y = np.zeros(400)
    for t in range(1, 400):
        y[t] = 0.5 * y[t - 1] + 0.8 * (u[t - 1] + 0.5 * u[t - 1] ** 2)
    y += 0.05 * rng.normal(size=400)
    model, tracker = HammersteinWiener(1, 1, input=P2), kind(q=0.0, r=0.0025, p0=0.5, theta0=[-0.4, 0.6, 0.3])
    run = track(model, tracker, y, u)
    assert run.names == ("A1", "b1", "c2")
    assert_allclose(run.theta[-1], [-0.5, 0.8, 0.5], atol=0.03)
    assert_allclose(run.blocks().c[-1], [1.0, run.theta[-1, 2]])
    assert np.sqrt(np.nanmean((y - run.ahead(3).y_hat)[300:] ** 2)) < 0.065
    live = Live(model, tracker)
    for sample in zip(y, u, strict=True):
        live.update(*sample)
    assert_allclose(live.blocks().c, run.blocks().c[-1])


def test_predictions_by_an_unstable_system_end_in_inf_without_a_warning():
    """The systems of the first samples, under a wide prior; without an output block nothing limits what they do."""
    y, u = record(60).y, record(60).u
    run = track(HammersteinWiener(1, 1, input=P2), replace(K, p0=1e14), y, u)
    assert not np.isfinite(run.ahead(55).y_std[55:]).all()


def test_the_output_error_filter_is_honest_under_measurement_noise():
    """Item 15: mean NIS near 1, and no bias where stage one has one."""
    nis, errors, stage = [], [], []
    for seed in range(4):
        s = record(1500, seed, SIGMA)
        noisy = replace(SMALL, output_noise=SIGMA)
        start = Kalman(q=1e-6, r=1.0, p0=1e2, theta0=0.01)
        found = handed_over(noisy, start, OutputError(q=1e-6, r=SIGMA**2), s.y, s.u, 150)
        nis.append(np.nanmean((found.innovation / found.innovation_std)[151:] ** 2))
        errors.append(np.median(np.linalg.norm(found.theta - s.xi, axis=1)[-500:]))
        run = track(noisy, start, s.y, s.u)
        stage.append(np.median(np.linalg.norm(run.blocks("gls").xi - s.xi, axis=1)[-500:]))
    assert 0.8 < np.mean(nis) < 1.25
    assert np.median(errors) < np.median(stage)
    missing = s.y.copy()
    missing[[400, 401, 700]] = np.nan
    run = track(SMALL, replace(found.tracker, q_w=1e-6), missing, s.u)
    assert np.flatnonzero(~run.ok)[-3:].tolist() == [400, 401, 700]
    assert np.isfinite(run.prediction[[400, 401, 700, 702]]).all()
    z = run.innovation / run.innovation_std
    terms = -0.5 * (np.log(2.0 * np.pi * run.innovation_std**2) + z * z)
    assert run.loglik == pytest.approx(terms[run.ok].sum())


def test_a_free_run_needs_no_outputs():
    s = record(400)
    run = track(SMALL, K, s.y, s.u)
    free = free_run(run)
    assert np.isnan(free.y[:50]).all()
    assert np.sqrt(np.nanmean((free.y - s.y) ** 2)) < 0.1 * s.y.std()
    assert free.rising[50:].all()
    assert free.stable.all()
    poles = np.roots(np.r_[1.0, reflected(np.array([-2.5, 1.0]))])
    assert_allclose(np.sort(poles), [0.5, 0.5], atol=1e-6)


def test_diagnostics_tell_good_from_bad():
    s = record(300)
    run = track(SMALL, K, s.y, s.u)
    found = diagnose_blocks(run, every=20)
    assert found.trusted[3:].all()
    assert found.dull() == ()
    y, u = s.y, s.u
    seen = [
        [y[t - 1], -u[t - 1], -u[t - 2], y[t] ** 2, -(u[t - 1] ** 2), -(u[t - 2] ** 2), y[t - 1] ** 2]
        for t in range(279, 300)
    ]
    scaled = np.array(seen) / np.linalg.norm(seen, axis=0)
    assert found.excitation[-1] == pytest.approx(np.linalg.eigvalsh(scaled.T @ scaled)[0], rel=1e-6)
    P = run.cov(299)
    assert found.trace[-1] == pytest.approx(np.trace(P))
    assert found.memory[-1] == pytest.approx((np.linalg.eigvalsh(P)[-1] + 1e-5) / 1e-5)
    assert found.radius[-1] == pytest.approx(abs(run.blocks().a[-1, 0]))
    dull = diagnose_blocks(track(SMALL, K, s.y, np.full(300, 0.5)), every=100)
    assert not dull.trusted.any()
    assert {"b1", "b2", "b1*c2", "b2*c2"} <= set(dull.dull())  # any two of them are alike: none is the one
    bent = run.theta[-1].copy()
    bent[3] = -9.0
    run.theta[-1] = bent
    assert diagnose_blocks(run, every=300).slope[0] < 0.0
    with pytest.raises(ValueError, match="at least 21"):
        diagnose_blocks(run, window=5)


def test_an_estimate_that_does_not_increase_is_flagged_and_predicted_with_its_envelope():
    s = record(200)
    run = track(SMALL, K, s.y, s.u)
    live = Live(SMALL, K)
    for t in range(200):
        live.update(float(s.y[t]), float(s.u[t]))
    live.reset(3, theta=-5.0)
    y_hat, _ = live.predict(0.3)
    assert np.isfinite(y_hat)
    assert s.y.min() - np.ptp(s.y) < y_hat < s.y.max() + np.ptp(s.y)
    run.theta[:, 3] = -5.0
    assert not free_run(run).rising[60:].any()


def test_an_unstable_block_with_a_bounded_output_is_followed():
    """A pole at 1.05, and a proportional controller."""
    rng, T = np.random.default_rng(0), 600
    reference = rng.normal(0.0, 0.5, T)
    model = HammersteinWiener(1, 1, input=Polynomial(3), output=Polynomial(3))
    laws = [-1.05], [RandomWalk(0.7, 1e-3, (0.5, 0.9))], [0.0, 0.1], [0.0, 0.1]
    s = simulate(model, *laws, T=T, rng=rng, u=lambda t, y: reference[t] - (0.6 * y[-1] if t else 0.0))
    assert s.unstable == 0
    assert np.abs(s.y).max() < 10.0
    run = track(s.model, Kalman(q=1e-5, r=1e-4, p0=1e4), s.y, s.u)
    found = run.blocks()
    assert_allclose(found.a[-1], s.a[-1], atol=0.02)
    assert found.radius[-1] == pytest.approx(1.05, abs=0.02)


def test_the_likelihood_finds_the_drift():
    """The concentrated likelihood with the Jacobian, over a grid of ratios run as lanes."""
    s = record(400)
    tuned = tune(SMALL, Kalman(), s.y, s.u)
    ratio = tuned.tracker.q[0] / tuned.tracker.r
    assert ratio > 1e-2  # without measurement noise there is little but drift
    noisy = tune(SMALL, Kalman(), *record(400, noise=0.1)[1:3])
    assert noisy.tracker.q[0] / noisy.tracker.r < 0.01 * ratio
    run = track(SMALL, tuned.tracker, s.y, s.u)
    assert run.loglik == pytest.approx(tuned.loglik, rel=1e-6)


def naive_dead_zone(y, u, fed, T):
    """Kalman filter, one lag of w and two of v: functions of an input with the thresholds known before it."""
    theta, P = np.full(7, 0.01), 1e4 * np.eye(7)
    p, f, path = np.array([0.01, -0.01]), np.zeros((T, 3)), np.zeros((T, 7))
    for t in range(T):
        above, below = u[t] >= p[0], u[t] <= p[1]
        f[t] = u[t] * (above or below), -1.0 * above, -1.0 * below
        if t >= 2:
            b = -f[[t - 1, t - 2]]
            phi = np.concatenate([[y[t - 1]], b[:, 0], b[:, 1], b[:, 2]])
            P = P + 1e-4 * np.eye(7)
            K = P @ phi / (phi @ P @ phi + 1e-2)
            theta = theta + K * (-y[t] - phi @ theta)
            P = P - np.outer(K, phi @ P)
            gain, products = theta[1:3], theta[3:].reshape(2, 2)
            p = products @ gain / (gain @ gain) if fed == "least-squares" else np.mean(products / gain, axis=1)
            p = np.clip(p, (0.0, -0.97 * 2.0), (0.97 * 2.0, 0.0))
        path[t] = theta
    return path


@pytest.mark.parametrize("fed", ["least-squares", "average"])
def test_thresholds_of_a_dead_zone_are_fed_back(fed):
    rng = np.random.default_rng(3)
    u = rng.uniform(-2.0, 2.0, 300)
    v = np.where(u > 0.8, u - 0.8, np.where(u < -0.6, u + 0.6, 0.0))
    y = np.zeros(300)
    for t in range(2, 300):
        y[t] = 0.5 * y[t - 1] + 0.7 * v[t - 1] + 0.3 * v[t - 2] + 0.02 * rng.normal()
    model = HammersteinWiener(1, 2, input=DeadZone(2.0, fed=fed))
    run = track(model, Kalman(q=1e-4, r=1e-2, p0=1e4, theta0=0.01), y, u)
    assert_allclose(run.theta[2:], naive_dead_zone(y, u, fed, 300)[2:], atol=1e-8)
    assert_allclose(run.blocks("average").c[-1, 1:], [0.8, -0.6], atol=0.1)
    with pytest.raises(ValueError, match="least-squares"):
        DeadZone(2.0, fed="svd")


def test_the_furnace():
    """Item 16, and what can be known of it."""
    f = furnace(0, T=1500)
    assert_allclose(length(f.R, f.gradient), f.L, rtol=1e-10)
    L = np.linspace(2.0, 45.0, 50)
    assert (np.diff(resistance(L, np.full(50, 4.0))) > 0.0).all()
    numeric = (length(f.R + 1e-7, f.gradient) - length(f.R - 1e-7, f.gradient)) / 2e-7
    assert_allclose(f.length_per_resistance, numeric, rtol=1e-6)
    model = HammersteinWiener(3, 3, input=DeadZone(3.0), output=Legendre(2, (f.R.min(), f.R.max())))
    run = track(model, Kalman(q=1.0, r=0.01, p0=1e8, theta0=0.01), f.R, f.u)
    found = run.blocks("svd")
    assert_allclose(np.median(found.c[-200:, 1:], axis=0), THRESHOLDS, atol=0.1)
    assert_allclose(np.median(found.a[-200:], axis=0), A, atol=0.3)


def test_a_free_run_has_the_unit_of_the_output():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 400), np.zeros(400)
    for t in range(1, 400):
        y[t] = 0.5 * y[t - 1] + 0.5 * u[t - 1] + 0.01 * rng.normal()
    y[0] = np.nan
    ran = []
    for unit in (1.0, 1e-12):
        model = HammersteinWiener(1, 1, input=Polynomial(2), output=Legendre(2, (-2.0 * unit, 2.0 * unit)))
        ran.append(free_run(track(model, Kalman(q=0.0, r=1e-4), unit * y, u)).y / unit)
    assert ran[1] == pytest.approx(ran[0], abs=1e-9, nan_ok=True)


@pytest.mark.filterwarnings("ignore:[yu] has a root mean square")
def test_the_extended_filter_sees_no_fault_code_behind_a_gate():
    """One reading of 9999 took every parameter to where no sample brought it back."""
    s = record(400, noise=0.01)
    ekf = ExtendedKalman(q=1e-6, r=1e-3, p0=0.1, theta0=s.xi[0] + 0.05)
    y = s.y.copy()
    y[200] = 9999.0
    run, whole = (track(SMALL, ekf, one, s.u, gate=True) for one in (y, s.y))
    assert np.abs(run.theta - whole.theta)[220:].max() < 0.02
    assert run.left_out.sample.tolist() == [200]

"""Changes that forget: the bank with one hypothesis is the filter that forgets so, and each map is its formula."""

import numpy as np
import pytest
from support import same
from test_bank import N, R, record

from driftfit import RLS, Bank, Kalman, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, FirstFloor
from driftfit.bank.sensor import Sensor

Y, U = record(80, 4, (40,))
Y[50:53], U[60] = np.nan, np.nan
KNOWN = [Sensor.nominal(R)]
REDUCTIONS = [Beam(2), GPB(2), IMM()]


def bank(*changes, reduce=None, **more):
    return Bank(list(changes), KNOWN, reduce=reduce, **({"p0": 2.0} | more))


@pytest.mark.parametrize("reduce", REDUCTIONS, ids=str)
@pytest.mark.parametrize("kind", ["exponential", "directional"])
def test_one_change_that_forgets_is_recursive_least_squares(kind, reduce):
    time = np.r_[np.arange(70.0), 71.5 + np.arange(10.0)]
    run = track(Regression(N), bank(Change(forget=0.9, kind=kind), reduce=reduce), Y, U, time=time)
    rls = track(Regression(N), RLS(0.9, p0=2.0 / R, kind=kind), Y, U, time=time)
    np.testing.assert_allclose(run.theta, rls.theta, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(run.prediction, rls.prediction, rtol=1e-10, atol=1e-12)


def naive(step, y, u, m, C):
    """A filter with ``step(m, C, z)`` between samples, z being the last regressor that was used."""
    path, z = [], None
    for t in range(len(y)):
        m, C = step(m, C, z)
        z = None
        if np.isfinite(y[t]) and np.isfinite(u[t]).all():
            z = u[t]
            K = C @ z / (R + z @ C @ z)
            m, C = m + K * (y[t] - z @ m), C - np.outer(K, C @ z)
        path.append((m, C))
    return path


A, M0 = np.array([[3.0, 1.0], [1.0, 2.0]]), np.array([0.5, -0.2])


def exponential(m, C, z):
    return m, C + (1.0 / 0.9 - 1.0) * C


def directional(m, C, z):
    if z is None:
        return m, C
    g = C @ z
    return m, C + (1.0 / 0.9 - 1.0) * np.outer(g, g) / (z @ g)


def stabilised(m, C, z):
    information = 0.9 * np.linalg.inv(C) + 0.1 * np.linalg.inv(A)
    mean = 0.9 * np.linalg.inv(C) @ m + 0.1 * np.linalg.inv(A) @ M0
    return np.linalg.solve(information, mean), np.linalg.inv(information)


MAPS = {
    "exponential": (exponential, Change(forget=0.9)),
    "directional": (directional, Change(forget=0.9, kind="directional")),
    "stabilised": (stabilised, Change(forget=0.9, kind="stabilised", anchor=A)),
}


@pytest.mark.parametrize("name", list(MAPS))
def test_each_map_is_its_formula(name):
    step, change = MAPS[name]
    run = track(Regression(N), bank(change, theta0=M0), Y, U, keep="cov")
    for t, (m, C) in enumerate(naive(step, Y, U, M0, 2.0 * np.eye(N))):
        after = np.isfinite(Y[t]) and np.isfinite(U[t]).all()
        np.testing.assert_allclose(run.theta[t], m, atol=1e-10)
        if after or name != "directional":
            np.testing.assert_allclose(run.cov(t), C, atol=1e-10)


def test_directional_is_data_and_then_an_increment():
    """e = lam - (1 - lam) / zeta: the formula of Kulhavy for both at once."""
    lam, z, C = 0.9, U[0], np.array([[2.0, 0.3], [0.3, 1.0]])
    zeta = z @ C @ z / R
    e = lam - (1.0 - lam) / zeta
    both = C - np.outer(C @ z, C @ z) * e / (R * (1.0 + e * zeta))
    plain = C - np.outer(C @ z, C @ z) / (R * (1.0 + zeta))
    np.testing.assert_allclose(directional(None, plain, z)[1], both, atol=1e-12)
    assert z @ both @ z == pytest.approx(z @ plain @ z / lam, abs=1e-12)


def test_the_mixture_of_maps_is_that_of_its_parts():
    """One sample: two hypotheses weighed by hand."""
    changes = [Change(0.01), Change(forget=0.5, kind="stabilised", anchor=A, prob=0.3)]
    run = track(Regression(N), bank(*changes, theta0=M0, p0=np.diag([2.0, 1.0])), Y[:1], U[:1])
    C0, z = np.diag([2.0, 1.0]), U[0]
    parts = [(M0, C0 + 0.01 * np.eye(N)), (M0, np.linalg.inv(0.5 * np.linalg.inv(C0) + 0.5 * np.linalg.inv(A)))]
    w, means = [], []
    for p, (m, C) in zip((0.7, 0.3), parts, strict=True):
        s, e = R + z @ C @ z, Y[0] - z @ m
        w.append(p * np.exp(-0.5 * e * e / s) / np.sqrt(s))
        means.append(m + C @ z / s * e)
    np.testing.assert_allclose(run.theta[0], np.array(w) @ np.array(means) / sum(w), atol=1e-12)


def test_a_reset_of_some_parameters_leaves_the_others():
    y, u = Y.copy(), U.copy()
    prob = np.tile([1.0, 0.0], (80, 1))
    prob[30] = 0.0, 1.0
    changes = [Change(0.0), Change(5.0, prob=0.01, which=[1], reset=True)]
    run = track(Regression(N), bank(*changes), y, u, prob=prob)

    sample = iter(range(80))

    def step(m, C, z):
        if next(sample) != 30:
            return m, C
        return np.array([m[0], 0.0]), np.diag([C[0, 0], 5.0])

    for t, (m, _) in enumerate(naive(step, y, u, np.zeros(N), 2.0 * np.eye(N))):
        np.testing.assert_allclose(run.theta[t], m, atol=1e-10)


@pytest.mark.parametrize("name", list(MAPS))
def test_no_excitation_for_long_stays_finite(name):
    u = np.vstack([U[:20], np.zeros((3000, N)), U[:20]])
    y = np.r_[Y[:20], np.zeros(3000), Y[:20]]
    run = track(Regression(N), bank(MAPS[name][1], theta0=M0), y, u)
    assert np.isfinite(run.theta).all()
    assert np.isfinite(run.std).all()
    largest = {"exponential": np.sqrt(4e8), "directional": np.sqrt(2.0), "stabilised": np.sqrt(3.0)}[name]
    assert run.std[3000:3020].max() <= largest * (1.0 + 1e-6)
    if name == "stabilised":
        np.testing.assert_allclose(run.theta[3019], M0, atol=1e-6)


def test_prediction_does_not_depend_on_the_sample_being_there():
    changes = [Change(0.01), Change(forget=0.8, kind="directional", prob=0.2), Change(5.0, prob=0.1, reset=True)]
    y = Y.copy()
    y[30] = np.nan
    one, other = (track(Regression(N), bank(*changes, reduce=GPB(2)), given, U) for given in (Y, y))
    assert same(one.prediction[:31], other.prediction[:31])
    assert same(one.innovation_std[:31], other.innovation_std[:31])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Change(forget=0.9, kind="stabilised"), "anchor="),
        (lambda: Change(forget=0.9, anchor=1.0), "belong together"),
        (lambda: Change(forget=0.9, kind="stabilised", anchor=0.0), "positive definite"),
        (lambda: Change(1.0, forget=0.9, reset=True), "not both"),
        (lambda: Change(forget=0.9, kind="linear"), "exponential"),
        (lambda: bank(Change(1.0, reset=True)), "normal course"),
        (lambda: bank(Change(forget=0.9), reduce=FirstFloor(2)), "random walks only"),
    ],
)
def test_what_does_not_go_together(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_what_forgets_has_events_but_no_smoothed_path():
    changes = [Change(1e-6), Change(5.0, prob=0.01, reset=True)]
    run = track(Regression(N), bank(*changes), Y, U)
    assert [event.shift for event in run.hypotheses.events()] == [{}]
    with pytest.raises(ValueError, match="only random walks can be smoothed"):
        run.smooth()


def test_members_of_the_family_are_banks_of_one_hypothesis():
    y, u = record(100, 5)
    walk = track(Regression(N), bank(Change(0.01)), y, u)
    assert same(walk.theta, track(Regression(N), Kalman(0.01, R, p0=2.0), y, u).theta)
    constant = track(Regression(N), bank(Change()), y, u)
    assert same(constant.theta, track(Regression(N), Kalman(0.0, R, p0=2.0), y, u).theta)


def test_a_reset_starts_again():
    """A change that resets, certain at one sample, forgets what was before it."""
    y, u = record(60, 6, ())
    one = bank(Change(), Change(2.0, reset=True, prob=0.01))
    prob = np.tile([1.0, 0.0], (60, 1))
    prob[30] = 0.0, 1.0
    run = track(Regression(N), one, y, u, prob=prob)
    fresh = track(Regression(N), Kalman(0.0, R, p0=2.0), y[30:], u[30:])
    np.testing.assert_allclose(run.theta[30:], fresh.theta, atol=1e-12)
    np.testing.assert_allclose(run.std[30:], fresh.std, atol=1e-12)

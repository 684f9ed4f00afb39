"""The most probable path of a Hammerstein-Wiener system: dense algebra, its own model, and curves without inverse."""

import numpy as np
import pytest

from driftfit import (
    ARX,
    FLS,
    HammersteinWiener,
    Kalman,
    OutputError,
    PiecewiseLinear,
    Polynomial,
    Regression,
    output_error,
    track,
)
from driftfit.smooth.solvers.simulated import DRIFT, LOST, NOISE, OMEGA, E, Problem, solve
from driftfit.systems import RandomWalk
from driftfit.systems.hammerstein_wiener import CUBIC, START, simulate
from driftfit.use.output_error import Fit, Path, System

WALK = 0.004


def test_the_linear_problem_is_that_of_dense_algebra():
    """Means, covariances, noise and likelihood, and its derivatives, of a record with a missing sample."""
    rng, T, na, n = np.random.default_rng(0), 7, 2, 3
    N, signals = na + n, np.ones((7, 5))
    signals[:, E], signals[:, OMEGA], signals[:, LOST] = *0.3 * rng.normal(size=(2, T)), rng.uniform(0.5, 2, T)
    signals[3, NOISE], signals[0, DRIFT], signals[5, DRIFT], signals[5, NOISE] = np.inf, 0.0, 2.0, 0.5
    of_w, of_e, shift = 0.5 * rng.normal(size=(T, N)), rng.normal(size=(T, N)), 0.1 * rng.normal(size=(T, n))
    of_e[:, 1:na] = 0.0
    p = Problem(signals, of_w, of_e, shift, rng.normal(size=N), rng.uniform(0.5, 2, N))

    def dense(v):
        mean = np.concatenate([p.mean, shift.ravel(), signals[:, OMEGA]])
        var = np.concatenate([p.var, np.outer(signals[:, DRIFT], v[2:]).ravel(), v[1] + signals[:, LOST]])
        Z, states = np.eye(N, len(mean)), []
        for t in range(T):
            Z = Z.copy()
            Z[na:, N + t * n : N + (t + 1) * n] += np.eye(n)
            row = of_w[t] @ Z
            row[N + T * n + t] += 1.0
            Z[:na] = np.array([row, Z[0]])
            states.append(Z)
        X, ok = np.array(states), np.isfinite(signals[:, NOISE])
        H = np.einsum("ti,tid->td", of_e, X)[ok]
        S, e = H * var @ H.T + v[0] * np.diag(signals[ok, NOISE]), signals[ok, E] - H @ mean
        gain = var[:, None] * np.linalg.solve(S, H).T
        loglik = -0.5 * (len(e) * np.log(2 * np.pi) + np.linalg.slogdet(S)[1] + e @ np.linalg.solve(S, e))
        after, C = mean + gain @ e, np.diag(var) - gain @ H * var
        return loglik, X @ after, (X @ C @ X.swapaxes(1, 2))[:, na:, na:], after[N + T * n :], after[:N]

    v = np.array([0.3, 0.2, 0.1, 0.05, 0.4])
    found = solve(p, v)
    for got, wanted in zip((found.loglik, found.z, found.cov, found.omega, found.begin), dense(v), strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-12)
    slopes = [(dense(v + h)[0] - dense(v - h)[0]) / 2e-5 for h in 1e-5 * np.eye(5)]
    np.testing.assert_allclose(0.5 * (found.moved - found.expected), slopes, rtol=1e-6)


def record(T, seed=0, model=None, laws=None, **settings):
    """A record of a model whose coefficients all walk."""
    model = model or HammersteinWiener(1, 2, input=Polynomial(2), output=Polynomial(3))
    laws = laws or ((-0.6,), (0.6, -0.3), (0.4,), (-0.2, 0.5))
    rng = np.random.default_rng(seed)
    walks = [[RandomWalk(x, WALK) for x in group] for group in laws]
    return simulate(model, *walks, T=T, rng=rng, u=rng.uniform(-1, 1, T), **settings)


def run_of(s, y=None, u=None):
    return track(s.model, Kalman(q=1e-5, r=1e-3, p0=1e2), s.y if y is None else y, s.u if u is None else u)


def test_without_curves_and_lags_it_is_the_linear_smoother():
    rng = np.random.default_rng(1)
    u, q, r = rng.normal(size=60), np.array([1e-3, 4e-3]), 0.01
    late = np.stack([np.r_[0.0, u[:-1]], np.r_[0.0, 0.0, u[:-2]]], axis=1)
    y = np.sum(late * (1.0 + 0.03 * np.cumsum(rng.normal(size=(60, 2)), axis=0)), axis=1) + 0.1 * rng.normal(size=60)
    y[20] = np.nan
    system = System(HammersteinWiener(0, 2), u[:, None], (-1.0, 1.0))
    ones, path = np.ones(60), Path(np.ones((60, 2)), np.zeros(60), np.zeros(1))
    fit = Fit(system, (y, np.where(np.isfinite(y), 1.0, np.inf), np.r_[0.0, ones[1:]]), path, np.array([r, 0.0, *q]))
    linear = track(Regression(2), Kalman(q=q, r=r, p0=np.diag(fit.var[1:] - q), theta0=1.0), y, late)
    np.testing.assert_allclose(fit.path.x, linear.smooth().theta, atol=1e-9)
    np.testing.assert_allclose(fit.found.loglik, linear.loglik, rtol=1e-9)


@pytest.mark.parametrize("forward", [None, Polynomial(2)])
def test_the_path_is_the_most_probable_and_its_likelihood_that_of_laplace(forward):
    """All squares of a short record as one function of all unknowns, differentiated by central differences."""
    model = HammersteinWiener(1, 2, output=Polynomial(2), intercept=True)
    s = record(25, model=HammersteinWiener(1, 2, output=Polynomial(2)), laws=((-0.6,), (0.6, -0.3), (), (0.2,)))
    y = s.y + 0.05 * np.random.default_rng(5).normal(size=25)
    n, T = model.structure.n_x, 25
    system = System(model, s.u[:, None], (y.min(), y.max()), forward is not None)
    path = Path(np.tile([-0.6, 0.6, -0.3, 0.2, 0.0], (T, 1)), np.zeros(T), np.zeros(1))
    variances = np.array([0.01, 1e-3, 1e-3, 1e-3, 2e-3, 1e-3, 1e-4])
    fit = Fit(system, (y, np.ones(T), np.r_[0.0, np.ones(T - 1)]), path, variances)
    sizes = np.sqrt(np.concatenate([np.full(T, 0.01), np.tile(variances[2:], T - 1), np.full(T, 1e-3), fit.var[-n:],
                                    fit.var[:1]]))  # fmt: skip

    def off(z):
        at = Path(z[: T * n].reshape(T, n), z[T * n : -1], z[-1:])
        parts = y - system(at).y, np.diff(at.x, axis=0).ravel(), at.omega, at.x[0] - fit.mean, at.w
        return np.concatenate(parts) / sizes

    z = np.concatenate([fit.path.x.ravel(), fit.path.omega, fit.path.w])
    J = np.stack([(off(z + h) - off(z - h)) / 2e-6 for h in 1e-6 * np.eye(len(z))], axis=1)
    np.testing.assert_allclose(np.linalg.solve(J.T @ J, J.T @ off(z)), 0.0, atol=1e-3)
    log_sizes = np.sum(np.log(sizes)) + 0.5 * T * np.log(2 * np.pi)
    laplace = -0.5 * off(z) @ off(z) - log_sizes - 0.5 * np.linalg.slogdet(J.T @ J)[1]
    assert abs(fit.found.loglik - laplace) < 1e-3


def test_bands_cover_paths_of_its_own_model():
    """Errors within a record are alike: the mean of 24 records is known to .024. It was .912, and with variances at
    their modes .859."""
    covered = []
    for seed in range(24):
        s = record(400, seed, snr_db=25.0)
        low, high = output_error(run_of(s)).band()
        covered.append(np.mean((low < s.xi) & (s.xi < high)))
    assert 0.89 < np.mean(covered) < 0.99


def test_drift_and_noise_are_found():
    found = [(output_error(run_of(s)), s) for s in (record(1000, seed, snr_db=25.0) for seed in range(3))]
    np.testing.assert_allclose(np.mean([one.r**0.5 / s.sigma for one, s in found]), 1.0, rtol=0.05)
    np.testing.assert_allclose(np.mean([np.sqrt(one.q) / WALK for one, _ in found]), 1.0, rtol=0.2)


def test_constants_lose_the_bias_of_least_squares():
    """Section 8 of the specification: at 20 dB least squares is off by .18."""
    s = simulate(CUBIC, *(START[name] for name in "abcd"), T=5000, rng=np.random.default_rng(0), snr_db=20.0)
    run = track(CUBIC, Kalman(q=0.0, r=1.0, p0=1e8), s.y, s.u)
    found = output_error(run, q=0.0, q_w=0.0)
    assert np.linalg.norm(run.blocks().xi[-1] - s.xi[-1]) > 0.12
    assert np.linalg.norm(found.theta[-1] - s.xi[-1]) < 0.02
    assert np.ptp(found.theta, axis=0).max() < 1e-9
    np.testing.assert_allclose(found.r**0.5, s.sigma, rtol=0.02)


@pytest.fixture(scope="module")
def noisy():
    s = record(400, 1, snr_db=20.0)
    return s, run_of(s)


def test_it_is_more_accurate_than_the_two_stages_and_no_update_lowers_the_likelihood(noisy):
    s, run = noisy
    logliks = [output_error(run, rounds=rounds).loglik for rounds in (0, 1, 2, 4, 8)]
    assert np.all(np.diff(logliks) >= 0.0)
    found = output_error(run)
    assert found.loglik > logliks[0] + 10.0

    def rms(xi):
        return np.sqrt(np.mean((xi - s.xi)[50:] ** 2))

    two_stages = [run.blocks(method).xi for method in ("svd-joint", "gls")] + [run.smooth().blocks().xi]
    assert rms(found.theta) < 0.7 * min(map(rms, two_stages))
    blocks = found.blocks("unit")
    assert np.allclose(np.linalg.norm(blocks.c, axis=1), 1.0)
    assert np.allclose(blocks.xi, found.theta)
    assert (blocks.std.b > 0.0).all()
    assert found.names == ("A1", "b1", "b2", "c2", "d2", "d3")
    assert "log-likelihood" in str(found)
    assert found.plot() is not None


def test_it_starts_from_any_tracker_and_goes_on_over_what_is_missing(noisy):
    s, run = noisy
    y, u = s.y.copy(), s.u.copy()
    y[100:110], u[200:203] = np.nan, np.nan
    small = OutputError(q=1e-5, r=s.sigma**2, theta0=s.xi[0])
    found = output_error(track(s.model, small, y, u))
    whole = output_error(run, start=s.xi[0])
    assert np.sqrt(np.mean((found.theta - whole.theta) ** 2)) < 0.02
    given = output_error(run, q=whole.q, r=whole.r, q_w=whole.q_w)
    np.testing.assert_allclose(given.theta, whole.theta, atol=1e-3)
    assert (given.r, given.q_w) == (whole.r, whole.q_w)


def test_levels_that_noise_moves_far_are_followed():
    """A pole near 1: simulated from the inputs alone w leaves the data, so the path begins at the measured levels."""
    rng = np.random.default_rng(2)
    u, w = rng.uniform(-1, 1, 600), np.zeros(600)
    for t in range(2, 600):
        w[t] = 1.6 * w[t - 1] - 0.601 * w[t - 2] + 0.4 * u[t - 1] + 0.05 * rng.normal()
    run = track(HammersteinWiener(2, 1), Kalman(q=0.0, r=1.0, p0=1e4), w, u)
    found = output_error(run)
    np.testing.assert_allclose(found.theta[-1], [-1.6, 0.601, 0.4], atol=0.02)
    assert abs(found.q_w**0.5 - 0.05) < 0.01
    assert found.r**0.5 < 0.02


def test_a_curve_without_inverse_and_its_knots():
    """A sensor that saturates at -1 and 1.5, behind a curve and a pole that drifts."""
    rng, T = np.random.default_rng(0), 1500
    u, a, w = rng.normal(size=T), -0.6 - 0.2 * np.arange(T) / T, np.zeros(T)
    v = u + 0.3 * u**2
    for t in range(1, T):
        w[t] = -a[t] * w[t - 1] + 0.7 * v[t - 1]
    y = np.clip(w, -1.0, 1.5) + 0.05 * rng.normal(size=T)
    run = track(HammersteinWiener(1, 1, input=Polynomial(2)), Kalman(q=1e-6, r=1e-2, p0=1e2), y, u)
    found = output_error(run, PiecewiseLinear((-0.7, 1.0)), knots=True)
    assert found.names[-2:] == ("knot1[y]", "knot2[y]")
    assert (np.abs(found.theta[-1, -2:] - [-1.0, 1.5]) < 4.0 * found.std[-1, -2:]).all()
    assert (found.std[-1, -2:] < 0.1).all()
    assert np.ptp(found.theta[:, -2:], axis=0).max() < 1e-9
    assert np.sqrt(np.mean((found.theta[:, 0] - a) ** 2)) < 0.03
    blocks = found.blocks()
    assert blocks.model.out.knots == tuple(found.theta[0, -2:])
    assert abs(blocks.output_curve(3.0) - 1.5) < 0.15
    with pytest.raises(ValueError, match="d1"):
        found.blocks(output="unit")


def test_a_nearly_even_curve_is_found_from_its_bends():
    """y = .1 w + w^2, of which the best line says nearly nothing."""
    rng, T = np.random.default_rng(2), 800
    u, w = rng.normal(size=T), np.zeros(T)
    for t in range(2, T):
        w[t] = 0.7 * w[t - 1] - 0.2 * w[t - 2] + 0.7 * u[t - 1] - 0.3 * u[t - 2]
    y = 0.1 * w + w**2
    y += 0.1 * y.std() * rng.normal(size=T)
    run = track(HammersteinWiener(2, 2), Kalman(q=1e-6, r=1e-2, p0=1e2), y, u)
    found = output_error(run, Polynomial(2))
    np.testing.assert_allclose(found.theta[-1, :4], [-0.7, 0.2, 0.07, -0.03], atol=0.03)
    line = [*np.median(run.theta[100:], axis=0), 0.0]
    assert output_error(run, Polynomial(2), start=line).loglik < found.loglik - 50.0


def test_what_it_refuses(noisy):
    s, run = noisy
    with pytest.raises(ValueError, match="HammersteinWiener"):
        output_error(track(ARX(1, 1), FLS(10.0), s.y, s.u))
    two = track(HammersteinWiener(1, 1, ny=2), Kalman(q=1e-5, r=1e-3, p0=1e2), np.stack([s.y, s.y], axis=1), s.u)
    with pytest.raises(ValueError, match="one output"):
        output_error(two)
    with pytest.raises(ValueError, match="whole record"):
        output_error(track(s.model, run.tracker, s.y, s.u, warm_start=run))
    with pytest.raises(ValueError, match="knots"):
        output_error(run, knots=True)
    with pytest.raises(ValueError, match="no sample"):
        output_error(run_of(s, y=np.full(400, np.nan)))

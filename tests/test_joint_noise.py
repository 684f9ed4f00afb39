"""One noise for several outputs, against the evidence of Bayes in closed form and the recursion of matrices."""

import numpy as np
import pytest
from scipy.special import multigammaln
from scipy.stats import multivariate_t

from driftfit import ARX, FLS, RLS, Bank, Change, Kalman, Regression, Sensor, track

N, NY = 2, 2
R = np.array([[1.0, 1.2], [1.2, 2.0]])


def record(T=60, seed=0, jump=0.0):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, N))
    theta = np.tile([[1.0, -2.0], [0.5, 3.0]], (T, 1, 1))
    theta[T // 2 :] += jump
    return np.einsum("tk,tok->to", u, theta) + rng.multivariate_normal(np.zeros(NY), R, T), u


def log_evidence(y, u):
    """Of all samples, for the prior |R|^(-(ny + 1) / 2) and a flat one of Theta."""
    nu = len(y) - N
    rest = y - u @ np.linalg.lstsq(u, y, rcond=None)[0]
    sizes = NY * np.linalg.slogdet(u.T @ u)[1] + nu * np.linalg.slogdet(rest.T @ rest)[1]
    return multigammaln(nu / 2.0, NY) - nu * NY / 2.0 * np.log(np.pi) - 0.5 * sizes


def twin(y, u, mu, keep):
    """The recursion of the matrix-normal inverse Wishart distribution, from a start that is next to diffuse."""
    M, V, S, nu, terms = np.zeros((N, NY)), 1e9 * np.eye(N), np.zeros((NY, NY)), 0.0, []
    for t, (row, phi) in enumerate(zip(y, u, strict=True)):
        V = V + np.eye(N) / mu if t else V
        e, q = row - phi @ M, phi @ V @ phi + 1.0
        if t >= N:
            S, nu = keep * S, keep * nu
            d = nu - NY + 1.0
            terms.append(multivariate_t(shape=q * S / d, df=d).logpdf(e) if t >= N + NY else np.nan)
            S, nu = S + np.outer(e, e) / q, nu + 1.0
        M, V = M + np.outer(V @ phi, e) / q, V - np.outer(V @ phi, V @ phi) / q
    return M, V, S / nu, np.array(terms)


def test_least_squares_has_the_exact_evidence_of_all_outputs():
    y, u = record()
    noise = track(Regression(N, ny=NY), RLS(1.0), y, u).joint_noise()
    exact = log_evidence(y, u) - log_evidence(y[: N + NY], u[: N + NY])
    assert noise.loglik == pytest.approx(exact, abs=1e-8)
    assert np.isnan(noise.log_density[: N + NY]).all()


@pytest.mark.parametrize("memory", [None, 20.0])
def test_drifting_parameters_are_followed_as_by_matrices(memory):
    y, u = record(jump=1.0)
    run = track(Regression(N, ny=NY), FLS(20.0), y, u)
    noise = run.joint_noise(memory)
    M, V, found, terms = twin(y, u, 20.0, 1.0 if memory is None else 1.0 - 1.0 / memory)
    np.testing.assert_allclose(run.theta[-1], M.T, atol=1e-6)
    np.testing.assert_allclose(noise.cov[-1], found, atol=1e-6)
    np.testing.assert_allclose(noise.log_density[N + NY :], terms[NY:], atol=1e-5)
    if memory is None:
        np.testing.assert_allclose(np.diag(noise.cov[-1]), [run[o].state["scale"] for o in run.outputs], rtol=1e-9)
        np.testing.assert_allclose(noise.theta_cov(-1), np.kron(found, V), atol=1e-6)
    assert noise.correlation[-1, 0, 1] == pytest.approx(found[0, 1] / np.sqrt(found[0, 0] * found[1, 1]), abs=1e-6)


def test_an_output_that_is_missing_leaves_the_density_of_the_other():
    y, u = record()
    y[-1, 1] = np.nan
    run = track(Regression(N, ny=NY), RLS(1.0), y, u)
    noise = run.joint_noise()
    assert (noise.cov[-1] == noise.cov[-2]).all()
    d = 59 - N - NY + 1.0  # fewer than those of the output alone: its share of an inverse Wishart matrix
    rest = y[:59] - u[:59] @ np.linalg.lstsq(u[:59], y[:59], rcond=None)[0]
    q = 1.0 + u[-1] @ np.linalg.solve(u[:59].T @ u[:59], u[-1])
    one = multivariate_t(shape=q * (rest.T @ rest)[0, 0] / d, df=d).logpdf(run.innovation[-1, 0])
    assert noise.log_density[-1] == pytest.approx(one, abs=1e-9)


def test_a_run_continues_where_another_ended():
    y, u = record()
    model = Regression(N, ny=NY)
    whole = track(model, RLS(1.0), y, u).joint_noise()
    rest = track(model, RLS(1.0), y[30:], u[30:], warm_start=track(model, RLS(1.0), y[:30], u[:30])).joint_noise()
    assert rest.cov[-1] * 30 == pytest.approx(whole.cov[-1] * 58 - whole.cov[29] * 28, abs=1e-8)


def test_rows_are_least_squares_weighed_by_the_noise():
    """Of all outputs at once, also where one of them is missing, against dense generalised least squares."""
    y, u = record()
    y[[3, 10], [0, 1]] = np.nan
    model, rows, blocks = track(Regression(N, ny=NY), RLS(1.0), y, u).joint_noise().rows(R)
    found = track(model, Kalman(q=0.0, r=1.0, p0=5.0), rows, blocks)
    information, right = np.eye(N * NY) / 5.0, np.zeros(N * NY)
    for row, phi in zip(y, u, strict=True):
        seen = np.flatnonzero(np.isfinite(row))
        X = np.kron(np.eye(NY), phi)[seen]
        weight = np.linalg.inv(R[np.ix_(seen, seen)])
        information += X.T @ weight @ X
        right += X.T @ weight @ row[seen]
    np.testing.assert_allclose(found.theta[-1], np.linalg.solve(information, right), atol=1e-9)
    np.testing.assert_allclose(found.cov(-1), np.linalg.inv(information), atol=1e-9)
    assert found.names[2] == "theta1[y2]"


def test_a_bank_has_one_tree_for_all_outputs():
    """A jump of all parameters by less than the noise of an output: correlated noises hardly hide what is opposite."""
    bank = Bank([Change(0.0), Change(1.0, prob=0.01)], [Sensor.nominal()])
    gains = []
    for seed in range(8):
        y, u = record(120, seed, jump=np.array([[0.5], [-0.5]]))
        alone = track(Regression(N, ny=NY), bank, y, u)
        model, rows, blocks = track(Regression(N, ny=NY), RLS(0.98), y, u).joint_noise().rows()
        found = track(model, bank, rows, blocks).rows.hypotheses.found()
        together = any(abs(one.span.date // NY - 60) <= 3 for one in found)
        gains.append(
            (together, *(any(abs(e.span.date - 60) <= 3 for e in one.hypotheses.found()) for one in alone.values()))
        )
    together, first, second = np.sum(gains, axis=0)
    assert together >= 6
    assert max(first, second) <= 3


def test_runs_that_cannot_share_their_noise_are_refused():
    y, u = record()
    with pytest.raises(ValueError, match="does not estimate"):
        track(Regression(N, ny=NY), Kalman(1e-3, 1.0), y, u).joint_noise()
    with pytest.raises(ValueError, match="above 3 samples"):
        track(Regression(N, ny=NY), RLS(1.0), y, u).joint_noise(2.0)


def test_outputs_of_arx_share_their_regressors():
    y, u = record(80)
    noise = track(ARX(1, 1, ny=NY), RLS(1.0), y, u[:, :1]).joint_noise()
    X = np.column_stack([y[:-1], u[:-1, 0]])
    rest = y[1:] - X @ np.linalg.lstsq(X, y[1:], rcond=None)[0]
    np.testing.assert_allclose(noise.cov[-1], rest.T @ rest / (79 - 3), rtol=1e-9)

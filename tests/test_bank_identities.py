"""Identities of banks: unknown noise, scale, order of hypotheses, merging, and the price of waiting."""

import math
from collections import namedtuple

import numpy as np
import pytest
from numba import njit
from scipy import integrate, special, stats
from test_bank import P3, PROBS, N, Q, R, changes, record, reported, state

from driftfit import ARX, Bank, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.leaves.leaf_matrix import FIRST, NU, WEIGHT, S
from driftfit.bank.reducing import lookahead, merge
from driftfit.bank.reduction import GPB, IMM, Beam, Decide
from driftfit.bank.sensor import Sensor

Y, U = record(60, 11, (25,))


Table = namedtuple("Table", "leaves parents n output_lags unknown")
"""As much of a bank's table as merging asks for."""


@njit
def match(t, members, share):
    merge.match(t, members, share, 0)


def matched(B, members, unknown, share, A):
    match(Table(B, A, 2, 0, int(unknown)), members, share)


@njit
def integrated(parts, count, loss, f):
    return lookahead.integrate(parts, count, loss, f)


def unknown(**more):
    return [Sensor.nominal(guess=0.09, nu=4.0, **more)]


def test_the_predictive_density_is_the_integral_over_the_noise_variance():
    bank = Bank([Change(0.0)], unknown(memory=None), p0=2.0)
    run = track(Regression(N), bank, Y[:1], U[:1])
    V, nu, S0 = 2.0 / 0.09 * np.eye(N), 4.0, 0.36
    q = 1.0 + U[0] @ V @ U[0]

    def joint(s2):
        prior = stats.invgamma.pdf(s2, nu / 2.0, scale=S0 / 2.0)
        return prior * stats.norm.pdf(Y[0], 0.0, math.sqrt(s2 * q))

    value, _ = integrate.quad(joint, 0.0, 50.0, limit=500, points=[0.05, 0.2, 1.0])
    assert reported(run, "evidence")[0] == pytest.approx(math.log(value), abs=1e-6)


@pytest.mark.parametrize(("noise", "reduce"), [("guess", None), ("r", GPB(2))])
def test_evidence_changes_by_the_logarithm_of_the_scale(noise, reduce):
    def run(a):
        wide = [Change(q * a * a, prob=p) for q, p in zip(Q, PROBS, strict=True)]
        sensors = [Sensor.nominal(**{noise: 0.09 * a * a})]
        return track(Regression(N), Bank(wide, sensors, reduce=reduce, p0=2.0 * a * a), a * Y, U)

    one, other = run(1.0), run(7.0)
    np.testing.assert_allclose(other.theta, 7.0 * one.theta, atol=1e-9)
    np.testing.assert_allclose(reported(other, "evidence"), reported(one, "evidence") - math.log(7.0), atol=1e-10)


def test_lags_that_leaves_keep_know_no_scale_either():
    """The spread of the lags of merged leaves, squares of the output, was added to variances in units of the noise."""
    sensors = [Sensor.nominal(), Sensor.outlier(5.0, "additive", prob=0.03)]
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal(200), np.zeros(200)
    for t in range(1, 200):
        y[t] = 0.6 * y[t - 1] + u[t - 1] * (0.5 if t < 100 else 1.0) + 0.1 * rng.standard_normal()
    y[rng.random(200) < 0.03] += 3.0

    def run(a):
        unit = np.array([1.0, a]) / (0.1 * a)
        bank = Bank([Change(0.0), Change(0.25 * unit**2, prob=0.01)], sensors, p0=unit**2)
        return track(ARX(1, 1), bank, a * y, u)

    one = run(1.0)
    for a in (1e6, 1e-6):
        other = run(a)
        np.testing.assert_allclose(other.theta, one.theta * [1.0, a], rtol=1e-7, atol=1e-9 * a)
        assert other.loglik + np.isfinite(other.log_density).sum() * math.log(a) == pytest.approx(one.loglik, abs=1e-7)


@pytest.mark.parametrize("reduce", [GPB(2), IMM()], ids=str)
def test_a_hypothesis_given_twice_counts_once(reduce):
    one = track(Regression(N), Bank(changes(), [Sensor.nominal(R)], reduce=reduce, p0=2.0), Y, U)
    twice = [changes()[0], *(Change(q, prob=p / 2.0) for q, p in zip(Q[1:], PROBS[1:], strict=True) for _ in "ab")]
    other = track(Regression(N), Bank(twice, [Sensor.nominal(R)], reduce=reduce, p0=2.0), Y, U)
    np.testing.assert_allclose(other.theta, one.theta, atol=1e-10)
    np.testing.assert_allclose(other.std, one.std, atol=1e-10)


@pytest.mark.parametrize("reduce", [GPB(2), Decide(3), Beam(7)], ids=str)
def test_the_order_of_changes_does_not_matter(reduce):
    order = [2, 0, 1]
    one = track(Regression(N), Bank(changes(), [Sensor.nominal(R)], P3, reduce, p0=2.0), Y, U)
    turned = [changes()[i] for i in order]
    bank = Bank(turned, [Sensor.nominal(R)], P3[np.ix_(order, order)], reduce, p0=2.0)
    other = track(Regression(N), bank, Y, U)
    np.testing.assert_allclose(other.theta, one.theta, atol=1e-10)
    np.testing.assert_allclose(reported(other, "lag_prob")[:, 0], reported(one, "lag_prob")[:, 0][:, order], atol=1e-10)


def leaves(seed, count, known):
    rng = np.random.default_rng(seed)
    B = np.zeros((FIRST + 5, count))
    B[WEIGHT] = rng.dirichlet(np.ones(count))
    B[NU], B[S] = rng.uniform(5.0, 40.0, count), rng.uniform(0.5, 5.0, count)
    B[FIRST : FIRST + 2] = rng.standard_normal((2, count))
    for l in range(count):
        root = rng.standard_normal((2, 2))
        B[FIRST + 2 :, l] = (root @ root.T)[np.tril_indices(2)]
    return B


@pytest.mark.parametrize("known", [True, False])
def test_merging_keeps_the_moments(known):
    B, A = leaves(3, 4, known), np.zeros((FIRST + 5, 1))
    matched(B, np.arange(4), not known, B[WEIGHT].copy(), A)

    def moments(X, w):
        g = np.ones(X.shape[1]) if known else X[NU] / X[S]
        m, C = X[FIRST : FIRST + 2], np.zeros((X.shape[1], 2, 2))
        i, j = np.tril_indices(2)
        C[:, i, j] = C[:, j, i] = X[FIRST + 2 :].T
        second = C + g[:, None, None] * np.einsum("il,jl->lij", m, m)
        parts = [w @ g, (w * g) @ m.T, np.einsum("l,lij->ij", w, second)]
        if not known:
            parts.append(w @ (special.digamma(X[NU] / 2.0) - np.log(X[S] / 2.0)))
        return np.concatenate([np.ravel(part) for part in parts])

    np.testing.assert_allclose(moments(A, np.ones(1)), moments(B, B[WEIGHT]), atol=1e-8)
    same = np.repeat(B[:, :1], 3, axis=1)
    matched(same, np.arange(3), not known, np.full(3, 1.0 / 3.0), A)
    np.testing.assert_allclose(A[NU:, 0], B[NU:, 0], rtol=1e-8)


def test_what_waiting_is_worth():
    """The expected risk is at most the present one, and it is the mean over draws of the next output."""
    rng = np.random.default_rng(4)
    parts = np.zeros((4, 4))
    parts[0, :4], parts[1, :4] = [0, 0, 1, 1], [0.5, 0.1, 0.25, 0.15]
    parts[2, :4], parts[3, :4] = [0.0, 0.5, 1.5, 0.0], [0.3, 2.0, 0.4, 3.0]
    loss = np.array([[0.0, 1.0], [3.0, 0.0]])
    value = integrated(parts, 4, loss, np.zeros(2))
    risk = min(loss[:, k] @ [0.6, 0.4] for k in (0, 1))
    assert value <= risk + 1e-12
    of = rng.choice(4, 100_000, p=parts[1])
    y = parts[2, of] + parts[3, of] * rng.standard_normal(100_000)
    density = parts[1, :, None] * stats.norm.pdf(y, parts[2, :, None], parts[3, :, None])
    f = np.array([density[:2].sum(axis=0), density[2:].sum(axis=0)])
    draws = (loss.T @ (f / f.sum(axis=0))).min(axis=0)
    assert abs(value - draws.mean()) < 4.0 * draws.std() / math.sqrt(100_000) + 1e-3


def test_weights_sum_to_one_for_a_long_time():
    rng = np.random.default_rng(6)
    u = rng.standard_normal((20_000, N))
    run = track(Regression(N), Bank(changes(), [Sensor.nominal(R)], reduce=GPB(2), p0=1e10), u @ [1.0, 2.0], u)
    w = state(run, "leaves")[WEIGHT, :9]
    assert w.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.isfinite(run.theta).all()


def test_a_regressor_of_zeros_moves_weights_by_the_prior_only():
    u = U.copy()
    u[:] = 0.0
    run = track(Regression(N), Bank(changes(), [Sensor.nominal(R)], P3, GPB(2), p0=2.0), Y, u)
    p = run.hypotheses.prob()
    np.testing.assert_allclose(p[1:], p[:-1] @ P3, atol=1e-12)

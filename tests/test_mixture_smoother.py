"""The smoother of mixtures: exact where that can be computed, and the same as the exact smoother for one hypothesis."""

import contextlib
from itertools import product

import numpy as np
import pytest
from test_bank import N, R, changes, record

from driftfit import FLS, Bank, Kalman, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.results.smoothed import problem_of
from driftfit.bank.sensor import Sensor
from driftfit.smooth import mixture
from driftfit.smooth.mixture import Problem

KNOWN = [Sensor.nominal(R)]


def dense(problem, Q, r, y):
    """Mean, covariance and log evidence of the whole path (T n) with these covariances of its steps."""
    T, n = problem.phi.shape
    rows = problem.start[:, :n]
    C0 = np.linalg.inv(rows.T @ rows)
    m0 = C0 @ rows.T @ problem.start[:, n]
    sums = np.kron(np.tril(np.ones((T, T))), np.eye(n))
    steps = np.zeros((T * n, T * n))
    for t in range(T):
        steps[t * n : (t + 1) * n, t * n : (t + 1) * n] = Q[t] + (C0 if t == 0 else 0.0)
    prior, H = sums @ steps @ sums.T, np.zeros((T, T * n))
    for t in range(T):
        H[t, t * n : (t + 1) * n] = problem.phi[t]
    used = np.isfinite(r)
    H, e = H[used], (y - problem.phi @ m0)[used]
    S = H @ prior @ H.T + np.diag(r[used])
    gain = np.linalg.solve(S, H @ prior).T
    evidence = -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2.0 * np.pi * S)[1])
    return np.tile(m0, T) + gain @ e, prior - gain @ H @ prior, evidence


def enumerated(problem):
    """The exact mixture of a problem with one or more modes: every sequence of moves and noises, smoothed by itself."""
    T, n = problem.phi.shape
    moves, noises = problem.alternatives, problem.noises
    found = []
    for path in product(range(len(moves.source)), repeat=T):
        modes = [0, *moves.target[list(path)]]
        if any(moves.source[m] != s for m, s in zip(path, modes, strict=False)):
            continue
        prior = sum(moves.log_prob[problem.table[t], m] for t, m in enumerate(path))
        Q = []
        for t, event in enumerate(moves.event[list(path)]):
            G = moves.roots[event] * problem.sizes[t, event]
            Q.append(G @ G.T)
        for noise in product(range(len(noises.kind)), repeat=T):
            logs = prior + sum(noises.log_prob[s, l] for s, l in zip(modes[1:], noise, strict=True))
            if logs > -500.0:
                kind = noises.kind[list(noise)]
                mean, cov, evidence = dense(problem, Q, problem.r * kind[:, 0], problem.y - kind[:, 1])
                found.append((logs + evidence, moves.event[list(path)], mean, cov))
    logs = np.array([one[0] for one in found])
    w = np.exp(logs - logs.max())
    total = w.sum()
    w /= total
    mean = sum(a * m for a, (_, _, m, _) in zip(w, found, strict=True))
    cov = sum(a * (C + np.outer(m - mean, m - mean)) for a, (_, _, m, C) in zip(w, found, strict=True))
    return w, found, mean.reshape(T, n), cov, float(np.log(total) + logs.max())


def short(T, bank, seed=3):
    rng = np.random.default_rng(seed)
    u, theta = rng.standard_normal((T, N)), np.zeros((T, N))
    theta[T // 2 :] = 2.0, -1.0
    y = (u * theta).sum(axis=1) + rng.standard_normal(T)
    y[2] = np.nan
    return problem_of(track(Regression(N), bank, y, u), [])


UNIT = [Sensor.nominal(1.0)]
BANKS = {
    "two changes": (9, Bank([Change(0.01), Change((9.0, 0.0), prob=0.05)], UNIT, p0=4.0)),
    "a chain": (8, Bank([Change(0.01), Change(4.0)], UNIT, [[0.9, 0.1], [0.3, 0.7]], p0=4.0)),
    "outliers": (6, Bank([Change(0.01), Change(9.0, prob=0.05)], [*UNIT, Sensor.outlier(5.0, prob=0.1)], p0=4.0)),
    "an offset": (6, Bank([Change(0.01), Change(9.0, prob=0.1)], [*UNIT, Sensor.offset(3.0, prob=0.1)], p0=4.0)),
}


@pytest.mark.parametrize("name", BANKS)
def test_it_is_the_sum_over_all_sequences(name):
    T, bank = BANKS[name]
    problem = short(T, bank)
    w, found, mean, cov, evidence = enumerated(problem)
    smoothed = mixture.smooth(problem, covariances=True)
    std, close = np.sqrt(np.diag(cov)).reshape(T, N), 0.03
    assert (np.abs(smoothed.theta - mean) < close * std).all()
    blocks = np.array([cov[t * N : (t + 1) * N, t * N : (t + 1) * N] for t in range(T)])
    assert (np.abs(smoothed.cov - blocks) < 3.0 * close * np.einsum("ti,tj->tij", std, std)).all()
    np.testing.assert_allclose(mixture.smooth(problem).cov, np.einsum("tii->ti", smoothed.cov), rtol=1e-12)
    events = sum(a * (one[1][:, None] == np.arange(2)) for a, one in zip(w, found, strict=True))
    np.testing.assert_allclose(smoothed.events[1:], events[1:], atol=close / 3.0)
    np.testing.assert_allclose(smoothed.evidence, evidence, atol=close)
    at = T // 2
    step = np.zeros((N, T * N))
    step[:, at * N : (at + 1) * N], step[:, (at - 1) * N : at * N] = np.eye(N), -np.eye(N)
    on = [(a, step @ m, step @ C @ step.T) for a, (_, e, m, C) in zip(w, found, strict=True) if e[at]]
    share = sum(a for a, _, _ in on)
    shift = sum(a * m for a, m, _ in on) / share
    var = sum(a * (np.diag(C) + (m - shift) ** 2) for a, m, C in on) / share
    np.testing.assert_allclose(smoothed.shift[at], shift, atol=3.0 * close * np.sqrt(var.max()))
    np.testing.assert_allclose(smoothed.shift_var[at], var, rtol=4.0 * close, atol=1e-6)


def test_the_filter_has_the_evidence_of_the_smoother():
    problem = short(9, BANKS["two changes"][1])
    evidence, squares, spikes = mixture.filtered(problem, 12)
    assert evidence == pytest.approx(mixture.smooth(problem).evidence[0], abs=0.02)
    assert 0.3 < squares / 8 < 2.0
    assert spikes == 0.0  # there is one noise


@pytest.mark.parametrize("p0", [None, 2.0])
@pytest.mark.parametrize("T", [120, 2300])
def test_one_hypothesis_is_the_exact_smoother(p0, T):
    y, u = record(T, 5, (40, 90))
    y[10:15] = np.nan
    time = np.cumsum(np.where(np.arange(T) % 7 == 3, 3.0, 1.0))
    bank = track(Regression(N), Bank([Change(0.01)], KNOWN, p0=p0), y, u, time=time, dt=1.0).smooth()
    kalman = track(Regression(N), Kalman(0.01, R, p0=p0), y, u, time=time, dt=1.0).smooth()
    np.testing.assert_allclose(bank.theta, kalman.theta, atol=1e-9)
    np.testing.assert_allclose(bank.std, kalman.std, atol=1e-9)


def test_it_is_that_of_flexible_least_squares_too():
    y, u = record(200, 5, (40, 90))
    bank = track(Regression(N), Bank([Change(R / 50.0)], KNOWN), y, u).smooth()
    np.testing.assert_allclose(bank.theta, track(Regression(N), FLS(50.0), y, u).smooth().theta, atol=1e-9)


def hard(case):
    """Regressors that a covariance with a wide prior cannot take."""
    rng = np.random.default_rng(7)
    T = 90
    u = rng.standard_normal((T, N))
    if case == "collinear":
        u[:, 1] = u[:, 0] + 1e-5 * u[:, 1]
    if case == "scales":
        u *= 1e3, 1e-3
    if case == "an unexcited half":
        u[:45, 1] = 0.0
    if case == "unexcited at the end":
        u[60:, 0] = 0.0
    if case == "never excited":
        u[:, 1] = 0.0
    y = u @ [1.0, -1.0] + 0.3 * rng.standard_normal(T)
    if case == "gaps":
        y[:20] = y[40:60] = y[80:] = np.nan
    return y, u


@pytest.mark.parametrize(
    "case", ["collinear", "scales", "an unexcited half", "unexcited at the end", "gaps", "never excited"]
)
def test_nothing_need_be_known_at_either_end(case):
    """Two hypotheses that are the same, and a diffuse start: the numbers of the exact smoother, as of a dense solve."""
    y, u = hard(case)
    unit = 1.0 / np.mean(u**2, axis=0).clip(1e-20)
    bank = Bank([Change(1e-4 * unit, prob=0.7), Change(1e-4 * unit, prob=0.3)], KNOWN)
    with contextlib.nullcontext() if case != "never excited" else pytest.warns(UserWarning, match="theta2 could not"):
        found = track(Regression(N), bank, y, u).smooth()
    kalman = track(Regression(N), Kalman(1e-4 * unit, R), y, u).smooth()
    np.testing.assert_allclose(found.theta / kalman.std, kalman.theta / kalman.std, atol=1e-6)
    np.testing.assert_allclose(found.std, kalman.std, rtol=1e-6)
    np.testing.assert_allclose(found.change_prob[1:, 1], 0.3, atol=1e-6)


def test_a_jump_is_found_while_another_parameter_is_unknown():
    y, u = record(200, 5, (40,))
    u[:100, 1], y = 0.0, y + u[:, 0] * np.where(np.arange(200) < 60, 0.0, 3.0)
    rng = np.random.default_rng(1)
    y = u @ [1.0, 1.0] + u[:, 0] * np.where(np.arange(200) < 60, 0.0, 3.0) + 0.3 * rng.standard_normal(200)
    (event,) = track(Regression(N), Bank(changes(), KNOWN), y, u).changes()
    assert event.first <= 60 <= event.last
    assert event.shift["theta1"] == pytest.approx(3.0, abs=4.0 * event.std["theta1"])


def test_more_components_are_allowed_where_the_evidence_is_not_constant(monkeypatch):
    """With one component jumps are lost; the check sees it, and smoothing again finds them."""
    problem = short(100, Bank([Change(1e-4), Change(9.0, prob=0.01)], UNIT, p0=4.0), seed=1)
    full = mixture.smooth(problem)
    assert not full.uneven.any()
    one = mixture.Passes(problem, np.ones(100, int)).smoothed(False)
    assert one.uneven.any()
    monkeypatch.setattr(mixture, "ROOMY", 1)
    again = mixture.smooth(problem)
    assert again.kept.max() > again.kept.min()
    assert np.abs(again.theta - full.theta).max() < 0.3 * np.abs(one.theta - full.theta).max()


def test_memory_is_that_of_the_result():
    """Components of a block, whatever the length of the record."""
    problem = short(60, BANKS["two changes"][1])
    T = 5000
    long = Problem(
        *(np.resize(values, (T, *values.shape[1:])) for values in problem[:3]), problem.alternatives,
        np.zeros(T, np.int64), np.ones((T, 2)), problem.start, problem.noises,
    )  # fmt: skip
    passes = mixture.Passes(long, np.full(T, 12))
    assert len(passes.stored.A) == mixture.BLOCK
    whole = mixture.Passes(long, np.full(T, 12)).smoothed(False)
    assert np.abs(whole.evidence - whole.evidence[0]).max() < 1.0

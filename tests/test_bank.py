"""The bank of hypotheses against a naive twin, against dense Gaussians, and against itself in other clothes."""

from itertools import pairwise, product

import naive_bank
import numpy as np
import pytest
from support import same

from driftfit import ARX, Bank, Kalman, Live, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid, Resample
from driftfit.bank.sensor import Sensor

N, R = 2, 0.09
Q = np.array([1e-4 * np.eye(2), 0.6 * np.eye(2), np.diag([0.0, 1.5])])
P3 = np.array([[0.97, 0.02, 0.01], [0.3, 0.6, 0.1], [0.2, 0.3, 0.5]])
PROBS = np.array([0.97, 0.018, 0.012])


def changes(probs=PROBS):
    return [Change(q, prob=p) for q, p in zip(Q, probs, strict=True)]


def record(T, seed=0, jumps=(20, 45), outliers=()):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, N))
    theta = np.array([1.0, -0.5])
    y = np.empty(T)
    for t in range(T):
        theta = theta + rng.standard_normal(N) if t in jumps else theta
        y[t] = u[t] @ theta + np.sqrt(R) * rng.standard_normal() * (8.0 if t in outliers else 1.0)
    return y, u


Y, U = record(70, outliers=(30, 60))
SENSORS = [Sensor.nominal(R), Sensor.outlier(10.0, prob=0.05)]
TABLE = [(R, 0.0, False), (100.0 * R, 0.0, False)]
PRIORS = {
    "independent": (None, np.tile(np.kron(PROBS, [0.95, 0.05]), (6, 1)), np.kron(PROBS, [0.95, 0.05])),
    "Markov": ((P3, None), np.kron(P3, np.tile([0.95, 0.05], (2, 1))), None),
}


def reported(run, name):
    return run.tracker.reported(run.written("report"), name)


def state(run, name):
    return run.tracker.array(run.model, {"memory": run.state["memory"]}, name)


def compare(run, twin, y, u, atol=1e-10, lags=1):
    total = 0.0
    for t in range(len(y)):
        total += twin.see(u[t], y[t])
        np.testing.assert_allclose(run.theta[t], twin.mean, atol=atol)
        np.testing.assert_allclose(reported(run, "evidence")[: t + 1].sum(), total, atol=1e-8)
        for k in range(min(lags, t + 1)):
            np.testing.assert_allclose(reported(run, "lag_prob")[t, k], twin.lag(k, len(twin.initial)), atol=atol)
    np.testing.assert_allclose(run.cov(-1), twin.cov, atol=atol)


@pytest.mark.parametrize("prior", list(PRIORS))
@pytest.mark.parametrize(
    ("reduce", "naive", "lags"),
    [
        (Beam(7), naive_bank.beam(7), 5),
        (Resample(7, seed=3), naive_bank.resample(7, 3, 2), 5),
        (Decide(3), naive_bank.decide(3, 6), 3),
        (GPB(2), naive_bank.gpb(2), 1),
        (GPB(3), naive_bank.gpb(3), 2),
    ],
    ids=["Beam(7)", "Resample(7)", "Decide(3)", "GPB(2)", "GPB(3)"],
)
def test_every_reduction_is_what_its_naive_twin_says(prior, reduce, naive, lags):
    transition, P, initial = PRIORS[prior]
    bank = Bank(changes(), SENSORS, transition, reduce, p0=2.0, initial=initial)
    initial = bank.event_probabilities[1]
    twin = naive_bank.Bank(Q, TABLE, P, initial, np.zeros(N), 2.0 * np.eye(N), naive)
    compare(track(Regression(N), bank, Y, U), twin, Y, U, lags=lags)


def test_resampling_leaves_weights_right_on_average():
    w = np.random.default_rng(8).dirichlet(np.full(20, 0.2))
    new = np.array([naive_bank.resampled(w, 6, u) for u in (np.arange(4000) + 0.5) / 4000])
    np.testing.assert_allclose(new.mean(axis=0), w, atol=2e-4)
    np.testing.assert_allclose(new.sum(axis=1), 1.0, atol=1e-12)
    assert ((new > 0.0).sum(axis=1) <= 6).all()


def test_open_probabilities_are_the_means_of_expected_counts():
    """A twin hands in the prior of every sample; two changes are too large for this record, and become rare."""
    open_changes, given = (
        [Change(q, prob=p) for q, p in zip((0.0, 1.0, 9.0, 1e4), prob, strict=True)]
        for prob in ([None] * 4, [0.7, 0.1, 0.1, 0.1])
    )
    run = track(Regression(N), Bank(open_changes, SENSORS, reduce=Hybrid(5, remembered=4), p0=2.0), Y, U)
    bank = Bank(given, SENSORS, reduce=Hybrid(5, remembered=4), p0=2.0)
    live, start = Live(Regression(N), bank), np.array([99.0, *[1.0 / 3.0] * 3])
    counts = start.copy()
    for t in range(len(Y)):
        live.update(Y[t], U[t], prob=counts / counts.sum())
        counts += (
            bank.reported(live.lane()["report"], "lag_prob")[-1].reshape(4, 2).sum(axis=1) - (counts - start) / 500
        )
        np.testing.assert_allclose(run.theta[t], live.theta, atol=1e-10)
    rates = run.hypotheses.rates
    assert rates["change 1"] > 1.0 / 300.0 > rates["change 3"]
    assert run.smooth().prior[5, 1:].sum() == pytest.approx(1.0 - rates["none"])


def test_rate_and_size_of_jumps_are_learned():
    rng = np.random.default_rng(5)
    z, jumped = rng.standard_normal((1500, N)), rng.random((1500, 1)) < 0.05
    theta = np.cumsum(jumped * rng.normal(0.0, 5.0, (1500, N)), axis=0)
    run = track(Regression(N), Bank(Change.unknown()), np.sum(z * theta, axis=1) + rng.standard_normal(1500), z)
    rates = run.hypotheses.rates
    assert rates["jump 5"] == pytest.approx(jumped.mean(), rel=0.3)
    assert max(rates["jump 50"], rates["jump 500"]) < 0.005


OPEN = [Change(0.0), Change(0.6), Change(60.0)]


@pytest.mark.parametrize("changes", [changes(), OPEN], ids=["given", "learned"])
def test_resampling_draws_the_same_numbers_in_every_mode(changes):
    bank = Bank(changes, [Sensor.nominal(R)], reduce=Resample(3), p0=2.0)
    alone, fleet = track(Regression(N), bank, Y, U), track(Regression(N), bank, [Y, Y], np.stack([U, U]), by="row")
    live = Live(Regression(N), bank)
    for t in range(len(Y)):
        live.update(Y[t], U[t])
        assert same(live.theta, alone.theta[t])
    assert all(same(one.theta, alone.theta) for one in fleet.values())
    other = Bank(changes, [Sensor.nominal(R)], reduce=Resample(3, seed=1), p0=2.0)
    assert not same(track(Regression(N), other, Y, U).theta, alone.theta)


def test_bands_do_not_become_narrower_by_resampling():
    """Frequent small jumps, of which many hypotheses remain: a beam of as many leaves has an NEES of 1.5."""
    jumps = [Change(0.0), Change(2.25, prob=0.03)]
    found = {}
    for reduce in (Beam(5), Resample(5)):
        bank, squares = Bank(jumps, [Sensor.nominal(1.0)], reduce=reduce, p0=10.0), []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            z = rng.standard_normal((400, N))
            jumped = (rng.random((400, 1)) < 0.03) * rng.normal(0.0, 1.5, (400, N))
            theta = np.cumsum(jumped, axis=0)
            run = track(Regression(N), bank, np.sum(z * theta, axis=1) + rng.standard_normal(400), z, keep="cov")
            e, P = run.theta - theta, run.covariances()
            P = np.tril(P) + np.tril(P, -1).swapaxes(1, 2)
            squares.append(np.einsum("ti,tij,tj->t", e, np.linalg.inv(P), e).mean() / N)
        found[type(reduce).__name__] = np.mean(squares)
    assert found["Beam"] > 1.3
    assert 0.85 < found["Resample"] < 1.15


@pytest.mark.parametrize("prior", list(PRIORS))
def test_without_reduction_it_is_the_joint_gaussian_of_every_sequence(prior):
    K = 3
    transition, P, initial = PRIORS[prior]
    bank = Bank(changes(), SENSORS, transition, Decide(K), p0=2.0, initial=initial)
    initial = bank.event_probabilities[1]
    run = track(Regression(N), bank, Y[:K], U[:K])
    logs = []
    for events in product(range(6), repeat=K):
        prior_log = np.log(initial[events[0]]) + sum(np.log(P[a, b]) for a, b in pairwise(events))
        noise = [TABLE[e % 2][0] for e in events]
        dense = naive_bank.evidence_of([e // 2 for e in events], U[:K], Y[:K], Q, noise, np.zeros(N), 2.0 * np.eye(N))
        logs.append(prior_log + dense)
    evidence = np.logaddexp.reduce(logs)
    assert reported(run, "evidence").sum() == pytest.approx(evidence, abs=1e-10)
    got = state(run, "leaves")[0, : 6**K]
    np.testing.assert_allclose(np.sort(got), np.sort(np.array(logs) - evidence), atol=1e-10)


def test_unlimited_beam_is_the_full_tree_is_gpb():
    runs = [
        track(Regression(N), Bank(changes(), [Sensor.nominal(R)], reduce=reduce, p0=2.0), Y[:4], U[:4])
        for reduce in (Decide(4), GPB(4), Beam(27))
    ]
    for run in runs[1:]:
        np.testing.assert_allclose(run.theta, runs[0].theta, atol=1e-12)
        np.testing.assert_allclose(reported(run, "evidence"), reported(runs[0], "evidence"), atol=1e-12)


def test_imm_is_gpb1_for_independent_events():
    runs = [
        track(Regression(N), Bank(changes(), [Sensor.nominal(R)], reduce=reduce, p0=2.0), Y, U)
        for reduce in (IMM(), GPB(1))
    ]
    np.testing.assert_allclose(runs[0].theta, runs[1].theta, atol=1e-10)
    np.testing.assert_allclose(runs[0].std, runs[1].std, atol=1e-10)
    np.testing.assert_allclose(reported(runs[0], "evidence"), reported(runs[1], "evidence"), atol=1e-10)


def test_imm_mixes_as_in_the_book():
    bank = Bank(changes(), [Sensor.nominal(R)], P3, IMM(), p0=2.0)
    run = track(Regression(N), bank, Y, U)
    m, C, mu = np.zeros((3, N)), np.tile(2.0 * np.eye(N), (3, 1, 1)), None
    for t in range(len(Y)):
        c = bank.event_probabilities[1] if mu is None else mu @ P3
        if mu is not None:
            W = mu[:, None] * P3 / c
            mixed = W.T @ m
            C = np.array([
                sum(W[i, j] * (C[i] + np.outer(m[i] - mixed[j], m[i] - mixed[j])) for i in range(3)) for j in range(3)
            ])  # fmt: skip
            m = mixed
        logs = np.empty(3)
        for j in range(3):
            Cj = C[j] + Q[j]
            s, e = R + U[t] @ Cj @ U[t], Y[t] - U[t] @ m[j]
            logs[j] = np.log(c[j]) + naive_bank.log_normal(e, s)
            m[j] = m[j] + Cj @ U[t] / s * e
            C[j] = Cj - np.outer(Cj @ U[t], U[t] @ Cj) / s
        mu = np.exp(logs - np.logaddexp.reduce(logs))
        np.testing.assert_allclose(run.theta[t], mu @ m, atol=1e-10)
        np.testing.assert_allclose(reported(run, "lag_prob")[t, 0], mu, atol=1e-10)


@pytest.mark.parametrize("form", [{"p0": 2.0}, {}])
@pytest.mark.parametrize("reduce", [Beam(3), Decide(2), GPB(2), IMM(), Hybrid(3)], ids=str)
def test_one_hypothesis_is_the_kalman_filter_bit_for_bit(reduce, form):
    y, u = Y.copy(), U.copy()
    y[[25, 26]], u[40] = np.nan, np.nan
    kalman = track(Regression(N), Kalman(q=1e-3, r=R, **form), y, u)
    bank = track(Regression(N), Bank([Change(1e-3)], [Sensor.nominal(R)], reduce=reduce, **form), y, u)
    for name in ("theta", "std", "prediction", "innovation", "innovation_std", "ok"):
        one, other = getattr(kalman, name), getattr(bank, name)
        if form:
            assert same(one, other), name
        else:  # without a prior a Kalman filter stays in square-root form for longer, to judge its first samples
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13, err_msg=name)


def test_first_floor_with_prior_weights_is_one_kalman_filter():
    mean = np.einsum("i,ijk->jk", PROBS, Q)
    kalman = track(Regression(N), Kalman(q=mean, r=R, p0=2.0), Y, U)
    bank = Bank(changes(), [Sensor.nominal(R)], reduce=FirstFloor(3, "prior"), p0=2.0)
    run = track(Regression(N), bank, Y, U)
    D = 3
    root = state(run, "root")[:, 0]
    np.testing.assert_allclose(root[8 : 8 + N], kalman.theta[len(Y) - 1 - D], atol=1e-12)


def test_first_floor_remembers_what_its_tree_says():
    run = track(Regression(N), Bank(changes(), [Sensor.nominal(R)], reduce=FirstFloor(3), p0=2.0), Y, U)
    p = reported(run, "lag_prob")
    np.testing.assert_allclose(p[3:].sum(axis=2), 1.0, atol=1e-12)
    assert p[47, 1, 1:].sum() > 0.5  # the second jump, one sample later


def test_leaves_clean_their_own_lags():
    """Additive outliers: every leaf has its own regressor."""
    rng = np.random.default_rng(3)
    T = 60
    u, x, y = rng.standard_normal(T), np.zeros(T), np.zeros(T)
    for t in range(T):
        x[t] = (0.7 * x[t - 1] if t else 0.0) + u[t] + 0.3 * rng.standard_normal()
        y[t] = x[t] + (5.0 if t in (20, 40) else 0.0)
    sensors = [Sensor.nominal(R), Sensor.outlier(10.0, "additive", prob=0.05)]
    bank = Bank(changes(), sensors, reduce=Beam(7), p0=2.0, lag_variance=False)
    run = track(ARX(1, 1, nk=0, start="zero"), bank, y, u)
    P = np.tile(np.kron(PROBS, [0.95, 0.05]), (6, 1))
    table = [(R, 0.0, False), (100.0 * R, 0.0, True)]
    twin = naive_bank.Bank(Q, table, P, P[0], np.zeros(2), 2.0 * np.eye(2), naive_bank.beam(7), na=1)
    for t in range(T):
        twin.see(np.array([0.0, u[t]]), y[t])
        np.testing.assert_allclose(run.theta[t], twin.mean, atol=1e-10)


def test_lags_that_were_predicted_are_uncertain():
    """One history, given by prob=: every sample from 20 on is an additive outlier, or missing, for a while."""
    rng = np.random.default_rng(3)
    T, q = 60, 1e-3
    u, y = rng.standard_normal(T), np.zeros(T)
    for t in range(T):
        y[t] = (1.2 * y[t - 1] - 0.5 * y[t - 2] if t > 1 else 0.0) + u[t] + 0.3 * rng.standard_normal()
    y[[23, 45]] = np.nan
    bad = np.isin(np.arange(T), [20, 21, 22, 24, 40])
    sensors = [Sensor.nominal(R), Sensor.outlier(10.0, "additive", prob=0.05)]
    run = track(ARX(2, 1, nk=0, start="zero"), Bank([Change(q)], sensors, reduce=GPB(2), p0=2.0), y, u,
                prob=np.stack([~bad, bad], axis=1).astype(float))  # fmt: skip
    m, C, V, lags = np.zeros(3), 2.0 * np.eye(3), np.zeros((2, 2)), np.zeros(2)
    for t in range(T):
        C = C + q * np.eye(3)
        z, a, seen = np.r_[lags, u[t]], m[:2], np.isfinite(y[t])
        x, wide, cross = z @ m, z @ C @ z + a @ V @ a, V @ a
        assert run.innovation_std[t] ** 2 == pytest.approx(wide + R * (100.0 if bad[t] else 1.0), rel=1e-9), t
        if seen:
            s = wide + R * (100.0 if bad[t] else 1.0)
            m, C = m + C @ z / s * (y[t] - x), C - np.outer(C @ z, C @ z) / s
        own = bad[t] or not seen
        lags = np.r_[x if own else y[t], lags[0]]
        V = np.array([[wide + R, cross[0]], [cross[0], V[0, 0]]]) if own else np.diag([0.0, V[0, 0]])
        np.testing.assert_allclose(run.theta[t], m, atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*transition:UserWarning")
@pytest.mark.parametrize("seed", [23, 29])
def test_merged_leaves_whose_noise_differs_have_a_variance(seed):
    """Matching moments leaves them fewer than two degrees of freedom, whose expected noise variance is negative."""
    rng = np.random.default_rng(seed)
    u, v, y = rng.normal(size=60), 0.3 * rng.normal(size=60), np.zeros(60)
    for t in range(2, 60):
        y[t] = 1.1 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1] + 0.5 * u[t - 2] + v[t] + 0.7 * v[t - 1]
    run = track(ARX(2, 2), Bank(sensors=[Sensor.nominal(), Sensor.outlier(), Sensor.frozen(prob=0.002)]), y, u)
    assert (run.var[10:] > 0.0).all()
    assert (run.innovation_var[10:] > 0.0).all()

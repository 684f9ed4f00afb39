"""Banks that keep factors of covariances: the results of covariances, and digits and signs where those lose them."""

from dataclasses import replace
from decimal import Decimal, localcontext
from itertools import product

import numpy as np
import pytest
from support import arx_record, damaged, run_lanes, same
from test_bank import N, R, changes, record

from driftfit import ARX, Bank, Kalman, Live, Regression, track
from driftfit.trackers.bank.change import Change
from driftfit.trackers.bank.leaves import leaf_matrix
from driftfit.trackers.bank.leaves.factored import factorise, widened
from driftfit.trackers.bank.leaves.factored import product as multiplied
from driftfit.trackers.bank.leaves.leaf_matrix import FIRST
from driftfit.trackers.bank.machine import start
from driftfit.trackers.bank.reducing import merge
from driftfit.trackers.bank.reduction import GPB, IMM, Beam, Decide, FirstFloor, Hybrid
from driftfit.trackers.bank.sensor import Sensor
from driftfit.trackers.bank.substitute import substituted

T = 90
Y, U = record(T, 5, (30, 60), (40, 75))
Y[50:53], U[56, 1] = np.nan, np.nan
TIME = np.cumsum(np.random.default_rng(1).choice([1.0, 0.5, 1.25, 3.0], T))
P0 = np.array([[2.0, 0.6], [0.6, 1.0]])
A = np.array([[3.0, 1.0], [1.0, 2.0]])
WALKS = [changes()[0], changes()[1], Change(1.5 * A / 3.0, prob=0.012)]
FORGETTING = [
    Change(1e-4), Change(forget=0.8, prob=0.02), Change(forget=0.9, kind="directional", prob=0.02),
    Change(forget=0.9, kind="stabilised", anchor=A, prob=0.01), Change(0.5, which=[1], reset=True, prob=0.01),
    Change(A, reset=True, prob=0.01),
]  # fmt: skip
KNOWN, TWO = [Sensor.nominal(R)], [Sensor.nominal(R), Sensor.outlier(10.0, prob=0.05)]
MARKOV = ([[0.9, 0.05, 0.05], [0.2, 0.7, 0.1], [0.1, 0.1, 0.8]], None)
KINDS = {
    "walks": {"changes": WALKS, "sensors": KNOWN, "p0": P0},
    "two sensors": {"changes": WALKS, "sensors": TWO, "transition": MARKOV, "p0": P0},
    "forgetting": {"changes": FORGETTING, "sensors": KNOWN, "p0": P0, "theta0": [0.1, 0.3]},
    "unknown noise": {"changes": WALKS, "sensors": [Sensor.nominal(guess=0.1)], "p0": 2.0},
    "diffuse": {"changes": WALKS},
}
AUTO = Decide("auto", max_depth=2, wait_cost=0.005)
REDUCTIONS = [Beam(5, window=2), Decide(2), AUTO, GPB(1), GPB(2), IMM(), Hybrid(4, window=2), FirstFloor(2)]
"""Of such sizes that two drivers do for all."""


def both(model, bank, *signals, **more):
    return [track(model, replace(bank, form=form), *signals, **more) for form in ("covariance", "sqrt")]


def assert_close(one, other, rtol=1e-9):
    for name in ("theta", "std", "prediction", "innovation_std"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=rtol, atol=1e-12, err_msg=name)
    for name in ("evidence", "lag_prob", "window", "kept"):
        ours, theirs = (getattr(run.hypotheses, name) for run in (other, one))
        np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=1e-10, err_msg=name)


PAIRS = [
    pytest.param(reduce, kind, id=f"{reduce}-{kind}")
    for reduce in REDUCTIONS
    for kind in KINDS
    if not isinstance(reduce, FirstFloor) or kind not in ("two sensors", "forgetting")  # which it refuses
]


@pytest.mark.parametrize(("reduce", "kind"), PAIRS)
def test_both_forms_say_the_same(reduce, kind):
    one, other = both(Regression(N), Bank(**KINDS[kind], reduce=reduce), Y, U, time=TIME, dt=1.0)
    assert_close(one, other)
    np.testing.assert_allclose(other.cov(-1), one.cov(-1), rtol=1e-9)
    mixed, mixture = (run.hypotheses.mixture() for run in (one, other))
    np.testing.assert_allclose(mixture.covs, mixed.covs, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(mixture.cov, other.cov(-1), rtol=1e-9)


@pytest.mark.parametrize("n", [1, 9])
def test_both_forms_say_the_same_at_other_sizes(n):
    rng = np.random.default_rng(n)
    u = rng.standard_normal((60, n))
    y = u @ rng.standard_normal(n) + 0.3 * rng.standard_normal(60)
    root = rng.standard_normal((n, n))
    walks = [Change(1e-4), Change(root @ root.T, prob=0.05), Change(forget=0.9, prob=0.05)]
    for reduce in (GPB(2), IMM()):
        assert_close(*both(Regression(n), Bank(walks, TWO, reduce=reduce, p0=1.0), y, u))


@pytest.mark.parametrize("reduce", [Beam(7), GPB(2), IMM()], ids=str)
@pytest.mark.parametrize("what", [WALKS, FORGETTING], ids=["walks", "forgetting"])
def test_both_forms_clean_lags(what, reduce):
    y, u = damaged(*arx_record(120, 3, noise=0.3))
    y[[40, 80]] += 8.0
    sensors = [Sensor.nominal(R), Sensor.outlier(10.0, "additive", prob=0.05), Sensor.offset(value=2.0)]
    for lag_variance in (True, False):
        bank = Bank(what, sensors, reduce=reduce, p0=2.0, lag_variance=lag_variance)
        assert_close(*both(ARX(1, 1, nk=0, start="zero"), bank, y, u))


@pytest.mark.parametrize("p0", [2.0, None])
@pytest.mark.parametrize("reduce", [Beam(3), IMM()], ids=str)
def test_one_hypothesis_is_the_square_root_filter(reduce, p0):
    kalman = track(Regression(N), Kalman(q=1e-3, r=R, p0=p0, form="sqrt"), Y, U)
    bank = track(Regression(N), Bank([Change(1e-3)], KNOWN, reduce=reduce, p0=p0, form="sqrt"), Y, U)
    for name in ("theta", "std", "prediction", "innovation_std"):
        np.testing.assert_allclose(getattr(bank, name), getattr(kalman, name), rtol=1e-11, atol=1e-13)


def decimals(x):
    return np.vectorize(Decimal, otypes=[object])(np.asarray(x, float).tolist())


def exact(y, u, Q, p, r, p0):
    """Means of the mixture of GPB(2), or of the one filter of a single change, to fifty digits."""
    n, H = u.shape[1], len(Q)
    Q, p, r = [decimals(q) for q in Q], decimals(p), Decimal(r)
    grown, path = [(Decimal(0), 0, decimals(np.zeros(n)), decimals(p0 * np.eye(n)))], []
    for z, target in zip(decimals(u), decimals(y), strict=True):
        children = []
        for (logw, _, m, C), i in product(grown, range(H)):
            ahead = C + Q[i]
            g = ahead @ z
            s, e = z @ g + r, target - z @ m
            gained = logw + p[i].ln() - (s.ln() + e * e / s) / 2
            children.append((gained, i, m + g * (e / s), ahead - np.outer(g, g) / s))
        top = max(child[0] for child in children)
        total = sum((child[0] - top).exp() for child in children)
        weights = [(child[0] - top).exp() / total for child in children]
        path.append(sum(w * child[2] for w, child in zip(weights, children, strict=True)).astype(float))
        grown = []
        for i in range(H):
            mine = [(w, m, C) for w, (_, event, m, C) in zip(weights, children, strict=True) if event == i]
            mass = sum(w for w, _, _ in mine)
            mean = sum(w * m for w, m, _ in mine) / mass
            spread = sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in mine) / mass
            grown.append((mass.ln(), i, mean, spread))
    return np.array(path)


def collinear(length, seed=1, size=1e-4):
    """Two regressors that differ by a ten thousandth, noise of variance 1e-6, and a jump."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((length, 1)) + size * rng.standard_normal((length, 2))
    theta = np.where(np.arange(length)[:, None] < length // 2, [1.0, 2.0], [1.5, 1.0])
    return (u * theta).sum(axis=1) + 1e-3 * rng.standard_normal(length), u


@pytest.mark.parametrize("jumps", [False, True])
def test_digits_where_regressors_are_nearly_collinear(jumps):
    """P0 = 1e8, r = 1e-6: the covariance form keeps three digits or four, the factors ten."""
    y, u = collinear(80)
    walks = [Change(0.0), Change(1.0, prob=0.01)] if jumps else [Change(0.0)]
    with localcontext() as context:
        context.prec = 50
        path = exact(y, u, [0.0 * np.eye(2), np.eye(2)][: len(walks)], [0.99, 0.01] if jumps else [1.0], 1e-6, 1e8)
    bank = Bank(walks, [Sensor.nominal(1e-6)], reduce=GPB(2), p0=1e8)
    wrong = [np.abs(run.theta - path)[5:].max() / np.abs(path).max() for run in both(Regression(2), bank, y, u)]
    assert wrong[0] > 1e-6
    assert wrong[1] < 5e-9


@pytest.mark.parametrize(
    "settings",
    [
        {"reduce": Beam(5)}, {"reduce": GPB(2)}, {"reduce": IMM(), "transition": [[0.99, 0.01], [0.2, 0.8]]},
        {"reduce": Hybrid(4), "sensors": [Sensor.nominal(1e-6), Sensor.outlier()]},
        {"reduce": Beam(4), "changes": [Change(forget=0.98), Change(forget=0.5, kind="directional", prob=0.01)]},
        {"reduce": GPB(2), "sensors": [Sensor.nominal(guess=1e-6)]},
    ],
    ids=str,
)  # fmt: skip
def test_every_leaf_stays_positive_for_long(settings):
    length = 12_000
    y, u = collinear(length, 2)
    u[3000:3500] = [1.0, 1.0]
    u[5000:5200] = 0.0
    more = {"changes": [Change(1e-12), Change(1.0, prob=0.01)], "sensors": [Sensor.nominal(1e-6)]} | settings
    run = track(Regression(2), Bank(**more, p0=1e8, form="sqrt"), y, u)
    least = 0.0 if "sensors" in settings else 1e-3
    assert (run.innovation_std >= least * (1.0 - 1e-9)).all()
    assert np.isfinite(run.theta).all()
    assert (run.std > 0.0).all()
    live = Live(Regression(2), run.tracker)
    for t in range(length):
        live.update(y[t], u[t])
        if t % 50 == 0 or t < 50:
            D = live.tracker.array(live.model, live.lane(), "leaves")[
                [FIRST + 2, FIRST + 4], : int(run.hypotheses.leaves[t])
            ]
            assert (D > 0.0).all(), t
            assert np.isfinite(D).all(), t


def test_the_covariance_form_does_lose_its_digits():
    """So that the test above can fail."""
    y, u = collinear(12_000, 2)
    bank = Bank([Change(0.0), Change(1.0, prob=0.01)], [Sensor.nominal(1e-10)], reduce=GPB(2), p0=1e8)
    one, other = both(Regression(2), bank, y, u)
    ratio = one.std[1000:] / other.std[1000:]
    assert np.abs(ratio - 1.0).max() > 1e-3
    assert other.written("var").min() > 0.0


def test_a_prior_may_be_certain_of_something():
    """p0 semi-definite: a parameter that is known, or two that move together."""
    for p0 in (np.diag([2.0, 0.0]), np.ones((2, 2)), np.zeros((2, 2))):
        one, other = both(Regression(N), Bank([Change(0.0), *changes()[1:]], KNOWN, p0=p0), Y, U)
        assert_close(one, other)
    still = track(Regression(N), Bank([Change(0.0)], KNOWN, p0=[2.0, 0.0], theta0=[0.0, 0.7], form="sqrt"), Y, U)
    assert (still.theta[:, 1] == 0.7).all()
    assert (still.std[:, 1] == 0.0).all()


def test_stream_record_lane_and_file_agree_bit_for_bit(tmp_path):
    bank = Bank(FORGETTING, TWO, reduce=GPB(2), p0=P0, form="sqrt")
    run = track(Regression(N), bank, Y, U)
    out, _ = run_lanes(Regression(N), [bank], Y[:, None], U[:, :, None], run.known.columns[:, :, None])
    assert same(out["theta"][..., 0], run.theta)
    fleet = track(Regression(N), [replace(bank, form="covariance"), bank], Y, U)
    assert same(fleet[1].theta, run.theta)
    assert not same(fleet[0].theta, run.theta)
    live = Live(Regression(N), bank)
    for t in range(T):
        live.update(Y[t], U[t])
        assert same(live.theta, run.theta[t])
        assert same(live.std, run.std[t])
        if t == 44:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
            assert live.tracker == bank
    assert same(live.hypotheses.mixture().covs, run.hypotheses.mixture().covs)


def test_what_an_operator_says():
    streams = [Live(Regression(N), Bank(WALKS, reduce=GPB(2), form=form)) for form in ("covariance", "sqrt")]
    for t in range(T):
        for live in streams:
            if t == 40:
                live.reset([1], p=3.0)
            live.update(Y[t], U[t])
    np.testing.assert_allclose(streams[1].theta, streams[0].theta, rtol=1e-9)
    np.testing.assert_allclose(streams[1].cov, streams[0].cov, rtol=1e-9)


@pytest.mark.parametrize("rank", [1, 3, 5])
def test_factors_multiply_out(rank):
    rng = np.random.default_rng(rank)
    root = rng.standard_normal((5, rank))
    C = root @ root.T
    column = C[np.tril_indices(5)].copy()
    factorise.py_func(column, 5, 0.0)
    np.testing.assert_allclose(multiplied(column[:, None], 5)[0], C, atol=1e-12)
    assert (column[[0, 2, 5, 9, 14]] >= 0.0).all()
    both = np.stack([column, column], axis=1)
    widened(both, np.array([[0.0, 1.0]] * 4 + [[0.0, 0.0]]))
    np.testing.assert_allclose(multiplied(both, 5)[1], C + np.diag([1.0] * 4 + [0.0]), atol=1e-12)
    np.testing.assert_allclose(multiplied(both, 5)[0], C, atol=1e-12)


def test_a_covariance_that_rounding_made_indefinite_is_not_certain():
    C = np.array([[1.0, 1.0], [1.0, 1.0 - 1e-15]])
    for least, expected in ((0.0, 0.0), (1.0, pytest.approx(1.8e-15, rel=0.1))):
        column = C[np.tril_indices(2)].copy()
        factorise.py_func(column, 2, least)
        assert column[0] == expected


def test_the_form_is_named():
    with pytest.raises(ValueError, match="'covariance', 'sqrt'"):
        Bank(form="square root")
    assert Bank.from_settings(Bank(form="sqrt").settings()) == Bank(form="sqrt")
    before = {name: value for name, value in Bank().settings().items() if name != "form"}
    assert Bank.from_settings(before) == Bank()


def test_parts_that_nothing_calls_are_named():
    with pytest.raises(ValueError, match="nothing calls match"):
        substituted([start.begin], {merge.match: leaf_matrix.spread})


@pytest.mark.parametrize("form", ["covariance", "sqrt"])
def test_the_first_forecast_of_a_bank_is_in_units_of_the_output(form):
    """With unknown noise C is in units of it: 0.36 / 2 with this guess, and of the residuals where there is none."""
    bank = Bank([Change(0.0)], [Sensor.nominal(guess=0.09, nu=4.0)], p0=2.0, form=form)
    run = track(Regression(N), bank, Y[:1], U[:1])
    unit = 0.36 / 2.0
    assert run.innovation_std[0] ** 2 == pytest.approx(unit * (2.0 / 0.09 * U[0] @ U[0] + 1.0), rel=1e-12)
    small, large = (track(Regression(N), Bank(form=form), scale * Y, U) for scale in (1.0, 1e-3))
    np.testing.assert_allclose(1e3 * large.std[N + 1 :], small.std[N + 1 :], rtol=1e-9)
    np.testing.assert_allclose(1e3 * large.innovation_std[N + 1 :], small.innovation_std[N + 1 :], rtol=1e-9)


def test_covariances_of_changes_may_be_semi_definite():
    q = np.ones((2, 2))
    one, other = both(Regression(N), Bank([Change(1e-4), Change(q, prob=0.05)], KNOWN, p0=2.0), Y, U)
    assert_close(one, other)

"""Banks where a covariance of theta would lose digits: collinear regressors, a wide prior, little noise."""

from decimal import Decimal, localcontext
from itertools import product

import numpy as np
import pytest
from support import same
from test_bank import N, R, record

from driftfit import Bank, Kalman, Live, Regression, track
from driftfit.bank.change import Change
from driftfit.bank.leaves.leaf_matrix import FIRST
from driftfit.bank.reduction import GPB, IMM, Beam, Hybrid
from driftfit.bank.sensor import Sensor

T = 90
Y, U = record(T, 5, (30, 60), (40, 75))
Y[50:53], U[56, 1] = np.nan, np.nan
KNOWN = [Sensor.nominal(R)]


@pytest.mark.parametrize("p0", [2.0, None, 1e12])
@pytest.mark.parametrize("reduce", [Beam(3), IMM()], ids=str)
def test_one_hypothesis_is_the_square_root_filter(reduce, p0):
    """From 1e12 the first samples become coordinates."""
    kalman = track(Regression(N), Kalman(q=1e-3, r=R, p0=p0, form="sqrt"), Y, U)
    bank = track(Regression(N), Bank([Change(1e-3)], KNOWN, reduce=reduce, p0=p0), Y, U)
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
    """P0 = 1e8, r = 1e-6, where a covariance of theta keeps three digits. An event at a sample that enters a coordinate
    counts as one at the next, so early jumps have other weights than in the exact mixture.
    """
    y, u = collinear(80)
    walks = [Change(0.0), Change(1.0, prob=0.01)] if jumps else [Change(0.0)]
    with localcontext() as context:
        context.prec = 50
        path = exact(y, u, [0.0 * np.eye(2), np.eye(2)][: len(walks)], [0.99, 0.01] if jumps else [1.0], 1e-6, 1e8)
    run = track(Regression(2), Bank(walks, [Sensor.nominal(1e-6)], reduce=GPB(2), p0=1e8), y, u)
    wrong = np.abs(run.theta - path).max(axis=1) / np.abs(path).max()
    assert wrong[5:].max() < (2e-4 if jumps else 5e-9)
    assert wrong[40:].max() < (2e-7 if jumps else 5e-9)


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
    run = track(Regression(2), Bank(**more, p0=1e8), y, u)
    least = 0.0 if "sensors" in settings else 1e-3
    assert (run.innovation_std >= least * (1.0 - 1e-9)).all()
    assert np.isfinite(run.theta).all()
    assert (run.std > 0.0).all()
    live = Live(Regression(2), run.tracker)
    for t in range(length):
        live.update(y[t], u[t])
        if t % 50 == 0 or t < 50:
            leaves = live.tracker.array(live.model, live.lane(), "leaves")[:, : int(run.hypotheses.leaves[t])]
            variances = leaves[[FIRST + 2, FIRST + 4]]
            assert (variances > 0.0).all(), t
            assert np.isfinite(variances).all(), t


def test_a_prior_may_be_certain_of_something():
    """p0 semi-definite: a parameter that is known."""
    still = track(Regression(N), Bank([Change(0.0)], KNOWN, p0=[2.0, 0.0], theta0=[0.0, 0.7]), Y, U)
    assert (still.theta[:, 1] == 0.7).all()
    assert (still.std[:, 1] == 0.0).all()


@pytest.mark.parametrize("p0", [1e14, None])
def test_stream_record_and_file_agree_bit_for_bit(tmp_path, p0):
    """In coordinates that the first sample after the save and the load may still change."""
    bank = Bank([Change(1e-4), Change(0.5, which=[1], reset=True, prob=0.01)], KNOWN, reduce=GPB(2), p0=p0)
    u = U * (np.arange(T)[:, None] > [0, 44])
    run, live = track(Regression(N), bank, Y, u), Live(Regression(N), bank)
    for t in range(T):
        live.update(Y[t], u[t])
        assert same(live.theta, run.theta[t])
        assert same(live.std, run.std[t])
        if t == 44:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
    assert same(live.hypotheses.mixture().covs, run.hypotheses.mixture().covs)


def test_the_first_forecast_of_a_bank_is_in_units_of_the_output():
    """With unknown noise C is in units of it: 0.36 / 2 with this guess, and of the residuals where there is none."""
    bank = Bank([Change(0.0)], [Sensor.nominal(guess=0.09, nu=4.0)], p0=2.0)
    run = track(Regression(N), bank, Y[:1], U[:1])
    unit = 0.36 / 2.0
    assert run.innovation_std[0] ** 2 == pytest.approx(unit * (2.0 / 0.09 * U[0] @ U[0] + 1.0), rel=1e-12)
    small, large = (track(Regression(N), Bank(), scale * Y, U) for scale in (1.0, 1e-3))
    np.testing.assert_allclose(1e3 * large.std[N + 1 :], small.std[N + 1 :], rtol=1e-9)
    np.testing.assert_allclose(1e3 * large.innovation_std[N + 1 :], small.innovation_std[N + 1 :], rtol=1e-9)

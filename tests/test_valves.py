"""Valves: curves that are level about 0 or saturate, several inputs with a curve each, forecasts without warnings."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support import same

from driftfit import Kalman, Live, track
from driftfit.judge.regressors import regressors
from driftfit.models.hammerstein_wiener.basis import PiecewiseLinear, Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.separation import LeastSquares, split
from driftfit.models.hammerstein_wiener.thresholds import DeadZone, Saturation
from driftfit.systems.arc_furnace import THRESHOLDS, valve
from driftfit.use.blocks import free_run

VALVES = HammersteinWiener(1, [2, 1], nk=[1, 2], input=[PiecewiseLinear((-0.5, 0.5)), Saturation(3.0, start=1.0)])
K = Kalman(q=0.0, r=4e-4, p0=1e2)
R = np.sqrt(0.5)
"""Both bends of the dead band have it, with |c| = 1."""


def record(seed=0, T=800, limits=(-1.0, 1.0)):
    """y, u (T, 2) and v: a valve that is dead between -0.5 and 0.5, so that c_1 = 0, and a heater with limits."""
    rng = np.random.default_rng(seed)
    u = rng.uniform([-2.0, -3.0], [2.0, 3.0], (T, 2))
    v = np.sign(u[:, 0]) * np.maximum(np.abs(u[:, 0]) - 0.5, 0.0), np.clip(u[:, 1], *limits)
    w = np.zeros(T)
    for t in range(2, T):
        w[t] = 0.8 * w[t - 1] + 0.5 * v[0][t - 1] + 0.2 * v[0][t - 2] + 0.4 * v[1][t - 2] + 0.02 * rng.normal()
    return w, u, v


def phi_of(thresholds, y, u, t):
    """The regressors of sample t, written out."""
    f = PiecewiseLinear((-0.5, 0.5)).value(u[:, 0])
    x = u[t - 2, 1]
    heat = Saturation(3.0).split(x, x >= thresholds[0], x <= thresholds[1])
    first, more = (
        [y[t - 1], -f[t - 1, 0], -f[t - 2, 0], -heat[0]],
        [-f[t - 1, 1], -f[t - 2, 1], -f[t - 1, 2], -f[t - 2, 2]],
    )
    return np.r_[first, more, -heat[1:]]


def test_a_dead_band_has_a_gauge_of_unit_norm():
    """c_1 = 0: with c_1 = 1 the other coefficients are hundreds and change sign, with |c| = 1 they stand still."""
    y, u, _ = record()
    run = track(VALVES, K, y, u)
    for method in ("svd-joint", "gls"):
        b, c = run.blocks(method).of_input(0)
        assert_allclose(np.linalg.norm(c, axis=1), 1.0, rtol=1e-12)
        assert_allclose(c[200:], np.broadcast_to([0.0, R, R], (600, 3)), atol=0.05)
        assert_allclose(b[-1], np.array([0.5, 0.2]) / R, atol=0.02)
        steep = run.blocks(method, input="c1").of_input(0)[1][200:, 1]
        assert np.abs(steep).max() > 100.0
    x = np.linspace(-2.0, 2.0, 9)
    found = run.blocks("gls")
    assert_allclose(found.input_curve(x) / R, np.sign(x) * np.maximum(np.abs(x) - 0.5, 0.0), atol=0.03)
    assert_allclose(found.input_curve(x, i=1), np.clip(x, -1.0, 1.0), atol=0.03)


def test_the_sign_is_that_of_a_curve_that_rises():
    model = HammersteinWiener(0, 2, input=PiecewiseLinear((-0.5, 0.5)))
    curves = np.array([[0.0, R, R], [0.3, 0.2, -0.1], [-0.1, 0.0, 1.0], [0.0, -1.0, 1e-3]])
    for c in curves:
        for sign in (-1.0, 1.0):
            theta = np.outer(c, [sign * 0.7, -0.2]).ravel()
            _, b, found, _, _ = split(model, theta[None], "svd")
            assert_allclose(np.outer(found[0], b[0]), np.outer(c, [sign * 0.7, -0.2]), atol=1e-14)
            assert found[0] @ model.rise > 0.0
    low, high = PiecewiseLinear((-0.5, 0.5)).rise_between
    assert (low, high) == (0.0, 1.0)
    even = Polynomial(2)
    assert even.rise @ [0.0, 1.0] > 0.0  # a parabola has a sign, too


def test_standard_deviations_of_unit_norm_are_those_of_draws():
    """Products drawn from their covariance about those of a dead band, c_1 = 0, which c_1 = 1 cannot even express."""
    structure, rng, draws = VALVES.structure, np.random.default_rng(5), 4000
    b, c = [np.array([0.5, 0.2]) / R, np.array([0.4])], [np.array([0.0, R, R]), np.array([0.6, 0.0, -0.8])]
    matrices = [np.outer(ci, bi) for bi, ci in zip(b, c, strict=True)]
    theta = np.r_[-0.8, matrices[0][0], matrices[1][0], matrices[0][1:].ravel(), matrices[1][1:].ravel()]
    root = 0.01 * (np.eye(structure.n) + 0.3 * rng.normal(size=(structure.n, structure.n)))
    drawn = theta + rng.normal(size=(draws, structure.n)) @ root.T
    zeta = np.tile(np.r_[-0.8, *b, *c], (draws, 1))
    truth, P = zeta[0], np.broadcast_to(root @ root.T, (draws, 10, 10))
    zeta, cov, cost = LeastSquares(structure).refine(drawn, P, zeta)
    assert_allclose(np.linalg.norm(zeta[:, 4:7], axis=1), 1.0, rtol=1e-12)
    size = np.mean((zeta - truth) ** 2, axis=0) / np.mean(np.einsum("tii->ti", cov), axis=0)
    assert_allclose(size, 1.0, atol=0.08)  # 3.6 standard deviations of a mean of 4000 chi-squares
    assert cost.mean() == pytest.approx(structure.n - structure.n_x, rel=0.08)


def test_thresholds_are_found_from_a_wrong_start():
    """What was learnt with wrong thresholds must be forgotten, so a little drift is needed."""
    for seed in range(3):
        y, u, _ = record(seed, T=2000, limits=(-0.7, 1.4))
        found = track(VALVES, Kalman(q=1e-8, r=4e-4, p0=1e2), y, u).blocks().of_input(1)[1]
        assert_allclose(found[-1], [1.0, 1.4, -0.7], atol=0.02)


def test_a_valve_ends_where_it_is_fully_open():
    """Equation (61) has limits of the input; a dead zone without them learns wrong thresholds."""
    rng = np.random.default_rng(2)
    u, y = rng.uniform(-15.0, 15.0, 2000), np.zeros(2000)
    v = valve(u)
    assert_allclose([v.max(), v.min()], [9.0, -9.0])
    for t in range(2, 2000):
        y[t] = 0.7 * y[t - 1] + 0.2 * v[t - 1] + 0.1 * v[t - 2] + 0.01 * rng.normal()
    found = {}
    for limit in (10.0, None):
        zone = DeadZone(15.0, limit=limit)
        run = track(HammersteinWiener(1, 2, input=zone), Kalman(q=1e-8, r=1e-4, p0=1e2), y, u)
        found[limit] = run.blocks(input="c1").c[-1, 1:]
        x = np.array([-20.0, -3.0, 0.5, 3.0, 20.0])
        assert_allclose(zone.split(x, x >= 1.0, x <= -1.0) @ [1.0, 1.0, -1.0], valve(x, limit=limit or np.inf))
    assert_allclose(found[10.0], THRESHOLDS, atol=0.01)
    assert np.abs(found[None] - THRESHOLDS).min() > 0.5
    with pytest.raises(ValueError, match="limit"):
        DeadZone(15.0, limit=0.0)


def test_several_inputs_are_the_regression_they_are_written_as():
    y, u, _ = record(T=200)
    run = track(VALVES, K, y, u)
    known = run.blocks().of_input(1)[1]
    phi = phi_of(known[147, 1:], y, u, 150)  # with the thresholds known before u_(t-2) came
    assert run.prediction[150] == pytest.approx(-phi @ run.theta[149], rel=1e-12)
    names = ("A1", "b1[u1]", "b2[u1]", "b1[u2]", "b1[u1]*c2", "b2[u1]*c2", "b1[u1]*c3", "b2[u1]*c3")
    assert run.names == (*names, "b1[u2]*c2", "b1[u2]*c3")
    assert run.blocks().names.c == ("c1[u1]", "c2[u1]", "c3[u1]", "c1[u2]", "c2[u2]", "c3[u2]")
    holes = y.copy(), u.copy()
    holes[0][50], holes[1][80, 1], holes[1][100, 0] = np.nan, np.inf, np.nan
    again = track(VALVES, K, *holes)
    assert list(np.flatnonzero(~again.ok)) == [0, 1, 50, 51, 82, 101, 102]


def test_several_inputs_are_the_same_alive_in_lanes_and_saved():
    y, u, _ = record(T=120)
    model = replace(VALVES, inputs=("valve", "heat"))
    run, live = track(model, K, y, u), Live(model, K)
    for t in range(120):
        live.update(float(y[t]), u[t])
    assert same(live.theta, run.theta[-1])
    assert same(live.blocks().c, run.blocks().c[-1])
    lanes = track(model, K, np.stack([y, y[::-1]]), np.stack([u, u]), by="row")
    assert same(lanes[0].theta, run.theta)
    assert run.names[3] == "b1[heat]"
    assert HammersteinWiener.from_settings(json.loads(json.dumps(model.settings()))) == model
    one = HammersteinWiener(1, [2], input=[PiecewiseLinear((-0.5, 0.5))], inputs=["valve"])
    assert one == HammersteinWiener(1, 2, input=PiecewiseLinear((-0.5, 0.5)), inputs="valve")
    for given in ({"inputs": 2}, {}):  # as many as u has columns, each with its own curve
        shared = HammersteinWiener(1, 1, input=PiecewiseLinear((-0.5, 0.5)), **given).bind(2)
        assert shared.names == HammersteinWiener(1, 1, input=[PiecewiseLinear((-0.5, 0.5))] * 2).names
    assert hash(replace(VALVES, inputs=["valve", "heat"])) == hash(model)  # a list is a tuple, as for other settings
    for wrong in ("valve", ("valve",), ("valve", "heat", "pump")):
        with pytest.raises(ValueError, match="imply different numbers"):
            replace(VALVES, inputs=wrong)


def test_several_inputs_in_use():
    y, u, v = record()
    run = track(VALVES, K, y, u)
    free = free_run(run)
    rest = slice(300, None)
    assert np.std((y - free.y)[rest]) < 2.2 * 0.02 / np.sqrt(1.0 - 0.8**2)
    assert_allclose(free.v[rest], (v[0] * R + v[1])[rest], atol=0.08)
    again = run.model.play(run.theta[-1:], y[None, :5], u[None, :45], np.zeros((1, 40)), (y.min(), y.max()))[0]
    assert_allclose(again[:1], -phi_of(run.blocks().of_input(1)[1][-1, 1:], y, u, 5) @ run.theta[-1], atol=1e-12)
    assert np.std(again - y[5:45]) < 0.1


def test_settings_that_several_inputs_cannot_have_are_refused():
    y, u, _ = record(T=200)
    with pytest.raises(ValueError, match=r"has 2 inputs \(nb=.* but u has 1 columns"):
        track(VALVES, K, y, u[:, :1])
    with pytest.raises(ValueError, match="imply different numbers of inputs"):
        HammersteinWiener(1, [2, 1], input=[None, None, None])
    for nothing in ({"inputs": 0}, {"input": []}):
        with pytest.raises(ValueError, match="inputs must be a whole number of at least 1"):
            HammersteinWiener(1, 1, **nothing)
    with pytest.raises(ValueError, match="nb must be a whole number of at least 1"):
        HammersteinWiener(1, [1, 0])
    for basis in (Saturation(1.0), DeadZone(1.0)):
        with pytest.raises(ValueError, match="can only be an input block"):
            HammersteinWiener(1, 1, output=basis)


@pytest.mark.parametrize("h", [1, 2000])
def test_forecasts_never_warn(h):
    """Also of an estimate that is unstable: its uncertainty is enormous and finite."""
    y, u, _ = record(T=200)
    for output in (y, 1e-3 * 1.2 ** np.arange(60)):
        run = track(VALVES, K, output, u[: len(output)])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            forecast = run.forecast(h, u=np.resize(u, (h, 2)))
            silent = run.forecast(h)
        assert (np.isfinite(forecast.y_std) | np.isnan(forecast.y_hat)).all()
        assert h == 1 or np.isnan(silent.y_hat[-1])
        if output is y:
            assert forecast.y_std[-1] == pytest.approx(0.02 if h == 1 else 0.02 / 0.6, rel=0.05)
        elif h == 2000:
            assert np.nanmax(forecast.y_std) > 1e30  # up to where readings end


def test_thresholds_that_are_learned_on_the_way_are_not_mistaken_for_drift():
    model = replace(VALVES, input=[PiecewiseLinear((-0.5, 0.5)), Saturation(3.0, start=2.5)])
    for seed in (0, 2):
        y, u, _ = record(seed)
        run = track(model, K, y, u)
        assert not run.verdict().drifts
    heat, rows = u[:, 1], regressors(run)
    inside = np.where(np.abs(heat) < 1.0, heat, 0.0)[rows.at - 2]
    assert np.mean(rows.phi[:, model.names.index("b1[u2]")] == -inside) > 0.98  # the first samples too
    y[400:] = record(2, limits=(-1.0, 2.0))[0][400:]
    assert "b1[u2]*c2" in track(model, K, y, u).verdict().moving
    assert len(regressors(track(model, K, np.full(60, np.nan), u[:60])).phi) == 0


@pytest.mark.parametrize(("kind", "true"), [(DeadZone, (0.25, -0.2)), (Saturation, (0.4, -0.35))])
def test_thresholds_of_a_record_do_not_depend_on_those_of_the_stream(kind, true):
    rng = np.random.default_rng(0)
    model, at = HammersteinWiener(0, 1, nk=0, input=kind(1.0)), np.arange(400)
    u = rng.uniform(-1.0, 1.0, (400, 1))

    def rows(high, low):
        return -model.bases[0].split(u[:, 0], u[:, 0] > high, u[:, 0] < low)

    y = 2.0 * rows(*true) @ np.array([1.0, *true]) + 0.001 * rng.normal(size=400)
    expected = model.settled(rows(*true), y, u, at)
    for high, low in ((0.0, 0.0), (0.01, -0.9), (0.97, 0.0)):  # inputs of a saturation are never inside the first
        assert_allclose(model.settled(rows(high, low), y, u, at), expected)

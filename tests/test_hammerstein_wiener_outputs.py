"""Hammerstein-Wiener models with several outputs: each is the model of one output alone, bit for bit."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support import same

from driftfit import ExtendedKalman, HammersteinWiener, Kalman, Live, OutputError, track
from driftfit.models.hammerstein_wiener.curves.basis import Legendre, Polynomial
from driftfit.models.hammerstein_wiener.results.shared_curves import shared_curves
from driftfit.run.outputs import Outputs

TANK = HammersteinWiener(
    1, 2, input=Polynomial(2), output=[Legendre(2, (-1, 1)), Legendre(2, (-1200, 1200))], ny=("flow", "level")
)
K = Kalman(q=1e-7, r=1e-4, p0=1e2, theta0=0.01)
C2 = 0.4


def record(T=300, seed=0, noise=0.0):
    """y (T, 2) and u: one valve, v = u + 0.4 u^2, before two systems with units a thousand apart."""
    rng = np.random.default_rng(seed)
    u, w = rng.uniform(-1.0, 1.0, T), np.zeros((T, 2))
    v = u + C2 * u**2
    for t in range(2, T):
        w[t, 0] = 0.5 * w[t - 1, 0] + 0.5 * v[t - 1] - 0.3 * v[t - 2] + noise * rng.normal()
        w[t, 1] = 0.8 * w[t - 1, 1] + 0.2 * v[t - 1] + 0.1 * v[t - 2] + noise * rng.normal()
    return (np.sqrt(1.0 + 0.4 * w) - 1.0) / 0.2 * [1.0, 1000.0], u


def test_each_output_is_the_model_of_that_output_alone(tmp_path):
    y, u = record()
    y[50, 0], y[[70, 71], 1], u[100] = np.nan, np.inf, np.nan
    run = track(TANK, K, y, u)
    assert run.names[1] == tuple(f"{name}[level]" for name in TANK.names)
    for i, name in enumerate(TANK.outputs):
        alone = track(TANK.alone(name), K, y[:, i], u)
        for what in ("theta", "std", "prediction", "innovation", "innovation_std", "ok"):
            assert same(getattr(run[name], what), getattr(alone, what)), what
        assert run[name].loglik == alone.loglik
        assert same(run[name].blocks().c, alone.blocks().c)
        assert same(run.forecast(3, [0.1, 0.2, 0.3]).y_std[:, i], alone.forecast(3, [0.1, 0.2, 0.3]).y_std)
        assert same(run[name].simulate(u[:20]).y_hat, alone.simulate(u[:20]).y_hat)
    assert np.flatnonzero(~run.ok[2:, 0]).tolist() == [48, 49, 99, 100]
    live = Live(TANK, K)
    for t in range(300):
        if t == 150:
            live.save(tmp_path / "state")
            live = type(live).load(tmp_path / "state")
        live.update(y[t], u[t : t + 1])
    assert same(live.theta, run.theta[-1])
    run.save(tmp_path / "run")
    assert same(Outputs.load(tmp_path / "run")["level"].prediction, run["level"].prediction)
    half = track(TANK, K, y[:150], u[:150])
    assert same(track(TANK, K, y[150:], u[150:], warm_start=half).theta, run.theta[150:])
    assert HammersteinWiener.from_settings(json.loads(json.dumps(TANK.settings()))) == TANK


def test_minimal_parameters_of_several_outputs():
    y, u = record()
    ekf = ExtendedKalman(q=1e-7, r=1e-4, p0=0.1, theta0=0.1)
    run = track(TANK, ekf, y, u)
    assert run.names[0] == ("A1[flow]", "b1[flow]", "b2[flow]", "c2[flow]", "d2[flow]")
    for i, name in enumerate(TANK.outputs):
        assert same(run[name].theta, track(TANK.alone(name), ekf, y[:, i], u).theta)
    with pytest.raises(ValueError, match="one output at a time"):
        track(TANK, OutputError(q=1e-7, r=1e-4), y, u)


def test_a_shared_curve_is_better_than_each_alone():
    """Fifty records: the rms error of c_2 from both outputs together against those of each by itself."""
    errors = []
    for seed in range(50):
        y, u = record(200, seed, noise=0.03)
        run = track(TANK, K, y, u)
        both = shared_curves(run)
        assert same(both["flow"].c, both["level"].c)
        curves = [both["flow"].c[-1], *(run[name].blocks().c[-1] for name in TANK.outputs)]
        errors.append([c[1] / c[0] - C2 for c in curves])
    together, flow, level = np.sqrt(np.mean(np.square(errors), axis=0))
    assert flow < level
    assert together / flow == pytest.approx(0.93, abs=0.01)
    assert together / level == pytest.approx(0.63, abs=0.01)
    scaled = track(
        HammersteinWiener(1, 2, input=Polynomial(2), output=[Legendre(2, (-7, 7)), Legendre(2, (-1.2, 1.2))]),
        K, y * [7.0, 1e-3], u,
    )  # fmt: skip
    again = shared_curves(scaled)["y1"]
    assert_allclose(again.c, both["flow"].c, atol=1e-9)
    assert_allclose(again.b, both["flow"].b, atol=1e-9)


def test_shared_curves_are_the_nearest_of_rank_one():
    """Two inputs with curves of different size, by alternating least squares on the products that the names
    describe."""
    model = HammersteinWiener(1, (2, 1), input=[Polynomial(3), Polynomial(2)], ny=("flow", "level"))
    rng = np.random.default_rng(0)
    u = rng.uniform(-1.0, 1.0, (80, 2))
    y = (0.1 * np.cumsum(rng.standard_normal((80, 2)), axis=0) + u[:, :1]) * [1.0, 1000.0]
    run = track(model, Kalman(q=1e-4, r=1e-2, p0=1e2, theta0=0.01), y, u)
    shared = shared_curves(run)
    for signal, lags, size, at_c, at_b in (
        ("u1", 2, 3, slice(0, 3), slice(0, 2)),
        ("u2", 1, 2, slice(3, 5), slice(2, 3)),
    ):
        rows = []
        for o, output in enumerate(model.outputs):
            theta = dict(zip(run.names[o], run.theta[-1, o], strict=True))
            weight = 1.0 / run.innovation_std[-1, o]
            for j in range(1, lags + 1):
                more = [theta[f"b{j}[{signal}]*c{k}[{output}]"] for k in range(2, size + 1)]
                rows.append(weight * np.array([theta[f"b{j}[{signal}][{output}]"], *more]))
        M = np.array(rows)
        c = M[0]
        for _ in range(3000):
            b = M @ c / (c @ c)
            c = M.T @ b / (b @ b)
        nearest = np.outer(b, c)
        for o, output in enumerate(model.outputs):
            found = np.outer(shared[output].b[-1, at_b], shared[output].c[-1, at_c]) / run.innovation_std[-1, o]
            assert_allclose(found, nearest[o * lags : (o + 1) * lags], rtol=1e-8)


def test_settings_that_several_outputs_cannot_have_are_refused():
    y, u = record(60)
    for wrong, message in (
        (lambda: HammersteinWiener(1, 1, output=[None, Polynomial(2)]), "bases of one kind and size"),
        (lambda: HammersteinWiener(1, 1, output=[None, None], ny=3), "3 outputs, but one entry for each"),
        (lambda: HammersteinWiener(1, 1, output_noise=[0.1, 0.0], ny=2), "output_noise"),
        (lambda: shared_curves(track(TANK.alone("flow"), K, y[:, 0], u)), "several outputs"),
        (lambda: shared_curves(track(TANK, ExtendedKalman(q=0.0, r=1.0), y, u)), "products"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()

"""Hammerstein-Wiener models with several outputs: each is the model of one output alone, bit for bit."""

import json

import numpy as np
import pytest
from support import same

from driftfit import ExtendedKalman, HammersteinWiener, Kalman, Live, OutputError, track
from driftfit.models.hammerstein_wiener.basis import Legendre, Polynomial
from driftfit.run.fleet import Outputs

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


def test_settings_that_several_outputs_cannot_have_are_refused():
    for wrong, message in (
        (lambda: HammersteinWiener(1, 1, output=[None, Polynomial(2)]), "bases of one kind and size"),
        (lambda: HammersteinWiener(1, 1, output=[None, None], ny=3), "3 outputs, but one entry for each"),
        (lambda: HammersteinWiener(1, 1, output_noise=[0.1, 0.0], ny=2), "output_noise"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()

"""A drift of its own for every parameter and step: flexible least squares with mu (L - 1, n), and Kalman filters."""

import naive_smoother as naive
import numpy as np
import polars as pl
import pytest
from contract_table import model_of, ready
from support import arx_record

from driftfit import ARX, FLS, RLS, Kalman, Live, Regression, Track, frontier, track, tune
from driftfit.smooth.huber import huber
from driftfit.trackers import found

TWO = Regression(2)


def record(L=40, seed=0):
    rng = np.random.default_rng([seed, L])
    return rng.standard_normal((L, 2)), rng.standard_normal(L), rng.uniform(0.1, 10.0, (L - 1, 2))


def of(mu):
    """drift= for FLS(1.0)."""
    return np.vstack([np.ones(mu.shape[1]), 1.0 / mu])


def test_path_covariances_and_cost_are_those_of_the_dense_problem():
    """mu for every step and parameter, filter and smoother, both paths; also with weights and a price of infinity."""
    phi, y, mu = record()
    w = np.random.default_rng(1).uniform(0.2, 2.0, 40)
    theta, C, J = naive.dense(phi, y, [np.diag(m) for m in mu], w)
    run = track(TWO, FLS(1.0), y, phi, drift=of(mu), weights=w)
    quick, safe = run.smooth(), run.smooth("cov")
    assert (quick.method, safe.method) == ("fast", "safe")
    for path in (quick, safe):
        np.testing.assert_allclose(path.theta, theta, atol=1e-12)
        np.testing.assert_allclose(path.std**2 / path.r, np.diag(C).reshape(40, 2), rtol=1e-11)
        assert path.cost == pytest.approx(J, rel=1e-12)
    np.testing.assert_allclose(safe.cov(7) / safe.r, C[14:16, 14:16], atol=1e-13)
    np.testing.assert_allclose(safe.lag_cov(7) / safe.r, C[14:16, 16:18], atol=1e-13)
    np.testing.assert_allclose(run.theta[-1], theta[-1], atol=1e-12)
    moves = safe.walk.moves(safe.walk.pull(safe.walk.residual(safe.theta)))
    np.testing.assert_allclose(np.diff(safe.theta, axis=0), moves, atol=1e-12)
    still = of(mu)
    still[10:20, 1] = 0.0
    fixed = track(TWO, FLS(1.0), y, phi, drift=still).smooth().theta
    assert np.ptp(fixed[9:20, 1]) < 1e-13
    assert np.ptp(fixed[9:20, 0]) > 1e-3


def test_every_prefix_of_the_filter_and_every_window_is_the_smoother():
    phi, y, mu = record(24)
    phi[:3], drift = phi[0], of(mu)
    run, live = track(TWO, FLS(1.0), y, phi, drift=drift), Live(TWO, FLS(1.0), lag=4)
    for t in range(24):
        live.update(y[t], phi[t], drift=drift[t])
        np.testing.assert_array_equal(live.theta, run.theta[t])
        np.testing.assert_array_equal(live.std, run.std[t])
        if t > 3:
            part = track(TWO, FLS(1.0), y[: t + 1], phi[: t + 1], drift=drift[: t + 1]).smooth()
            np.testing.assert_allclose(run.theta[t], part.theta[-1], atol=1e-11)
            window = live.smooth()
            np.testing.assert_allclose(window.theta, part.theta[-5:], atol=1e-10)
            np.testing.assert_allclose(window.std, part.std[-5:], rtol=1e-9)
    live.update(1.0, [1.0, 0.0])  # a sample without a factor drifts as the settings state
    usual = track(TWO, FLS(1.0), np.append(y, 1.0), np.vstack([phi, [1.0, 0.0]]), drift=np.vstack([drift, [1.0, 1.0]]))
    np.testing.assert_array_equal(live.theta, usual.theta[-1])


@pytest.mark.parametrize("tracker", [ready(kind) for kind in found().values() if kind.drift_per_parameter], ids=repr)
def test_every_tracker_that_takes_columns_knows_one_column_for_all(tracker):
    y, u = arx_record(120, 3)
    model, d = model_of(tracker, ARX(2, 2)), np.random.default_rng(3).uniform(0.0, 9.0, 120)
    names = tracker.names_for(model)
    plain, ones = track(model, tracker, y, u), track(model, tracker, y, u, drift=np.ones((120, len(names))))
    np.testing.assert_array_equal(ones.theta, plain.theta)
    a, b = (track(model, tracker, y, u, drift=given) for given in (d, np.repeat(d[:, None], len(names), axis=1)))
    np.testing.assert_allclose(a.theta, b.theta, rtol=1e-7, atol=1e-9)
    assert np.abs(a.theta - plain.theta).max() > 1e-6


def test_tables_rows_grids_files_and_tuning_carry_it(tmp_path):
    phi, y, mu = record()
    drift = of(mu)
    alone = track(TWO, FLS(1.0), y, phi, drift=drift)
    data = pl.DataFrame({"y": y, "a": phi[:, 0], "b": phi[:, 1], "da": drift[:, 0], "db": drift[:, 1]})
    data = pl.concat([data.with_columns(unit=pl.lit(k)) for k in range(12)])
    fleet = track(TWO, FLS(1.0), "y", ["a", "b"], data=data, by="unit", drift=["da", "db"])
    rows = track(
        TWO, FLS(1.0), np.tile(y, (12, 1)), np.tile(phi, (12, 1, 1)), by="row", drift=np.tile(drift, (12, 1, 1))
    )
    grid = track(TWO, [FLS(1.0), FLS(5.0)], y, phi, drift=drift)
    for run in (fleet[3], rows[11], grid[0]):
        np.testing.assert_array_equal(run.theta, alone.theta)
        np.testing.assert_array_equal(run.smooth().theta, alone.smooth().theta)
    alone.save(tmp_path / "run")
    np.testing.assert_array_equal(Track.load(tmp_path / "run").smooth().theta, alone.smooth().theta)
    tuned = tune(TWO, Kalman(q=0.1), y, phi, drift=drift)
    logliks = [track(TWO, Kalman(0.1, f * tuned.tracker.r), y, phi, drift=drift).loglik for f in (0.8, 1.0, 1.2)]
    assert logliks[1] == max(logliks) == pytest.approx(tuned.loglik, abs=1e-9)
    pair = frontier(TWO, y, phi, drift=drift, mu=[1.0005, 0.9995])
    assert np.diff(pair.measurement) / np.diff(pair.dynamic) == pytest.approx(-1.0, rel=1e-3)
    assert huber(alone, 0.8, tol=0.0).certificate < 1e-6


def test_who_forecasts_and_who_starts_warm_is_not_left_with_the_last_factor():
    phi, y, mu = record()
    drift, weights = of(mu), np.full(40, 0.5)
    run = track(TWO, Kalman(0.1, 0.5), y, phi, drift=drift, weights=weights)
    found = run.forecast(2, phi[:2])
    P = run.cov(-1) + 0.1 * np.eye(2)
    np.testing.assert_allclose(found.std[0] ** 2, np.diag(P), rtol=1e-12)
    assert found.y_std[0] ** 2 == pytest.approx(phi[0] @ P @ phi[0] + 0.5, rel=1e-12)
    half = track(TWO, FLS(1.0), y[:20], phi[:20], drift=drift[:20])
    rest = track(TWO, FLS(1.0), y[20:], phi[20:], warm_start=half)
    whole = track(TWO, FLS(1.0), y, phi, drift=np.vstack([drift[:20], np.ones((20, 2))]))
    np.testing.assert_array_equal(rest.theta, whole.theta[20:])


def test_what_does_not_fit_is_named():
    phi, y, mu = record()
    with pytest.raises(ValueError, match=r"FLS: drift .* must be \(40, 2\), for theta1, theta2; got shape \(40, 3\)"):
        track(TWO, FLS(1.0), y, phi, drift=np.ones((40, 3)))
    with pytest.raises(ValueError, match="drift must be finite and not negative"):
        track(TWO, FLS(1.0), y, phi, drift=-of(mu))
    with pytest.raises(ValueError, match="a drift for each parameter is for FLS and Kalman"):
        track(TWO, RLS(0.9), y, phi, drift=of(mu))
    with pytest.raises(ValueError, match="Pass a mu for every step with the record"):
        FLS(mu)
    live = Live(ARX(1, 1), FLS(1.0))
    with pytest.raises(ValueError, match=r"must be \(1, 2\)"):
        live.update(1.0, 1.0, drift=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="u has shape"):
        live.update(1.0, [1.0, 2.0], drift=[9.0, 9.0])
    assert (live.lane()["drift_root"] == 1.0).all()
    with pytest.raises(ValueError, match=r'by="row": drift .* must be \(2, 3, n\)'):
        track(Regression(1), FLS(1.0), np.ones((2, 3)), np.ones((2, 3)), by="row", drift=np.ones((3, 3, 1)))

"""Forecasts beyond the end of a record, against Monte Carlo of the model."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from driftfit import ARX, RLS, AdaptiveKalman, Kalman, Live, Regression, track

H = 15


def record(T: int, seed: int, noise: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(2, T):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1] + noise * rng.normal()
    return y, u


def drawn(run, u: np.ndarray, q: float, r: float, D: int = 20000) -> np.ndarray:
    """Outputs (D, h) of systems from the posterior, walking and with noise, each fed back among its lags."""
    rng = np.random.default_rng(5)
    theta = rng.multivariate_normal(run.theta[-1], run.cov(-1), D)
    lags, inputs = np.tile(run.y[-2:][::-1], (D, 1)), np.concatenate([run.u[-1:, 0], u])
    out = np.empty((D, len(u)))
    for k in range(len(u)):
        theta = theta + np.sqrt(q) * rng.normal(size=theta.shape)
        out[:, k] = lags[:, 0] * theta[:, 0] + lags[:, 1] * theta[:, 1] + inputs[k] * theta[:, 2]
        out[:, k] += np.sqrt(r) * rng.normal(size=D)
        lags = np.column_stack([out[:, k], lags[:, 0]])
    return out


@pytest.mark.parametrize(("T", "width", "cover"), [(15, 0.14, 0.86), (30, 0.1, 0.91), (100, 0.06, 0.91)])
@pytest.mark.parametrize("q", [0.0, 1e-4])
def test_bands_of_arx_are_those_of_a_monte_carlo(T, width, cover, q):
    """Before, what the parameters' errors do through the lags was left out: at T = 15 bands were 0.6 of these."""
    covered = []
    for seed in range(6):
        y, u = record(T + H, seed)
        run = track(ARX(2, 1), Kalman(q=q, r=0.09), y[:T], u[:T])
        found = run.forecast(H, u[T : T + H])
        outputs = drawn(run, u[T : T + H], q, 0.09)
        low, high = np.quantile(outputs, [0.16, 0.84], axis=0)
        assert np.all(np.abs(2.0 * found.y_std / (high - low) / 0.9945 - 1.0) < width), seed
        covered.append((np.abs(outputs - found.y_hat) < 1.96 * found.y_std).mean(axis=0))
    assert np.min(covered) > cover
    assert 0.935 < np.mean(covered) < 0.96


def test_a_known_system_has_the_bands_of_its_noise():
    y, u = record(40, 0)
    theta0 = [1.2, -0.5, 1.0]
    run = track(ARX(2, 1), Kalman(q=0.0, r=0.09, theta0=theta0, p0=0.0), y, u)
    psi = run.model.noise_response(np.array(theta0), H)
    assert np.allclose(run.forecast(H, np.zeros(H)).y_std ** 2, 0.09 * np.cumsum(psi**2), rtol=1e-12)


def test_bands_of_a_tracker_without_a_noise_variance_grow_from_its_own():
    y, u = record(60, 1)
    run = track(ARX(2, 1), RLS(0.98), y, u)
    found = run.forecast(H, np.zeros(H))
    simple = np.sqrt(found.y_std[0] ** 2 * np.cumsum(run.model.noise_response(run.theta[-1], H) ** 2))
    assert np.all(np.isfinite(found.y_std))
    assert np.all(found.y_std > 0.9 * simple)


def test_what_is_not_known_is_not_forecast():
    y, u = record(40, 0)
    run = track(ARX(2, 1), Kalman(q=0.0, r=0.09), y[:4], u[:4])  # two samples for three parameters
    found = run.forecast(3, np.zeros(3))
    assert np.all(np.isinf(found.y_std[1:]))
    later = np.zeros(5)
    later[2] = np.nan
    found = track(ARX(2, 1), Kalman(q=0.0, r=0.09), y, u).forecast(5, later)
    assert np.isfinite(found.y_std[:3]).all()
    assert np.isnan(found.y_std[3:]).all()
    for h, inputs, message in ((0, None, "h must be a whole number"), (2, np.ones((2, 2)), "the model has 1 inputs")):
        with pytest.raises(ValueError, match=message):
            run.forecast(h, inputs)


def test_outputs_that_are_lags_of_each_other():
    """Two outputs without a coupling, in one run, have the bands of a Monte Carlo; coupled ones too."""
    rng = np.random.default_rng(2)
    T, D = 60, 20000
    A = np.array([[0.7, 0.2], [-0.1, 0.6]])
    y = np.zeros((T, 2))
    for t in range(1, T):
        y[t] = A @ y[t - 1] + 0.3 * rng.normal(size=2)
    run = track(ARX(1, 0, ny=2), Kalman(q=1e-4, r=0.09), y)
    found = run.forecast(H)
    theta = np.stack([rng.multivariate_normal(run.theta[-1, o], run.cov(-1)[o], D) for o in range(2)], axis=1)
    now = np.tile(y[-1], (D, 1))
    for k in range(H):
        theta = theta + 1e-2 * rng.normal(size=theta.shape)
        now = np.einsum("doi,di->do", theta, now) + 0.3 * rng.normal(size=(D, 2))
        low, high = np.quantile(now, [0.16, 0.84], axis=0)
        assert np.all(np.abs(2.0 * found.y_std[k] / (high - low) / 0.9945 - 1.0) < 0.06)


def test_variances_are_positive_where_theta_is_less_certain_than_the_one_step_band():
    """One step of the default tracker has not the variance of its covariance: y_std was NaN where lags outweigh it."""
    rng = np.random.default_rng(132)
    (u, e), y = rng.normal(size=(2, 120)), np.zeros(120)
    for t in range(2, 120):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + (1.0 + 0.5 * (t > 50)) * u[t - 1] + 0.4 * u[t - 2] + 0.3 * e[t]
    run = track(ARX(2, 2), AdaptiveKalman(), y[:100], u[:100])
    found = run.forecast(20, u[100:])
    assert found.y_std.min() > 0.2
    assert (found.std[0] < 1.5 * run.std[-1]).all()  # it has no jumps that no sample has shown: their variance is large


def test_forecasts_are_printed_as_tables_and_parameters_of_one_name_apart():
    rng = np.random.default_rng(0)
    u = rng.normal(size=80)
    run = track(Regression(("intercept",), intercept=True), Kalman(q=1e-3, r=0.01), 1e6 + 2.0 * u, u)
    assert run.names == ("intercept", "intercept (2)")
    with pytest.raises(ValueError, match=r"u has shape \(3,\), but 12 samples are asked for"):
        run.forecast(12, np.ones(3))
    text = repr(run.forecast(12, np.ones((12, 1))))
    assert "Forecast of 12 samples" in text
    assert "the first 10 of 12" in text
    assert "10000" in text
    assert "array" not in text


def test_a_forecast_without_inputs_says_what_it_needs():
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(2, 80))
    run = track(Regression(1), Kalman(q=1e-3, r=0.01), 2.0 * u + 0.1 * e, u)
    said = "future inputs are needed to forecast outputs: forecast(5, u)"
    assert said in repr(run.forecast(5))
    assert said not in repr(run.forecast(5, np.ones(5)))


@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
@pytest.mark.parametrize("way", ["record", "stream", "outputs", "fleet"])
def test_forecasts_have_dates_bands_and_names(zone, way):
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(2, 80))
    days = pl.Series(np.datetime64("2024-10-01") + np.arange(80)).cast(pl.Datetime("us")).dt.replace_time_zone(zone)
    table = pl.DataFrame({"day": days, "price": 2.0 * u + 0.1 * e, "load": u, "two": u, "unit": 1})
    model, K = Regression(["load"]), Kalman(q=1e-3, r=0.01)
    options = {"data": table, "time": "day", "dt": "1d"}
    if way == "outputs":
        found = track(ARX(1, 1), K, ["price", "two"], "load", **options).forecast(3, np.ones(3))
    else:
        run = track(model, K, "price", "load", **options)
        found = (Live(model, K, dt="1d", warm_start=run) if way == "stream" else run).forecast(3, np.ones(3))
    rows = found.table.filter(pl.col("output") == "price") if way == "outputs" else found.table
    if way == "fleet":
        rows = track(model, K, "price", "load", **options, by="unit").forecast(3, np.ones(3))
    day = next(name for name in rows.columns if rows[name].dtype.is_temporal())
    assert day == ("time" if way == "stream" else "day")
    ahead = pl.Series(np.datetime64("2024-12-20") + np.arange(3)).cast(pl.Datetime("us")).dt.replace_time_zone(zone)
    if way == "stream" and zone is not None:  # a stream of durations has no zone
        ahead = ahead.dt.convert_time_zone("UTC").dt.replace_time_zone(None)
    assert rows[day].to_list() == ahead.to_list()
    assert rows[day].dtype.time_zone == ahead.dtype.time_zone
    band = [end[:, 0] if way == "outputs" else end for end in found.band(0.95)]
    assert np.array_equal(rows.select("low", "high").to_numpy().T, band)
    assert np.allclose(rows["high"] - rows["y_hat"], 1.959964 * rows["y_std"])
    name = "b1[price<-load]" if way == "outputs" else "load"
    assert {"step", "y_hat", "y_std", f"theta_{name}", f"std_{name}"} <= set(rows.columns)
    assert f"{ahead[1]:%Y-%m-%d}" in repr(found)
    assert "price" in repr(found) or way == "stream"


def test_a_record_whose_dates_are_labels_has_steps_ahead():
    u = np.random.default_rng(0).normal(size=80)
    table = pl.DataFrame({"day": np.datetime64("2024-10-01") + np.arange(80), "y": 2.0 * u, "u": u})
    found = track(Regression(1), Kalman(q=1e-3, r=0.01), "y", "u", data=table, time="day", dt="label").forecast(
        2, u[:2]
    )
    assert found.time is None
    assert found.table.columns[:5] == ["step", "y_hat", "y_std", "low", "high"]
    assert not hasattr(found, "index")

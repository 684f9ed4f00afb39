"""Several outputs wherever a single one goes: tables, fleets, files, warm starts, forecasts, tuning, windows."""

from dataclasses import replace

import naive_smoother as naive
import numpy as np
import polars as pl
import pytest
from test_outputs import NAMES, coupled, measured

from driftfit import (
    ARX,
    FLS,
    RLS,
    Kalman,
    Live,
    Regression,
    Track,
    frontier,
    grid,
    select,
    track,
    tune,
)
from driftfit.fleets import Outputs
from driftfit.judge.compare import persistence
from driftfit.judge.structures.candidates import price, unscored
from driftfit.tune.frontier import Frontier

JOINT = ARX(1, 1, ny=NAMES)
SHARED = Regression(2, ny=2, shared=True)
TRACKER = FLS(1e3)


def records():
    """(model, y, u, class of the result) of both kinds, with holes."""
    y, u = coupled(80)
    z, phi = measured(80)
    y[[10, 30], [0, 1]] = np.nan
    z[10, 1] = np.nan
    return [(JOINT, y, u, Outputs), (SHARED, z, phi, Track)]


def same(a, b, part=slice(None)):
    for name in ("theta", "std", "prediction", "innovation", "innovation_std", "ok"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name)[part])


@pytest.mark.parametrize("case", records(), ids=["joint", "shared"])
def test_files_and_warm_starts_of_records_and_streams(case, tmp_path):
    model, y, u, kind = case
    time = np.cumsum(np.random.default_rng(0).uniform(0.6, 1.4, 80))
    whole = track(model, TRACKER, y, u, time=time)
    half = track(model, TRACKER, y[:40], u[:40], time=time[:40])
    half.save(tmp_path / "run")
    again = kind.load(tmp_path / "run")
    same(again, half)
    np.testing.assert_array_equal(again.time, half.time)
    rest = track(model, TRACKER, y[40:], u[40:], time=time[40:], warm_start=again)
    same(rest, whole, slice(40, None))
    rest.save(tmp_path / "rest")
    same(kind.load(tmp_path / "rest"), rest)
    live = Live(model if kind is Track else ARX(1, 1, inputs=1, ny=NAMES), TRACKER, warm_start=half)
    for t in range(40, 60):
        live.update(y[t], u[t], time=time[t])
        np.testing.assert_array_equal(live.theta, whole.theta[t])
    same(track(model, TRACKER, y[60:], u[60:], time=time[60:], warm_start=live), whole, slice(60, None))
    with pytest.raises(ValueError, match=r"is not a run of these outputs|the earlier run followed"):
        track(model, TRACKER, y, u, warm_start=track(Regression(1), TRACKER, y[:, 0], y[:, 1]))
    if kind is Outputs:
        one = whole["flow"]
        one.save(tmp_path / "one")
        np.testing.assert_array_equal(Track.load(tmp_path / "one").smooth().theta, one.smooth().theta)
        np.testing.assert_allclose(rest["flow"].cov(5), whole["flow"].cov(45), rtol=1e-12)
        with pytest.raises(ValueError, match="a run with a warm start"):
            rest.smooth()


def test_tables_units_rows_and_grids():
    (joint, y, u, _), (shared, z, phi, _) = records()
    columns = {"t": np.arange(80.0), "level": y[:, 0], "flow": y[:, 1], "u": u, "w": np.linspace(0.5, 2.0, 80)}
    columns |= {f"{name}{j}": phi[:, j, i] for j in (0, 1) for i, name in enumerate("ab")}
    columns |= {"z0": z[:, 0], "z1": z[:, 1]}
    data = pl.concat([pl.DataFrame(columns).with_columns(unit=pl.lit(k)) for k in "pq"])
    alone = track(joint, TRACKER, y, u, time=np.arange(80.0), weights=columns["w"])
    fleet = track(joint, TRACKER, ["level", "flow"], "u", data=data.reverse(), time="t", by="unit", weights="w")
    assert list(fleet) == [(unit, name) for unit in "qp" for name in NAMES]
    assert list(fleet.series()) == ["q", "p"]
    assert fleet.failed == {}
    same(fleet["p"], alone)
    assert fleet["p"].names[0] == ("a1[level<-level]", "a1[level<-flow]", "b1[level<-u]")
    one = track(ARX(1, 1, ny=2), TRACKER, ["level", "flow"], "u", data=data[:80], weights=["w", "w"], time="t")
    same(one, alone)
    assert one.outputs == ("level", "flow")  # named by their columns
    rows = track(shared, TRACKER, ["z0", "z1"], [["a0", "b0"], ["a1", "b1"]], data=data, by="unit", time="t")
    same(rows["q"], track(shared, TRACKER, z, phi, time=np.arange(80.0)))
    stacked = track(joint, TRACKER, np.stack([y, 2 * y]), np.stack([u, 2 * u]), by="row")
    same(stacked[1], track(joint, TRACKER, 2 * y, 2 * u))
    grid = track(joint, [TRACKER, FLS(5.0)], y, u)
    same(grid[1], track(joint, FLS(5.0), y, u))
    both = {"y": ["level", "flow"], "u": "u", "by": "unit", "time": "t", "weights": "w"}
    first, second = data.filter(pl.col("t") < 50), data.filter(pl.col("t") >= 50)
    warm = track(joint, TRACKER, data=second, **both, warm_start=track(joint, TRACKER, data=first, **both))
    same(warm["q"], alone, slice(50, None))
    rest = warm.to_table()
    assert rest["unit"].to_list() == ["p"] * 30 + ["q"] * 30
    assert rest["theta_b1[flow<-u]"].to_numpy()[-1] == alone.theta[-1, 1, 2]
    with pytest.raises(ValueError, match="the result of such a run"):
        track(joint, TRACKER, data=second, **both, warm_start=alone)
    table = alone.to_table()
    assert table["prediction[flow]"].to_numpy()[50] == alone.prediction[50, 1]
    assert table["theta_a1[flow<-level]"].to_numpy()[-1] == alone.theta[-1, 1, 0]
    assert len(rows["q"].to_table("pandas")) == 80
    with pytest.raises(ValueError, match="y must name 2 columns"):
        track(joint, TRACKER, "level", "u", data=data)
    given = {"level": "m", "u": "V"}
    measured_in = track(joint, TRACKER, ["level", "flow"], "u", data=data[:80], time="t", units=given)
    assert measured_in["level"].units == ("", "", "m/V")
    assert measured_in.to_table("pandas").attrs["units"]["prediction[level]"] == "m"
    assert measured_in.summary()["level"].rows[2].unit == "m/V"
    with pytest.raises(ValueError, match="so data= is needed"):
        track(joint, TRACKER, y, u, units={"u": "m"})
    with pytest.raises(ValueError, match=r"y must be \(units, T, 2\)"):
        track(joint, TRACKER, y, u, by="row")


def test_trackers_weights_and_drifts_of_their_own():
    (joint, y, u, _), _ = records()
    w = np.random.default_rng(0).uniform(0.3, 3.0, (80, 2))
    drift = np.random.default_rng(1).uniform(0.0, 2.0, (80, 3))
    each = {"level": Kalman(q=1e-4, r=0.01), "flow": Kalman(q=[0.0, 1e-3, 1e-2], r=0.04)}
    run = track(joint, each, y, u, weights=w, drift=drift)
    for lane, name in enumerate(NAMES):
        alone = track(Regression(3), each[name], y[1:, lane], run[name].u[1:], weights=w[1:, lane], drift=drift[1:])
        np.testing.assert_array_equal(run.theta[1:, lane], alone.theta)
        np.testing.assert_allclose(run[name].smooth().theta[1:], alone.smooth().theta, rtol=1e-10, atol=1e-12)
    _, high = run.band(0.9)
    np.testing.assert_array_equal(high[:, 1], run["flow"].band(0.9)[1])
    np.testing.assert_array_equal(run.cov(-1)[0], run["level"].cov(-1))
    with pytest.raises(ValueError, match=r"weights must be one number, \(80,\) or \(80, 2\)"):
        track(joint, TRACKER, y, u, weights=w[:, :1])


def test_path_of_shared_rows_is_the_dense_one_of_vector_measurements():
    z, phi = measured(20)
    path = track(SHARED, FLS(2.0), z, phi).smooth()
    A, b = naive.stacked(phi[:, 0], z[:, 0], [2.0 * np.eye(2)] * 19)
    second = np.zeros((20, 40))
    for k in range(20):
        second[k, 2 * k : 2 * k + 2] = phi[k, 1]
    A, b = np.vstack([A, second]), np.append(b, z[:, 1])
    theta = np.linalg.lstsq(A, b, rcond=None)[0].reshape(20, 2)
    np.testing.assert_allclose(path.theta, theta, atol=1e-12)
    C = np.linalg.inv(A.T @ A)
    for t in (0, 7, 18):
        np.testing.assert_allclose(path.cov(t) / path.r, C[2 * t : 2 * t + 2, 2 * t : 2 * t + 2], rtol=1e-9)
        np.testing.assert_allclose(path.lag_cov(t) / path.r, C[2 * t : 2 * t + 2, 2 * t + 2 : 2 * t + 4], rtol=1e-9)
    assert path.cost == pytest.approx(np.sum((A @ theta.ravel() - b) ** 2), rel=1e-11)
    with pytest.raises(ValueError, match="separate the rows of an instant"):
        track(SHARED, FLS(2.0), z, phi).smooth(order_by=np.arange(40))


@pytest.mark.parametrize("case", records(), ids=["joint", "shared"])
def test_windows_of_a_stream_are_the_smoother_of_the_record_so_far(case, tmp_path):
    model, y, u, kind = case
    drift = np.random.default_rng(1).uniform(0.2, 2.0, (80, 3 if kind is Outputs else 2))
    w = np.random.default_rng(2).uniform(0.2, 2.0, (80, 2))
    live = Live(model if kind is Track else ARX(1, 1, inputs=1, ny=NAMES), TRACKER, lag=4)
    for t in range(40):
        live.update(y[t], u[t], weight=w[t], drift=drift[t])
        if t == 20:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
        if t in (15, 19, 21, 39):
            run = track(model, TRACKER, y[: t + 1], u[: t + 1], weights=w[: t + 1], drift=drift[: t + 1])
            window = live.smooth()
            np.testing.assert_array_equal(live.theta, run.theta[-1])
            if kind is Track:
                np.testing.assert_allclose(window.theta, run.smooth().theta[-5:], rtol=1e-8)
                np.testing.assert_allclose(window.std, run.smooth().std[-5:], rtol=1e-8)
            else:
                for lane, path in enumerate(run.smooth().values()):
                    np.testing.assert_allclose(window.theta[:, lane], path.theta[-5:], rtol=1e-7, atol=1e-9)
                    np.testing.assert_allclose(window.std[:, lane], path.std[-5:], rtol=1e-7)
    np.testing.assert_allclose(live.cov, run.cov(-1), rtol=1e-9)
    with pytest.raises(ValueError, match="no samples are kept"):
        Live(SHARED, TRACKER).smooth()
    with pytest.raises(ValueError, match="lag= and warm_start="):
        Live(SHARED, TRACKER, lag=3, warm_start=run)


def test_forecasts():
    rng = np.random.default_rng(0)
    A, B, r = np.array([[0.6, 0.2], [-0.3, 0.5]]), np.array([1.0, 0.5]), np.array([0.01, 0.04])
    u, y = rng.standard_normal(3000), np.zeros((3000, 2))
    for t in range(1, 3000):
        y[t] = A @ y[t - 1] + B * u[t - 1] + np.sqrt(r) * rng.standard_normal(2)
    run = track(JOINT, {"level": Kalman(0.0, r[0]), "flow": Kalman(0.0, r[1])}, y, u, weights=np.full(3000, 1.0))
    found = run.forecast(5, np.ones(5))
    theta, state, P = run.theta[-1], y[-1], np.zeros((2, 2))
    last = u[-1]
    for k in range(5):
        state = theta[:, :2] @ state + theta[:, 2] * last
        P = theta[:, :2] @ P @ theta[:, :2].T + np.diag(r)
        last = 1.0
        np.testing.assert_allclose(found.y_hat[k], state, rtol=1e-10)
        np.testing.assert_allclose(found.y_std[k], np.sqrt(np.diag(P)), rtol=0.02)
    assert found.theta.shape == (5, 2, 3)
    assert np.isnan(run.forecast(2).y_hat[1]).all()
    z, phi = measured()
    shared = track(SHARED, Kalman(0.01, 0.04), z, phi)
    ahead = shared.forecast(2, phi[:2])
    P = shared.cov(-1) + 0.02 * np.eye(2)
    np.testing.assert_allclose(ahead.y_hat[1], phi[1] @ shared.theta[-1], rtol=1e-10)
    np.testing.assert_allclose(ahead.y_std[1] ** 2, np.diag(phi[1] @ P @ phi[1].T) + 0.04, rtol=1e-9)
    with pytest.raises(ValueError, match="u must have a row for each of the 3"):
        shared.forecast(3, phi[:2])


@pytest.mark.filterwarnings("ignore:tune:UserWarning")
def test_tuning_is_output_by_output_or_of_all_rows():
    rng = np.random.default_rng(4)
    phi = rng.standard_normal((400, 2))
    theta = np.cumsum(np.array([0.1, 0.02])[:, None] * rng.standard_normal((400, 2, 2)), axis=0)
    y = np.einsum("ti,toi->to", phi, theta) + np.array([0.5, 0.1]) * rng.standard_normal((400, 2))
    model = Regression(2, ny=NAMES)
    tuned = tune(model, Kalman(), y, phi)
    for lane, name in enumerate(NAMES):
        alone = tune(Regression(2), Kalman(), y[:, lane], phi)
        np.testing.assert_allclose(tuned[name].tracker.q, alone.tracker.q, rtol=1e-6)
        assert tuned[name].tracker.r == pytest.approx(alone.tracker.r, rel=1e-6)
    assert track(model, tuned.tracker, y, phi).loglik == pytest.approx(tuned.loglik, abs=1e-6)
    assert tuned.at_bound == {}
    rows, z = rng.standard_normal((400, 2, 2)), np.empty((400, 2))
    z[:] = np.einsum("toi,ti->to", rows, theta[:, 0]) + 0.5 * rng.standard_normal((400, 2))
    shared = tune(SHARED, FLS(), z, rows)
    low, high = shared.interval["mu"]
    error = np.log(high / low) / (2.0 * 1.96)
    assert error < 0.25
    assert abs(np.log(shared.tracker.mu / 25.0)) < 2.6 * error
    one = frontier(SHARED, z, rows, mu=[25.01, 24.99])
    assert np.diff(one.measurement) / np.diff(one.dynamic) == pytest.approx(-25.0, rel=1e-3)


def test_what_is_of_one_output_says_so():
    (joint, y, u, _), (shared, z, phi, _) = records()
    run = track(joint, TRACKER, y, u)
    with pytest.raises(AttributeError, match=r"polynomials is of one output at a time: run\['level'\].polynomials"):
        _ = run.polynomials
    with pytest.raises(AttributeError, match="did you mean prediction"):
        _ = run.predictions
    with pytest.raises(ValueError, match=r"a sample of this run holds 2 outputs; run.rows.crossing"):
        track(shared, TRACKER, z, phi).crossing("theta1", above=1.0)
    live = Live(ARX(1, 1, inputs=1, ny=NAMES), TRACKER)
    with pytest.raises(ValueError, match="this needs a stream of one output; this one has level, flow"):
        _ = live.system
    assert "FLS(mu=1000.0)" in repr(run)
    with pytest.raises(ValueError, match="takes drift of shape"):
        track(joint, RLS(0.9), y, u, drift=np.ones((80, 3)))


def test_an_output_missing_before_anything_is_known_is_not_taken_for_theta0():
    y, u = coupled(80)
    y[1, 0] = np.nan
    run = track(JOINT, Kalman(q=1e-4, r=0.01), y, u)
    assert not run.ok[2].any()  # its lag would be theta0' phi
    assert run.ok[3].all()
    y[1, 0], y[40, 0] = 0.0, np.nan
    assert track(JOINT, Kalman(q=1e-4, r=0.01), y, u).ok[41].all()  # and this one the model's own prediction


def test_one_output_of_a_stream():
    (joint, y, u, _), (shared, *_) = records()
    run, live = track(joint, TRACKER, y, u), Live(ARX(1, 1, inputs=1, ny=NAMES), TRACKER)
    flow = live["flow"]
    for t in range(len(y)):
        live.update(y[t], u[t])
    assert (flow.output, flow.names, flow.tracker) == ("flow", run["flow"].names, TRACKER)
    assert flow.alarm is None
    np.testing.assert_array_equal(flow.theta, run["flow"].theta[-1])
    np.testing.assert_array_equal(flow.std, live[1].std)
    np.testing.assert_array_equal(flow.cov, run["flow"].cov(len(y) - 1))
    with pytest.raises(ValueError, match="FLS keeps no windowed information"):
        _ = flow.learning
    for absent in ("pressure", 2):
        with pytest.raises(KeyError, match="there are level, flow"):
            _ = live[absent]
    with pytest.raises(KeyError, match="one theta"):
        _ = Live(shared, TRACKER)["flow"]
    with pytest.raises(TypeError):
        iter(live)


@pytest.mark.parametrize("case", records(), ids=["joint", "shared"])
def test_an_operator_holds_and_resets_a_stream_of_several_outputs(case):
    """Held samples enter the lags and are not used, one by one or at once; what is reset is found by its name."""
    model, y, u, kind = case
    model = model if kind is Track else ARX(1, 1, inputs=1, ny=NAMES)
    one, many = Live(model, Kalman(q=1e-3, r=0.1)), Live(model, Kalman(q=1e-3, r=0.1))
    for t in range(20):
        one.update(y[t], u[t])
    many.update_many(y[:20], u[:20])
    before = one.theta, one.cov
    for live in (one, many):
        live.hold()
    for t in range(20, 25):
        assert not one.update(y[t], u[t], weight=2.0)[3].any()
        assert one.held
    assert not many.update_many(y[20:25], u[20:25]).ok.any()
    np.testing.assert_array_equal(one.theta, before[0])
    np.testing.assert_array_equal(one.cov, before[1])
    for live in (one, many):
        live.hold(False)
        live.update(y[25], u[25], weight=0.0)
        assert not live.held
    for t in range(26, 30):
        for a, b in zip(one.update(y[t], u[t]), many.update(y[t], u[t]), strict=True):
            np.testing.assert_array_equal(a, b)
    place, name = ((1, 1), "a1[flow<-flow]") if kind is Outputs else ((1,), one.names[1])
    theta, cov = one.theta, one.cov
    one.reset(name, p=2.0, theta=7.0)
    theta[place] = 7.0
    cov[(*place, place[-1])] += 2.0
    np.testing.assert_array_equal(one.theta, theta)
    np.testing.assert_allclose(one.cov, cov, rtol=1e-12)
    np.testing.assert_allclose(one.std[place] ** 2, cov[(*place, place[-1])], rtol=1e-12)
    with pytest.raises(ValueError, match="no parameter 'b9'"):
        one.reset("b9", p=1.0)


def test_outputs_that_share_one_theta_are_a_track_of_instants():
    _, (model, z, phi, _) = records()
    run = track(model, Kalman(q=1e-3, r=0.1), z, phi, keep="cov")
    assert isinstance(run, Track)
    assert (len(run), len(run.rows), run.rows.rows, run.rows_per_instant) == (80, 160, run.rows, 2)
    assert run.theta.shape == (80, 2)
    assert run.prediction.shape == run.ok.shape == run.log_density.shape == run.y.shape == (80, 2)
    assert run.loglik == run.rows.loglik
    for t in (0, 7, -1):
        np.testing.assert_array_equal(run.cov(t), run.rows.cov(2 * (t % 80) + 1))
        np.testing.assert_array_equal(run.covariances()[t], run.cov(t))
    np.testing.assert_array_equal(run.output_band(0.9, conformal=True)[0].ravel(), run.rows.output_band(0.9, True)[0])
    np.testing.assert_array_equal(run.band(0.9, conformal=True)[1], run.rows.band(0.9, True)[1][1::2])
    assert str(run.verdict()) == str(run.rows.verdict())


def test_summaries_are_objects():
    (joint, y, u, _), (shared, z, phi, _) = records()
    result = track(joint, TRACKER, y, u).summary()
    assert list(result) == ["level", "flow"]
    assert result["flow"].rows[0].name == "a1[flow<-level]"
    assert str(result["flow"]) in str(result)
    run = track(shared, TRACKER, z, phi)
    result = run.summary()
    assert result.rows[0].theta == run.theta[-1, 0]
    late = run.innovation[max(50, 5 * run.model.n) :]
    errors = np.sqrt(np.nanmean(late**2, axis=0))
    assert ", ".join(f"{name} {one:.5g}" for name, one in zip(run.outputs, errors, strict=True)) in str(result)
    last = np.stack([persistence(one) for one in run.y.T], axis=1)  # of the same output, not of the row before
    assert result.comparison.persistence == pytest.approx(np.sqrt(np.nanmean((run.y - last)[25:] ** 2)), rel=0.02)


def test_frontier_and_select_give_a_result_for_each_output():
    (joint, y, u, _), (shared, z, phi, _) = records()
    run = track(joint, Kalman(q=0.0, r=1.0), y, u)
    found = frontier(joint, y, u, mu=[1.0, 100.0])
    assert list(found) == ["level", "flow"]
    alone = frontier(run["flow"].model, run["flow"].y, run["flow"].u, mu=[1.0, 100.0])
    for name in Frontier._fields:
        np.testing.assert_allclose(getattr(found["flow"], name), getattr(alone, name), rtol=1e-6)
    assert isinstance(frontier(shared, z, phi, mu=[1.0]), Frontier)
    union, late = replace(joint, nb=2), replace(joint, nk=2)
    filled = track(union, Kalman(q=0.0, r=1.0), y, u)  # missing lags are those of all regressors
    chosen = select([joint, union, late], y, u, tracker=TRACKER)
    assert list(chosen) == ["level", "flow"]
    for name, one in chosen.items():
        again = {row.name: row.loglik for row in one.rows}[repr(joint)]
        rows = filled[name].u[:, :3]
        terms = track(Regression(run[name].names), TRACKER, y[:, run.outputs.index(name)], rows).log_density
        assert again == pytest.approx(terms[one.judged].sum() - price(3, unscored(80, 4)), rel=1e-3)
        assert set(one.regressors(repr(joint))) == set(run[name].names)
        assert one.regressors(repr(late))[-1] == filled[name].names[-1]  # not the column of the first lag
        assert name in str(chosen)
    best = select(joint, y, u, tracker=TRACKER)["level"].best.split()
    assert set(best) <= set(run["level"].names)
    assert select([shared], z, phi, tracker=TRACKER).best == repr(shared)
    with pytest.raises(ValueError, match="with the same outputs"):
        select([joint, replace(joint, ny=("level", "other"))], y, u, tracker=TRACKER)


@pytest.mark.filterwarnings("ignore:tune")
def test_every_verb_of_a_table_of_signals_is_that_of_arrays(tmp_path):
    (joint, y, u, _), _ = records()
    path = tmp_path / "record.csv"
    pl.DataFrame({"level": y[:, 0], "flow": y[:, 1], "u": u, "t": np.arange(80.0)}).write_csv(path)
    single = ARX(1, 1)
    arrays, table = {"y": y[:, 0], "u": u}, {"y": "level", "u": "u", "time": "t", "data": path}
    a, b = (tune(single, FLS(), **given) for given in (arrays, table))
    assert a.tracker == b.tracker
    a, b = (tune(joint, FLS(), y=given, u=inputs, **more) for given, inputs, more in (
        (y, u, {}), (["level", "flow"], "u", {"data": path, "time": "t"})))  # fmt: skip
    assert a.tracker == b.tracker
    a, b = (frontier(single, mu=[1.0, 100.0], **given) for given in (arrays, table))
    np.testing.assert_array_equal(a.measurement, b.measurement)
    a, b = (select(grid(ARX, na=[1, 2], nb=[1]), tracker=TRACKER, **given) for given in (arrays, table))
    assert [row.loglik for row in a.rows] == [row.loglik for row in b.rows]


def test_alarms_of_outputs_that_share_a_theta():
    rng = np.random.default_rng(2)
    phi = rng.standard_normal((400, 2, 2))
    y = np.einsum("toi,i->to", phi, [1.0, -2.0]) + 0.1 * rng.standard_normal((400, 2))
    y[300:] += 1.0
    run = track(SHARED, Kalman(q=1e-6, r=0.01), y, phi, time=np.arange(400.0))
    result = run.detect(reference=400)
    assert 600 <= result.onsets[result.onsets >= 500][0] < 620
    assert result.span(result.onsets[0])[0] == str(result.onsets[0] // 2)
    live = Live(SHARED, Kalman(q=1e-6, r=0.01))
    alarm = live.detect(result.rule)["rows"]
    for t in range(400):
        live.update(y[t], phi[t], time=float(t))
        if t == 350:
            live = Live.from_bytes(live.to_bytes())
            alarm = live.alarms["rows"]
    again = run.detect(result.rule)
    assert alarm.samples == 800
    assert alarm.onsets()[0].time == again.onsets[0] // 2

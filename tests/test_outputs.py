"""Several outputs: lanes that share regressors, and rows that share one theta."""

from copy import copy

import numpy as np
import polars as pl
import pytest
from support import rows_of, same

from driftfit import ARX, FLS, OE, RLS, AugmentedFLS, Kalman, Live, Regression, segment, select, track, tune

NAMES = ["level", "flow"]


def coupled(T=120, seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal(T), np.zeros((T, 2))
    for t in range(1, T):
        y[t] = np.array([[0.6, 0.2], [-0.1, 0.5]]) @ y[t - 1] + np.array([1.0, 0.5]) * u[t - 1]
        y[t] += 0.1 * rng.standard_normal(2)
    return y, u


def measured(T=60, seed=0):
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((T, 2, 2))
    return phi @ [1.0, -2.0] + 0.1 * rng.standard_normal((T, 2)), phi


def test_several_columns_are_several_outputs(tmp_path):
    y, u = coupled()
    table = pl.DataFrame({"level": y[:, 0], "flow": y[:, 1], "u": u, "k": 1})
    table.write_csv(tmp_path / "tank.csv")
    tracker = Kalman(q=1e-5, r=0.01)
    run = track(ARX(1, 1, ny=NAMES), tracker, y, u)
    for data in (table, tmp_path / "tank.csv"):
        assert np.array_equal(track(ARX(1, 1), tracker, y=list(NAMES), u="u", data=data).theta, run.theta)
    fleet = track(ARX(1, 1), tracker, y=NAMES, u="u", data=table, by="k")
    assert np.array_equal(fleet[1, "flow"].theta, run["flow"].theta)
    one = track(ARX(1, 1), tracker, y=["flow"], u="u", data=table)
    assert np.array_equal(one.theta, track(ARX(1, 1), tracker, y="flow", u="u", data=table).theta)
    assert list(tune(ARX(1, 1), Kalman(r=0.01), y=NAMES, u="u", data=table)) == list(NAMES)
    assert list(select([ARX(1, 1), ARX(2, 1)], y=NAMES, u="u", data=table, tracker=tracker)) == list(NAMES)
    with pytest.raises(ValueError, match=r"OE has one output, but y names level, flow; give one of them at a time"):
        track(OE(1, 1), tracker, y=NAMES, u="u", data=table)
    with pytest.raises(ValueError, match=r"segment: give one series of one output at a time"):
        segment(list(NAMES), "u", ARX(1, 1), data=table)


def test_each_output_is_an_arx_model_with_the_other_output_among_its_inputs():
    y, u = coupled()
    run = track(ARX(1, 1, ny=NAMES), Kalman(q=1e-5, r=0.01), y, u)
    for lane, (name, other) in enumerate(zip(NAMES, reversed(NAMES), strict=True)):
        lags = np.column_stack([y[:-1], u[:-1]])
        alone = track(Regression(3), Kalman(q=1e-5, r=0.01), y[1:, lane], lags)
        np.testing.assert_array_equal(run.theta[1:, lane], alone.theta)
        np.testing.assert_array_equal(run.innovation_std[1:, lane], alone.innovation_std)
        assert run.names[lane] == (f"a1[{name}<-level]", f"a1[{name}<-flow]", f"b1[{name}<-u]")
        one = run[name]
        assert one.names == run.names[lane]
        assert one.loglik == pytest.approx(alone.loglik)
        np.testing.assert_allclose(one.cov(-1), alone.cov(-1), rtol=1e-12)
        np.testing.assert_allclose(one.smooth().theta[1:], alone.smooth().theta, rtol=1e-9)
        assert other != name
    assert run.theta.shape == (120, 2, 3)
    assert run.loglik == pytest.approx(run["level"].loglik + run[1].loglik)
    np.testing.assert_allclose(run.theta[-1], [[0.6, 0.2, 1.0], [-0.1, 0.5, 0.5]], atol=0.1)


def test_a_missing_output_is_its_own_prediction_in_the_lags_of_all():
    y, u = coupled()
    y[50, 1] = np.nan
    y[90:94, 0] = np.nan
    run = track(ARX(1, 1, ny=2), Kalman(q=1e-5, r=0.01), y, u)
    assert run.ok[50].tolist() == [True, False]
    assert run.ok[51].all()
    for lane in (0, 1):
        assert run[lane].u[51, 1] == run.prediction[50, 1]
    # one prediction may stand for a lag (na = 1); after it neither output can be used until both lags are real again
    assert (
        run.ok[90:96].tolist() == [[False, True], [False, True], [False] * 2, [False] * 2, [False] * 2, [True] * 2][:6]
    )


def test_one_theta_each_on_the_same_regressors():
    rng = np.random.default_rng(1)
    u = rng.standard_normal((60, 2))
    y = u @ [[1.0, 0.0], [2.0, -1.0]] + 0.1 * rng.standard_normal((60, 2))
    run = track(Regression(["a", "b"], ny=NAMES), FLS(30.0), y, u)
    for lane, name in enumerate(NAMES):
        alone = track(Regression(2), FLS(30.0), y[:, lane], u)
        np.testing.assert_array_equal(run.theta[:, lane], alone.theta)
        np.testing.assert_array_equal(run.std[:, lane], alone.std)
        np.testing.assert_array_equal(run.smooth()[name].theta, alone.smooth().theta)
    assert run.names[1] == ("a[flow]", "b[flow]")


def test_rows_of_one_instant_are_one_vector_measurement():
    y, phi = measured()
    run = track(Regression(2, ny=2, shared=True), Kalman(q=0.01, r=0.04, p0=1.0), y, phi)
    theta, P = np.zeros(2), np.eye(2)
    for t in range(60):
        P = P + 0.01 * np.eye(2)
        S = phi[t] @ P @ phi[t].T + 0.04 * np.eye(2)
        K = P @ phi[t].T @ np.linalg.inv(S)
        theta = theta + K @ (y[t] - phi[t] @ theta)
        P = P - K @ phi[t] @ P
        np.testing.assert_allclose(run.theta[t], theta, rtol=1e-9)
        np.testing.assert_allclose(run.cov(t), P, rtol=1e-8)
    assert run.prediction.shape == (60, 2)
    assert run.theta.shape == (60, 2)
    path = run.smooth(keep="cov")
    assert path.theta.shape == path.std.shape == run.theta.shape
    assert path.residual.shape == path.loo.shape == path.leverage.shape == path.weight.shape == y.shape
    np.testing.assert_allclose(path.residual, y - np.einsum("tkn,tn->tk", phi, path.theta), atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(path.cov(-1))), path.std[-1], rtol=1e-12)
    np.testing.assert_allclose(path.theta[-1], run.theta[-1], rtol=1e-9)  # all samples are known there
    low, high = path.band()
    assert low.shape == high.shape == (60, 2)
    for i, axis in enumerate(path.plot().axes):
        smoothed, filtered = (line.get_ydata() for line in axis.lines)
        assert (smoothed == path.theta[:, i]).all()
        assert (filtered == run.theta[:, i]).all()


@pytest.mark.parametrize("tracker", [Kalman(q=1e-5, r=0.01), FLS(50.0), RLS(0.98)])
def test_stream_is_record_also_after_a_restart(tracker, tmp_path):
    y, u = coupled(60)
    y[[10, 30], [0, 1]] = np.nan
    joint = (ARX(1, 1, inputs=1, ny=NAMES), y, u)
    z, phi = measured()
    z[10, 1] = np.nan
    for model, out, given in (joint, (Regression(2, ny=2, shared=True), z, phi)):
        run = track(model, tracker, out, given, time=np.arange(60.0) + 1.0, drift=np.linspace(0.5, 2.0, 60))
        live = Live(model, tracker)
        for t in range(60):
            live.predict(given[t])
            y_hat, e, s, ok = live.update(out[t], given[t], time=t + 1.0, drift=float(np.linspace(0.5, 2.0, 60)[t]))
            np.testing.assert_array_equal(live.theta, run.theta[t])
            np.testing.assert_array_equal(live.std, run.std[t])
            np.testing.assert_array_equal(y_hat, run.prediction[t])
            np.testing.assert_array_equal(e, run.innovation[t])
            np.testing.assert_array_equal(np.sqrt(s), run.innovation_std[t])
            np.testing.assert_array_equal(ok, run.ok[t])
            if t == 31:
                live.save(tmp_path / "state")
                live = Live.load(tmp_path / "state")
            if t in (40, 50):
                live = Live.from_bytes(live.to_bytes()) if t == 40 else copy(live)
        live.update(out[0], given[0], time=3.0)
        assert live.ignored == 1
        assert live.names == run.names


def test_summary_and_pictures():
    y, u = coupled()
    run = track(ARX(1, 1, ny=NAMES), Kalman(q=1e-5, r=0.01), y, u)
    assert "a1[flow<-level]" in str(run.summary())
    assert "b1[level<-u]" in str(run.summary())
    assert "Signals" not in str(run.summary())  # regressors of the joint model are no signals
    assert repr(run.model) in str(run.summary())
    drawn = {axis.get_ylabel(): axis.get_lines()[0].get_ydata() for axis in run.plot().axes}
    assert drawn.keys() == {name for names in run.names for name in names}
    for k, names in enumerate(run.names):
        assert all(same(drawn[name], run.theta[:, k, i]) for i, name in enumerate(names))
    assert "level 119" in repr(run)
    z, phi = measured()
    shared = track(Regression(2, ny=2, shared=True), FLS(50.0), z, phi)
    summary = shared.summary()
    c = summary.comparison
    assert [f"{value:.5g}" for value in (c.tracked, c.persistence, c.constant_ls, c.constant_arx)] in rows_of(summary)
    drawn = {axis.get_ylabel(): axis.get_lines()[0].get_ydata() for axis in shared.plot().axes}
    assert all(same(drawn[name][1::2], shared.theta[:, i]) for i, name in enumerate(shared.names))


Y, U = coupled()
Z, PHI = measured()
SHARED = Regression(2, ny=2, shared=True)
UNFIT = {
    r"y must be \(T, 2\)": lambda: track(ARX(1, 1, ny=2), FLS(1.0), Y[:, 0], U),
    "shared=True needs several outputs": lambda: Regression(2, shared=True),
    "all different": lambda: ARX(1, 1, ny=["a", "a"]),
    "ny must be a whole number": lambda: ARX(1, 1, ny=0),
    r"u must be \(T, ny, m\)": lambda: track(SHARED, FLS(1.0), Z, PHI[:, 0]),
    "carries no covariance": lambda: track(SHARED, AugmentedFLS(1.0), Z, PHI),
    "must be of one kind and form": lambda: track(ARX(1, 1, ny=2), {"y1": FLS(1.0), "y2": RLS(0.9)}, Y, U),
    "trackers were given for level": lambda: track(ARX(1, 1, ny=2), {"level": FLS(1.0)}, Y, U),
    "one for each output by its name": lambda: Live(ARX(1, 1, inputs=1, ny=2), [FLS(1.0), FLS(2.0)]),
    "no output 'flow'": lambda: track(ARX(1, 1, ny=2), FLS(1.0), Y, U)["flow"],
    "has 1 inputs, but u has": lambda: Live(ARX(1, 1, inputs=1, ny=2), FLS(1.0)).update([1.0, 2.0], [1.0, 2.0]),
}


@pytest.mark.parametrize("message", UNFIT)
def test_what_does_not_fit_is_named(message):
    with pytest.raises((ValueError, KeyError), match=message):
        UNFIT[message]()

"""What more is known of parameters: laws, constraints, a prior from the fleet; against dense and sampled twins."""

import json

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import norm
from support import damaged, same

from driftfit import ARX, FLS, RLS, AugmentedFLS, Kalman, Law, Live, Regression, check_tracker, pool, track, tune
from driftfit.trackers.laws.law import transition
from driftfit.use.constrained import Constrained, cut, half_space, moments

LAWS = {"theta1": Law.returns(time=20, std=0.5), "theta2": Law.season(12, harmonics=2, q=1e-5)}
TRACKER = Kalman(q=1e-4, r=0.04, laws=LAWS)


def data(T=150, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, 2))
    theta = np.c_[1.0 + 0.3 * rng.normal(size=T), 2.0 + 0.5 * np.cos(2.0 * np.pi * np.arange(T) / 12)]
    return np.sum(theta * u, axis=1) + 0.2 * rng.normal(size=T), u


def test_smoothed_laws_are_the_least_squares_of_all_states():
    """Against one dense system for the components of all samples."""
    y, u = data(60)
    rng = np.random.default_rng(2)
    dt, drift, weights = rng.choice([1.0, 0.5, 3.0], 60), rng.choice([1.0, 20.0], 60), rng.choice([1.0, 4.0, 0.0], 60)
    y[rng.random(60) < 0.1] = np.nan
    dt[0] = 1.0
    laws = {"theta1": (Law.trend(1e-4, level=1e-3), Law.cycle(9, time=15, std=0.3)), "theta2": LAWS["theta1"]}
    run = track(
        Regression(2), Kalman(q=1e-4, r=0.04, laws=laws), y, u, time=np.cumsum(dt), drift=drift, weights=weights
    )
    law = run.fresh()["law"][0, ..., 0]
    N, H = 6, np.array([[1, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 1]], dtype=float)
    P, rows, unknown = np.zeros((60, N, 60, N)), np.zeros((60, 60, N)), np.eye(N)[:, [0, 1, 4]]
    free = np.zeros((60, N, 3))
    for t in range(60):
        F, Q = transition(law, dt[t])
        before = P[t - 1, :, t - 1] if t else np.diag([0.0, 0.0, 0.09, 0.09, 0.0, 0.25])
        P[t, :, t], free[t] = F @ before @ F.T + drift[t] * Q, F @ (free[t - 1] if t else unknown)
        for s in range(t):
            P[t, :, s] = F @ P[t - 1, :, s]
            P[s, :, t] = P[t, :, s].T
        rows[t, t] = H.T @ u[t]
    A, E, cov = rows.reshape(60, -1), free.reshape(-1, 3), P.reshape(60 * N, -1)

    def dense_smoother(used):
        """(mean, covariance) of all components: generalised least squares of what is unknown at the start."""
        V = np.linalg.inv(A[used] @ cov @ A[used].T + np.diag(0.04 / weights[used]))
        gain, X = cov @ A[used].T @ V, A[used] @ E
        Mi = np.linalg.inv(X.T @ V @ X)
        delta, D = Mi @ X.T @ V @ y[used], E - gain @ X
        return gain @ y[used] + D @ delta, cov - gain @ A[used] @ cov + D @ Mi @ D.T

    used, shown = np.isfinite(y) & (weights > 0.0), np.kron(np.eye(60), H)
    mean, var = dense_smoother(used)
    found, var = run.smooth(), (shown @ var @ shown.T).reshape(60, 2, 60, 2)
    np.testing.assert_allclose(found.theta.ravel(), shown @ mean, atol=1e-8)
    np.testing.assert_allclose(found.theta[-1], run.theta[-1], atol=1e-9)  # the compiled filter moves as `transition`
    np.testing.assert_allclose(found.std[-1], run.std[-1], rtol=1e-7)
    np.testing.assert_allclose(found.std**2, np.einsum("titi->ti", var), rtol=1e-7)
    np.testing.assert_allclose(found.lag_cov(7), var[7, :, 8], atol=1e-9)
    for t in np.flatnonzero(used)[[0, 20]]:  # leaving a sample out is leaving out its row
        alone = y[t] - A[t] @ dense_smoother(used & (np.arange(60) != t))[0]
        assert found.loo[t] == pytest.approx(alone, abs=1e-7)


def test_structural_models_are_those_of_statsmodels():
    sm = pytest.importorskip("statsmodels.api", reason="statsmodels is not installed")
    y = sm.datasets.co2.load_pandas().data.co2.resample("MS").mean().interpolate().to_numpy()[:120]
    laws = (Law.trend(level=None), Law.season(12, harmonics=6, q=None))
    tuned = tune(Regression(intercept=True), Kalman(q=0, laws={"intercept": laws}), y, intervals=False)
    other = sm.tsa.UnobservedComponents(
        y, "lltrend", freq_seasonal=[{"period": 12, "harmonics": 6}], use_exact_diffuse=True
    )
    assert all(Law.season(p, p // 2, q=1.0).components(0)[-1][-1] == 0.0 for p in range(2, 400, 2))  # half a wave
    trend, season = (law for _, law in tuned.tracker.laws)
    given = other.smooth([tuned.tracker.r, trend.level, trend.q, season.q])
    assert tuned.loglik == pytest.approx(given.llf + 6.5 * np.log(2.0 * np.pi), abs=1e-6)  # 13 unknown components
    best = other.fit(given.params, disp=0)
    assert given.llf > best.llf - 1e-5
    run = track(Regression(intercept=True), tuned.tracker, y)
    shown = np.array([1, 0] * 7)
    np.testing.assert_allclose(run.smooth().theta[:, 0], shown @ given.smoothed_state, rtol=1e-6)
    ahead, there = run.forecast(24), given.get_forecast(24)
    np.testing.assert_allclose(ahead.y_hat, there.predicted_mean, rtol=1e-6)
    np.testing.assert_allclose(ahead.y_std, there.se_mean, rtol=1e-6)
    limit = float(ahead.y_hat[12])
    drawn = run.crossing("intercept", above=limit, horizon=24).by
    assert drawn[-1] > 0.5 > drawn[1]


def test_no_sample_determines_two_directions():
    """A price that hardly moves beside a level and a season: 13 samples determine 13 unknowns, and no 12 do."""
    rng = np.random.default_rng(7)
    price, t = -2.3 + np.cumsum(0.02 * rng.normal(size=60)), np.arange(60)
    y = 7.0 + 0.1 * np.cos(np.pi * t / 6) - 0.3 * price + 0.06 * rng.normal(size=60)
    laws = {"intercept": (Law.walk(1e-5), Law.season(12, harmonics=5))}
    run = track(Regression(1, intercept=True), Kalman(q=0, r=0.003, laws=laws), y, price)
    assert np.isfinite(run.innovation_std).sum() <= 60 - 12
    np.testing.assert_allclose(run.theta[-1], run.smooth().theta[-1], rtol=1e-8)


def test_walks_are_the_kalman_filter_and_trends_are_second_differences():
    y, u = data()
    walk = track(Regression(2), Kalman(q=1e-3, r=0.04, laws={"theta1": Law.walk(1e-3)}), y, u)
    plain = track(Regression(2), Kalman(q=1e-3, r=0.04), y, u)
    np.testing.assert_allclose(walk.theta[2:], plain.theta[2:], rtol=1e-10)
    np.testing.assert_allclose(walk.std, plain.std, rtol=1e-10)
    assert walk.loglik == pytest.approx(plain.loglik, rel=1e-12)
    trend = Kalman(q=0.0, r=1.0, laws={name: Law.trend(1e-4) for name in ("theta1", "theta2")})
    np.testing.assert_allclose(
        track(Regression(2), trend, y, u).theta[5:], track(Regression(2), FLS(1e4, differences=2), y, u).theta[5:],
        rtol=1e-9,
    )  # fmt: skip


def test_laws_live_in_lanes_in_files_and_in_other_units():
    y, u = data()
    y, _ = damaged(y, u[:, 0])
    u = np.where(np.arange(150)[:, None] == 70, np.nan, u)
    run = track(Regression(2), TRACKER, y, u)
    live = Live(Regression(2), TRACKER)
    for t in range(150):
        if t == 75:
            live = Live.from_bytes(live.to_bytes())
        live.update(y[t], u[t])
        assert same(live.theta, run.theta[t])
    fleet = track(Regression(2), TRACKER, np.stack([y] * 33), np.stack([u] * 33), by="row")
    assert all(same(fleet[k].theta, run.theta) and same(fleet[k].std, run.std) for k in (0, 32))
    laws = {"theta1": Law.returns(time=20, std=0.5e-6), "theta2": Law.season(12, harmonics=2, q=1e-17)}
    other = track(Regression(2), Kalman(q=1e-16, r=0.04, laws=laws), y, 1e6 * u)
    np.testing.assert_allclose(1e6 * other.theta[12:], run.theta[12:], rtol=1e-6)


def test_the_promises_of_a_tracker_hold_with_laws():
    broken = check_tracker(Kalman(q=1e-6, r=0.01, laws={"theta1": Law.season(24)}), Regression(1))
    assert [one for one in broken if not one.startswith("It does not follow")] == []  # its record is that of an ARX


def test_a_known_mean_attracts_and_an_idle_input_holds_up_nothing():
    rng = np.random.default_rng(3)
    u = rng.normal(size=(300, 2))
    u[:200, 1] = 0.0
    y = u @ [2.5, 1.0] + 0.2 * rng.normal(size=300)
    y[100:150] = np.nan
    run = track(Regression(2), Kalman(q=0.0, r=0.04, laws={"theta1": Law.returns(5, 1.0, mean=2.0)}), y, u)
    assert run.theta[149, 0] == pytest.approx(2.0, abs=1e-3)
    assert run.std[149, 0] == pytest.approx(1.0, abs=1e-3)
    assert np.isinf(run.std[199, 1])
    assert run.theta[-1, 1] == pytest.approx(1.0, abs=0.1)
    assert np.isfinite(run.loglik)


def test_interventions_move_the_level():
    live = Live(Regression(2), TRACKER)
    for y, u in zip(*data(), strict=True):
        live.update(y, u)
    theta = live.theta
    live.reset("theta1", theta=5.0)
    live.reset("theta2", p=1.0)
    assert live.theta == pytest.approx([5.0, theta[1]])
    live.update(np.nan, [1.0, 1.0])
    assert live.theta[0] == pytest.approx(5.0, abs=0.1)
    assert live.std[1] > 0.9


def test_what_does_not_fit_a_law_is_refused():
    for laws, message in (
        ({"b": Law.trend(1.0)}, "names 'b', which is not a parameter"), ({"theta1": 3.0}, "must map names"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            track(Regression(2), Kalman(q=0.0, r=1.0, laws=laws), *data())
    for make, message in (
        (lambda: Law.season(4, harmonics=3), "half a wave"),
        (lambda: track(Regression(2), Kalman(0, 1, laws={"theta1": Law.returns()}), *data()), "returns.theta1..time, "),
        (lambda: track(Regression(2), Kalman(0, 1, laws={"theta1": [Law.walk(1), Law.trend(1)]}), *data()), "two laws"),
        (lambda: Law.trend(-1.0), "at least 0"), (lambda: Kalman(q=np.eye(2), r=1.0, laws=LAWS), "must be"),
        (lambda: track(Regression(2), TRACKER, *data()).smooth(order_by=np.arange(150)), "laws hold in time"),
        (lambda: track(Regression(2), TRACKER, *data()).ahead(2), "laws by which theta moves"),
        (lambda: tune(Regression(2), Kalman(laws=LAWS), *data(), bounds=(1e-3, 1.0)), "leave them out"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            make()
    again = Kalman.from_settings(json.loads(json.dumps(TRACKER.settings())))
    assert again == TRACKER == eval(repr(TRACKER))
    assert hash(again) == hash(TRACKER)


def test_cut_gaussians_against_sampled_ones():
    names, rng = ("a", "b", "b[u]"), np.random.default_rng(0)
    within = [half_space(text, names) for text in ("b >= 0", "0 <= a + b[u] <= 1", "2*a - b <= 0.5")]
    root = rng.normal(size=(3, 3))
    mu, S = np.array([0.2, -0.5, 0.3]), root @ root.T
    x = rng.multivariate_normal(mu, S, size=1_000_000)
    x = x[np.all([(x @ one.g >= one.low) & (x @ one.g <= one.high) for one in within], axis=0)]
    mean, cov, _, _ = cut(mu[None], S[None], within)
    np.testing.assert_allclose(mean[0], x.mean(axis=0), atol=0.03 * x.std())
    np.testing.assert_allclose(np.sqrt(np.diag(cov[0])), x.std(axis=0), rtol=0.03)
    # a half-line far in the tail: mean 1 / a beyond it, where the naive formula has lost all digits
    mean, var = moments(np.array([0.0, 1e6]), np.array([np.inf, np.inf]))
    np.testing.assert_allclose(mean, [np.sqrt(2.0 / np.pi), 1e6 + 1e-6], rtol=1e-12)
    np.testing.assert_allclose(var, [1.0 - 2.0 / np.pi, 1e-12], rtol=1e-9)


def test_bands_within_a_bound_cover_and_never_leave_it():
    """Parameters from the truncated prior, and their posterior: bands have their coverage, also near the bound."""
    rng = np.random.default_rng(0)
    b = abs(0.3 * rng.normal(size=4000))
    u = rng.normal(size=(4000, 8))
    P = 1.0 / (1.0 / 0.09 + np.sum(u**2, axis=1))
    free = P * np.sum(u * (b[:, None] * u + rng.normal(size=(4000, 8))), axis=1)
    inside = Constrained(("b",), (half_space("b >= 0", ("b",)),), free[:, None], P[:, None, None])
    low, high = inside.band()
    assert (low >= 0.0).all()
    assert np.mean((low[:, 0] < b) & (b < high[:, 0])) == pytest.approx(0.95, abs=0.01)
    error, before = (np.sqrt(np.mean((one - b) ** 2)) for one in (inside.theta[:, 0], free))
    assert error < 0.85 * before
    assert np.mean(inside.prob) == pytest.approx(np.mean(norm.cdf(free / np.sqrt(P))), rel=1e-9)


def test_planes_condition_and_streams_say_what_records_say():
    y, u = data()
    run = track(Regression(2), RLS(1.0), y, u)
    inside = run.constrain("theta1 + theta2 == 3")
    np.testing.assert_allclose(inside.theta[5:].sum(axis=1), 3.0, rtol=1e-12)
    weights = run.cov(-1).sum(axis=1) / run.cov(-1).sum()
    np.testing.assert_allclose(inside.theta[-1], run.theta[-1] - weights * (run.theta[-1].sum() - 3.0), rtol=1e-9)
    assert np.isinf(inside.std[0]).any()
    assert np.isnan(inside.prob[0]).all()
    live = Live(Regression(2), RLS(1.0))
    for one, row in zip(y, u, strict=True):
        live.update(one, row)
    np.testing.assert_allclose(live.constrain("theta1 + theta2 == 3").theta[0], inside.theta[-1], rtol=1e-12)
    both = run.constrain("0 <= theta1 <= 0.5", "theta1 + theta2 <= 2")
    assert both.theta[-1, 0] < 0.5
    assert "theta1 + theta2 <= 2" in repr(both)
    assert both.prob[-1, 0] < 0.01
    assert both.cov(-1).shape == (2, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("theta1", "is not a constraint"), ("theta1 >=", "is not a constraint"), ("theta1 * theta2 >= 0", "not linear"),
        ("b >= 0", "not linear"), ("1 <= theta1 <= 0", "no parameters satisfy"), ("0 <= theta1 <= theta2", "one sum"),
        ("theta1 != 0", "must compare"), ("theta1 >= theta1", "one sum"), ("__import__('os') >= 0", "not linear"),
    ],
)  # fmt: skip
def test_what_is_no_constraint_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        track(Regression(2), RLS(1.0), *data()).constrain(text)


def test_constraints_need_a_covariance_and_a_text():
    run = track(ARX(1, 1), AugmentedFLS(1.0), *(one[:, 0] if one.ndim > 1 else one for one in data()))
    with pytest.raises(ValueError, match="has no covariance"):
        run.constrain("a1 >= 0")
    with pytest.raises(ValueError, match="at least one"):
        track(Regression(2), RLS(1.0), *data()).constrain()


def fleet_of(count, T, seed, tracker=None):
    rng = np.random.default_rng(seed)
    units = rng.multivariate_normal([1.0, 2.0], [[0.04, 0.01], [0.01, 0.01]], size=count)
    u = rng.normal(size=(count, T, 2))
    y = np.einsum("itk,ik->it", u, units) + 0.5 * rng.normal(size=(count, T))
    return units, y, u, track(Regression(2), tracker or Kalman(q=0.0, r=0.25), y, u, by="row")


def test_a_prior_of_a_fleet_is_the_maximum_and_each_unit_its_posterior():
    units, y, u, fleet = fleet_of(40, 12, 0)
    pooled = pool(fleet)
    P, t = np.array([fleet[k].cov(-1) for k in pooled.keys]), pooled.own

    def loss(x):
        root = np.array([[x[0], 0.0], [x[1], x[2]]])
        W = np.linalg.inv(root @ root.T + P)
        V = np.linalg.inv(W.sum(axis=0))
        off = t - V @ np.einsum("iab,ib->a", W, t)
        total = np.linalg.slogdet(W)[1].sum() - np.einsum("ia,iab,ib->", off, W, off) + np.linalg.slogdet(V)[1]
        return -0.5 * total

    best = minimize(loss, [0.2, 0.05, 0.1], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9})
    assert pooled.loglik == pytest.approx(-best.fun, abs=1e-4)
    prior = Kalman(q=0.0, r=0.25, theta0=pooled.mean, p0=pooled.cov)
    again = track(Regression(2), prior, y, u, by="row")
    np.testing.assert_allclose([again[k].theta[-1] for k in pooled.keys], pooled.theta, atol=1e-9)
    error = [np.sqrt(np.mean((one - units) ** 2, axis=0)) for one in (pooled.theta, pooled.own)]
    assert (error[0] < [0.9, 0.6] * error[1]).all()
    assert pooled.spread == pytest.approx([0.2, 0.1], abs=0.06)


def test_a_noise_variance_for_each_unit_is_the_restricted_maximum():
    """Against the likelihood of all records as one mixed model, with constant parameters."""
    rng = np.random.default_rng(3)
    units, y, u, _ = fleet_of(12, 8, 3)
    true = 0.25 * np.exp(rng.normal(size=12))
    y = np.einsum("itk,ik->it", u, units) + np.sqrt(true)[:, None] * rng.normal(size=y.shape)
    y[4, 2] = np.nan
    pooled = pool(track(Regression(2), Kalman(q=0.0, r=0.25), y, u, by="row"), noise="each")

    def restricted(x):
        root, noise = np.array([[x[0], 0.0], [x[1], x[2]]]), np.exp(x[3:])
        total, A, b = 0.0, np.zeros((2, 2)), np.zeros(2)
        for i, (one, X) in enumerate(zip(y, u, strict=True)):
            X, one = X[np.isfinite(one)], one[np.isfinite(one)]
            S = X @ root @ root.T @ X.T + noise[i] * np.eye(len(one))
            W = np.linalg.inv(S)
            A, b, total = A + X.T @ W @ X, b + X.T @ W @ one, total - np.linalg.slogdet(S)[1] - one @ W @ one
        return -0.5 * (total + b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1])

    best = np.append(np.linalg.cholesky(pooled.cov)[np.tril_indices(2)], np.log(pooled.noise))
    for i in range(len(best)):
        away = np.zeros(len(best))
        away[i] = 1e-4
        slope = (restricted(best + away) - restricted(best - away)) / 2e-4
        assert abs(slope) < 1e-3, i
    assert np.corrcoef(np.log(pooled.noise), np.log(true))[0, 1] > 0.8
    assert pooled.tracker.r == pytest.approx(np.exp(np.mean(np.log(pooled.noise))))
    with pytest.raises(ValueError, match="noise"):
        pool({}, noise="own")


def test_pooling_with_drift_in_other_units_and_what_is_refused():
    _, y, u, fleet = fleet_of(30, 40, 1, Kalman(q=1e-4, r=0.25))
    pooled = pool(fleet)
    scaled = track(Regression(2), Kalman(q=1e-10, r=0.25), y, 1e3 * u, by="row")
    np.testing.assert_allclose(1e3 * pool(scaled).mean, pooled.mean, rtol=1e-5)
    np.testing.assert_allclose(1e6 * pool(scaled).cov, pooled.cov, rtol=0.02, atol=1e-4)
    u[3, :, 1] = 0.0
    with pytest.warns(UserWarning, match="1 of 30 units"):
        part = pool(track(Regression(2), Kalman(q=1e-4, r=0.25), y, u, by="row"))
    assert 3 not in part.keys
    with pytest.raises(ValueError, match="diffuse start"):
        pool(track(Regression(2), RLS(1.0), y[:5], u[:5], by="row"))
    with pytest.raises(ValueError, match="at least 4 are needed"):
        pool(track(Regression(2), Kalman(q=0.0, r=1.0), y[:2], u[:2], by="row"))

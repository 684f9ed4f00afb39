"""The operator's hand: warm starts, resets, and a hold."""

from __future__ import annotations

import numpy as np
import pytest

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Live, Track, track
from driftfit.data.storage import fields

MODEL = ARX(1, 1)
KINDS = [Kalman(q=1e-3, r=0.1), RLS(0.98), AugmentedFLS(mu=1.0)]


def record(T: int = 200, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=T)
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + u[t - 1] + 0.1 * rng.normal()
    y[50:53] = np.nan
    return y, u


def state(live: Live) -> dict[str, np.ndarray]:
    return {name: live._tile[name].copy() for name in fields(live._tile)}


@pytest.mark.parametrize("tracker", KINDS, ids=repr)
@pytest.mark.parametrize("cut", [1, 2, 51, 120])
def test_a_record_cut_in_two_is_the_whole(tracker, cut):
    y, u = record()
    time = np.cumsum(np.random.default_rng(1).choice([1.0, 2.0], len(y)))
    whole = track(MODEL, tracker, y, u, time=time, dt=1.4)
    first = track(MODEL, tracker, y[:cut], u[:cut], time=time[:cut], dt=1.4)
    second = track(MODEL, tracker, y[cut:], u[cut:], time=time[cut:], dt=1.4, warm_start=first)
    for name in whole.stores():
        assert np.array_equal(whole.written(name)[cut:], second.written(name), equal_nan=True), name
    assert np.array_equal(second.cov(-1), whole.cov(-1), equal_nan=True)
    if tracker.covariance:
        assert np.isclose(first.loglik + second.loglik, whole.loglik)
    live = Live(MODEL, tracker, dt=1.4, warm_start=first)
    for t in range(cut, len(y)):
        live.update(y[t], u[t], time=time[t])
    assert np.array_equal(live.theta, whole.theta[-1])
    more = track(MODEL, tracker, y, u, warm_start=live)
    assert len(more) == len(y)


def test_a_fleet_continues_a_fleet():
    y, u = np.stack([record(seed=k)[0] for k in range(12)]), np.stack([record(seed=k)[1] for k in range(12)])
    time = np.arange(200.0)
    whole = track(MODEL, KINDS[0], y, u, by="row", time=time)
    first = track(MODEL, KINDS[0], y[:11, :80], u[:11, :80], by="row", time=time[:80])
    second = track(MODEL, KINDS[0], y[:, 80:], u[:, 80:], by="row", time=time[80:], warm_start=first)
    for key in (0, 10):
        assert np.array_equal(second[key].theta, whole[key].theta[80:])
        assert np.array_equal(second[key].cov(50), whole[key].cov(130))
    assert np.array_equal(second[11].theta, track(MODEL, KINDS[0], y[11, 80:], u[11, 80:]).theta)


def test_a_warm_start_takes_new_settings_and_is_saved(tmp_path):
    y, u = record()
    first = track(MODEL, KINDS[0], y[:100], u[:100])
    second = track(MODEL, Kalman(q=0.0, r=0.1), y[100:], u[100:], warm_start=first)
    assert np.array_equal(second.state["q"], [0.0, 0.0])
    assert (second.std[-1] < first.std[-1]).all()
    second.save(tmp_path / "run.npz")
    assert np.array_equal(Track.load(tmp_path / "run.npz").cov(30), second.cov(30))


def test_warm_starts_that_do_not_fit():
    y, u = record()
    first = track(MODEL, KINDS[0], y, u, time=np.arange(200.0))
    with pytest.raises(ValueError, match="was made by Kalman, this one is by RLS"):
        track(MODEL, KINDS[1], y, u, warm_start=first)
    with pytest.raises(ValueError, match=r"the earlier run followed ARX\(na=1"):
        track(ARX(2, 0), KINDS[0], y, warm_start=first)
    with pytest.raises(ValueError, match=r"begins at 199.0, not after the end of the earlier run, 199.0"):
        track(MODEL, KINDS[0], y, u, time=np.arange(200.0) + 199.0, warm_start=first)


@pytest.mark.parametrize("tracker", KINDS, ids=repr)
def test_held_nothing_is_learned_and_nothing_forgotten(tracker, tmp_path):
    y, u = record()
    live = Live(MODEL, tracker)
    for t in range(100):
        live.update(y[t], u[t])
    before = state(live)
    live.hold()
    for t in range(100, 120):
        y_hat, _, _, ok = live.update(y[t], u[t], **({"time": float(t)} if t % 2 else {}))
        assert np.isclose(y_hat, live.theta @ [y[t - 1], u[t - 1]])
        assert not ok
    for name in ("theta", "P", "scale", "var", "count"):
        assert name not in before or np.array_equal(before[name], live._tile[name], equal_nan=True), name
    live.save(tmp_path / "held.npz")
    live = Live.load(tmp_path / "held.npz")
    assert live.held
    live.hold(False)
    live.update(y[120], u[120])
    assert not np.array_equal(before["theta"], live._tile["theta"])


def test_reset_widens_what_may_have_moved_and_leaves_the_rest():
    y, u = record()
    live = Live(MODEL, KINDS[0])
    for t in range(100):
        live.update(y[t], u[t])
    theta, cov = live.theta, live.cov
    live.reset(which="b1", p=4.0)
    assert np.array_equal(live.theta, theta)
    assert np.array_equal(live.cov - cov, [[0.0, 0.0], [0.0, live.cov[1, 1] - cov[1, 1]]])
    assert np.isclose(live.cov[1, 1], cov[1, 1] + 4.0)
    for t in range(100, 130):  # the gain has doubled
        live.update(y[t] + u[t - 1], u[t])
    assert abs(live.theta[1] - 2.0) < 0.2


@pytest.mark.parametrize("p0", [2.0, None])
def test_reset_reaches_the_square_root(p0):
    """Also while the start still knows nothing of a parameter."""
    y, u = record()
    streams = [Live(MODEL, Kalman(1e-3, 0.1, p0=p0, form=form)) for form in ("covariance", "sqrt")]
    for t in range(100):
        for live in streams:
            if t in (2, 60):
                live.reset("b1", p=4.0)
            if t == 80:
                live.reset("a1", theta=0.2)
            live.update(y[t], u[t])
        assert np.allclose(streams[1].theta, streams[0].theta, rtol=1e-9, atol=1e-12), t
        spanned = np.isfinite(streams[0].std)
        assert np.allclose(streams[1].std[spanned], streams[0].std[spanned], rtol=1e-9), t


def test_reset_is_in_the_units_of_theta_for_relative_covariances():
    y, u = record()
    live = Live(MODEL, RLS(0.98))
    live.update(y[0], u[0])
    live.reset(p=1.0)  # nothing is known: nothing becomes known
    assert np.isinf(live.std).all()
    for t in range(100):
        live.update(y[t], u[t])
    cov = live.cov
    live.reset(which=[0], p=4.0)
    assert np.isclose(live.cov[0, 0], cov[0, 0] + 4.0)


def test_reset_of_the_value():
    for tracker in KINDS:
        live = Live(MODEL, tracker)
        live.update(1.0, 1.0)
        live.reset(which="a1", theta=0.5)
        assert live.theta[0] == 0.5
        live.reset(theta=[0.1, 0.2])
        assert np.array_equal(live.theta, [0.1, 0.2])


def test_resets_that_make_no_sense():
    live = Live(MODEL, KINDS[0])
    with pytest.raises(ValueError, match="no parameter 'b2'; there is a1, b1"):
        live.reset("b2", p=1.0)
    with pytest.raises(ValueError, match="no parameter 2"):
        live.reset(2, p=1.0)
    with pytest.raises(ValueError, match="p must be finite and at least 0"):
        live.reset("b1", p=-1.0)
    with pytest.raises(ValueError, match="give p= "):
        live.reset("b1")
    with pytest.raises(ValueError, match="AugmentedFLS carries no covariance that can be widened"):
        Live(MODEL, KINDS[2]).reset("b1", p=1.0)

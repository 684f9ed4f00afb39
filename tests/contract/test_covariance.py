"""The covariance over long runs: symmetric, finite, not negative, and bounded as promised without excitation."""

from dataclasses import replace

import numpy as np
import pytest
from support import arx_record, damaged, same

from driftfit import AdaptiveKalman, Bank, Live, Sensor, track

LONG = 30_000


def records(T):
    """Records that are hard on a covariance, as (y, u)."""
    rng = np.random.default_rng(1)
    y, u = arx_record(T, 1)
    silent, off = y.copy(), u.copy()
    silent[500:], off[500:] = 0.0, 0.0
    wave = np.sin(0.3 * np.arange(T))
    return {
        "excited": (y, u),
        "damaged": damaged(y, u),
        "silent": (silent, off),
        "constant": (np.full(T, 2.0), np.full(T, 3.0)),
        "one frequency": (1.5 * wave, wave),
        "nearly one frequency": (1.5 * wave + 1e-9 * rng.standard_normal(T), wave),
        "outage": (np.where(np.arange(T) < 500, y, np.nan), u),
        "large numbers": (1e5 * y, 1e5 * u),
        "bursts": (silent + (rng.random(T) < 1e-3) * 10.0, off),
    }


RECORDS = records(LONG)


@pytest.mark.filterwarnings("ignore:.*could not be learned:UserWarning")
@pytest.mark.parametrize("name", list(RECORDS))
def test_covariance_stays_finite_symmetric_and_positive(model, tracker, name):
    run = track(model, tracker, *RECORDS[name])
    assert np.isfinite(run.theta).all()
    if not tracker.covariance:
        assert np.isnan(run.std).all()
        assert np.isnan(run.cov(-1)).all()
        return
    spanned = np.isfinite(run.std)
    assert not np.isnan(run.std[np.cumsum(run.ok) > model.n + 1]).any()
    assert (np.diff(spanned.astype(int), axis=0) >= 0).all()  # what was known once stays known
    for t in (1000, LONG - 1):
        P = run.cov(t)[np.ix_(spanned[t], spanned[t])]
        assert same(P, P.T)
        assert np.isfinite(P).all()
        if P.size:
            size = 1.0 / np.sqrt(np.diag(P))
            assert np.linalg.eigvalsh(P * size * size[:, None]).min() > -1e-9


def test_no_excitation_stays_within_the_promise(model, tracker):
    """A random walk grows by exactly q a sample; exponential forgetting stops at its cap."""
    y, u = RECORDS["silent"]
    run = track(model, tracker, y, u)
    if isinstance(tracker, Bank):
        # regressors of zero say nothing about theta, so leaves stay; but readings that repeat say that the noise is
        # small, of which leaves have different estimates: those change in weight, and do not if it is known
        live = Live(model, tracker)
        for t in range(601):
            live.update(y[t], float(u[t]))
        leaves = live.hypotheses.mixture().means
        assert (leaves.min(axis=0) - 1e-9 < run.theta[600:]).all()
        assert (leaves.max(axis=0) + 1e-9 > run.theta[600:]).all()
        run = track(model, replace(tracker, sensors=[Sensor.nominal(r=0.01)]), y, u)
    unit = np.where(np.isfinite(run.std[600]), run.std[600], 1.0)
    # filters that follow a trend move on until their slopes have faded
    most = 1e-3 if isinstance(tracker, AdaptiveKalman) else 1e-9
    assert np.max(np.abs(run.theta[600:] - run.theta[600]) / unit) < most
    P = np.diagonal([run.cov(t) for t in (600, LONG - 1)], axis1=1, axis2=2)
    if hasattr(tracker, "q"):
        expected = P[0] + (LONG - 601) * tracker.q
        np.testing.assert_allclose(P[1], expected, rtol=1e-9)
    if hasattr(tracker, "c_max"):
        live = Live(model, tracker)
        for t in range(6):
            live.update(y[t], float(u[t]))
        assert live._tile["rank"][0, 0] == model.n
        at_full_rank = np.trace(np.tril(live._tile["P"][0, ..., 0]))
        for t in (600, 5000, LONG - 1):
            scale = track(model, tracker, y[: t + 1], u[: t + 1]).state["scale"]
            assert np.trace(run.cov(t)) <= 1.0000001 * tracker.c_max * at_full_rank * scale


def test_keep_cov_is_what_cov_replays(model, tracker):
    y, u = damaged(*arx_record(300, 2))
    run = track(model, tracker, y, u)
    if not tracker.covariance:
        with pytest.raises(ValueError, match="carries no covariance"):
            track(model, tracker, y, u, keep="cov")
        return
    kept = track(model, tracker, y, u, keep="cov")
    for t in (0, 1, 3, 4, 5, 10, 150, 299, -1):
        assert same(kept.cov(t), run.cov(t)), t
        assert same(np.sqrt(np.diag(run.cov(t))), run.std[t]), t
    assert same(kept.theta, run.theta)

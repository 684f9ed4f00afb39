"""Bad data never raise and never poison a state: what is NaN, inf, absurdly large or away is skipped, nothing more."""

import numpy as np
import pytest
from contract_table import as_arx, model_of, ready, unusable
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import BAD, THETA, arx_record, damaged, same

from driftfit import Live, Regression, track
from driftfit.trackers import found

T = 3000


@pytest.mark.parametrize("signal", ["y", "u"])
def test_one_bad_value_is_skipped_and_forgotten(model, tracker, signal):
    y, u = arx_record(T, 1)
    clean = track(model, tracker, y, u)
    record = {"y": y.astype(object), "u": u.astype(object)}
    record[signal][100] = np.nan
    run = track(model, tracker, **record)
    assert np.isfinite(run.theta).all()
    needed = unusable(tracker, model, signal, 100)
    assert np.flatnonzero(~run.ok[50:]).tolist() == [i - 50 for i in needed]
    assert np.isnan(run.innovation[needed]).all()
    np.testing.assert_allclose(run.theta[-1], clean.theta[-1], atol=0.02)
    for value in (*BAD, 1e100, None):
        record[signal][100] = value
        other = track(model, tracker, **{name: values[:200] for name, values in record.items()})
        assert same(other.theta, run.theta[:200]), value
        assert same(other.innovation, run.innovation[:200]), value
        assert same(other.ok, run.ok[:200]), value


@pytest.mark.parametrize("signals", ["y", "u", "yu"])
def test_an_outage_is_survived(model, tracker, signals):
    y, u = arx_record(T, 2)
    clean = track(model, tracker, y, u)
    record = {"y": y.copy(), "u": u.copy()}
    for signal in signals:
        record[signal][500:900] = np.nan
    run = track(model, tracker, **record)
    assert np.isfinite(run.theta).all()
    assert not run.ok[503:900].any()
    assert run.ok[903:].all()
    assert same(run.theta[510:900], np.repeat(run.theta[510:511], 390, axis=0))
    np.testing.assert_allclose(run.theta[-1], clean.theta[-1], atol=0.02)


def test_an_outage_widens_the_band_and_never_narrows_it(model, tracker):
    y, u = arx_record(600, 3)
    y[300:500] = np.nan
    std = track(model, tracker, y, u).std
    if tracker.covariance:
        assert (np.diff(std[303:500], axis=0) >= 0.0).all()
    else:
        assert np.isnan(std).all()


def test_filling_ends_after_na_outputs(model, tracker):
    """Filled lags carry the prediction for na outputs; then nothing is predicted until real lags are back."""
    y, u = arx_record(600, 4)
    y[300:350] = np.nan
    run = track(model, tracker, y, u)
    blind, skipped = range(303, 352), list(range(300, 352))
    if model.implicit:  # such a model never fills, and a tracker without lags of y needs none
        skipped = unusable(tracker, model, "y", 300, 349)
        blind = [] if tracker.output_error else skipped[1:]
    assert np.flatnonzero(np.isnan(run.prediction[200:])).tolist() == [t - 200 for t in blind]
    assert np.flatnonzero(~run.ok[200:]).tolist() == [t - 200 for t in skipped]


def test_a_record_without_any_data_leaves_the_start(model, tracker):
    run = track(model, tracker, np.full(50, np.nan), np.full(50, np.nan))
    assert not run.ok.any()
    assert same(run.theta, np.broadcast_to(tracker.state_for(model)["theta"], run.theta.shape))
    assert run.summary().comparison.samples == 0


def test_a_regressor_that_wakes_up_late(model, tracker):
    """Inputs of zero before every direction was excited: exponential forgetting must not run away meanwhile."""
    y, u = np.zeros((2, 20_000))
    u[2] = 1.0  # shows two of the four directions
    y[-200:], u[-200:] = arx_record(200, 6, noise=0.01)
    run = track(model, tracker, y, u)
    assert np.isfinite(run.theta).all()
    np.testing.assert_allclose(as_arx(tracker, run.theta)[-1], THETA, atol=0.05)


# Numbers whose squares span less than double precision: beyond that a covariance needs its square-root form.
ANYTHING = st.one_of(
    st.sampled_from([*BAD, 0.0, -999.0, 5e-324, 1e-200]), st.floats(0.01, 1000.0), st.floats(-1000.0, -0.01)
)


@pytest.mark.parametrize("kind", list(found().values()), ids=list(found()))
@given(samples=st.lists(st.tuples(ANYTHING, ANYTHING), min_size=1, max_size=25))
@example(samples=[(1.0, 1e-170)])
@settings(max_examples=50)
def test_no_sequence_of_numbers_poisons_a_stream(kind, samples):
    live = Live(model_of(kind, Regression(1)), ready(kind))
    for y, u in samples:
        live.update(y, u)
        assert np.isfinite(live.theta).all(), live.theta
        assert not (np.diag(live.cov) < 0.0).any()
    rng = np.random.default_rng(0)
    for u in rng.standard_normal(50):
        live.update(2.0 * u, u)
    assert np.isfinite(live.theta).all()


def test_damage_everywhere_leaves_a_usable_estimate(model, tracker):
    y, u = arx_record(T, 7)
    run = track(model, tracker, *damaged(y, u, seed=8))
    assert 0.4 < run.ok.mean() < 0.9
    np.testing.assert_allclose(run.theta[-1], track(model, tracker, y, u).theta[-1], atol=0.1)

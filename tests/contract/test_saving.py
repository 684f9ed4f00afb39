"""Save, kill, load, continue = never stopped; settings survive being written down."""

import json
from dataclasses import fields, replace
from datetime import datetime, timedelta

import numpy as np
import pytest
from contract_table import no_default, ready
from support import arx_record, damaged, same

from driftfit import ARX, Live, Regression, Track, track

STOPS = [0, 1, 3, 5, 100, 153]


@pytest.mark.parametrize("stop", STOPS)
def test_a_stream_continues_as_if_never_stopped(model, tracker, tmp_path, stop):
    y, u = damaged(*arx_record(300, 1))  # the outage is at 150 .. 159, with filled lags
    gaps = np.random.default_rng(2).choice([1.0, 1.2, 2.0], 300, p=[0.8, 0.1, 0.1])
    gaps[STOPS] = 1.3
    time = np.cumsum(gaps)

    def feed(live, start, end):
        return [live.update(y[t], u[t : t + 1], time=time[t]) for t in range(start, end)]

    live = Live(model, tracker)
    feed(live, 0, stop)
    live.save(tmp_path / "state")
    other = Live.load(tmp_path / "state")
    assert (other.model, other.tracker) == (live.model, live.tracker)
    assert same(feed(live, stop, 300), feed(other, stop, 300))
    assert live.to_bytes() == other.to_bytes()
    assert same(live.cov, other.cov)


@pytest.mark.parametrize("kind", ["datetime", "numpy"])
def test_a_stream_with_dates_continues(model, tracker, tmp_path, kind):
    y, u = arx_record(60, 3)
    start, dt = (
        (datetime(2024, 1, 1), timedelta(seconds=2))
        if kind == "datetime"
        else (np.datetime64("2024-01-01T00:00:00.000001"), np.timedelta64(2, "s"))
    )
    live = Live(model, tracker, dt=dt)
    for t in range(60):
        live.update(y[t], float(u[t]), time=start + t * dt)
        if t == 30:
            assert not live.update(0.0, 0.0, time=start)[3]
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
            assert live.ignored == 1
    assert same(live.theta, track(model, tracker, y, u).theta[-1])


@pytest.mark.parametrize("keep", ["std", "cov"])
def test_a_result_is_the_same_after_loading(model, tracker, tmp_path, keep):
    y, u = damaged(*arx_record(200, 4))
    run = track(
        model, tracker, y, u, time=np.arange(200) * 1.25, weights=np.full(200, 2.0),
        keep=keep if tracker.covariance else "std",
    )  # fmt: skip
    run.save(tmp_path / "run")
    other = Track.load(tmp_path / "run")
    assert (other.model, other.tracker, other.names) == (run.model, run.tracker, run.names)
    for name in ("y", "u", "time", "theta", "std", "prediction", "innovation", "innovation_std", "ok"):
        assert same(getattr(other, name), getattr(run, name)), name
    assert same(other.loglik, run.loglik)
    assert same(other.cov(77), run.cov(77))
    assert str(other.summary()) == str(run.summary())


def test_settings_survive_being_written_down(tracker):
    by_default = {field.name: field.default for field in fields(tracker) if not no_default(field)}
    for given in (tracker, replace(tracker, **by_default), *varied(type(tracker))):
        text = json.dumps(given.settings())
        again = type(given).from_settings(json.loads(text))
        assert again == given
        assert hash(again) == hash(given)
        assert repr(again) == repr(given)


def varied(kind):
    """The same tracker with vectors and matrices, given as arrays, where it takes them."""
    names = {field.name for field in fields(kind)}
    if "theta0" in names:
        yield ready(kind, theta0=np.array([1.0, 2.0]))
    for name in {"q", "p0"} & names:
        for value in (2, [1.0, 0.0], np.array([[2.0, 0.5], [0.5, 1.0]])):
            yield ready(kind, **{name: value})


@pytest.mark.parametrize(
    "given",
    [
        ARX(2, 2), ARX(2, [1, 2], nk=[0, 1], inputs=["flow", "head"], intercept=True, start="zero"),
        ARX(1, 0), Regression(2), Regression(["income", "rate"], intercept=True),
    ],
    ids=repr,
)  # fmt: skip
def test_settings_of_models_survive_too(given):
    again = type(given).from_settings(json.loads(json.dumps(given.settings())))
    assert again == given
    assert again.names == given.names
    assert hash(again) == hash(given)

"""Stream = record = lane of a fleet's tile, bit for bit; nothing looks ahead; nothing that was given is changed."""

import sys

import numpy as np
import pytest
from support import arx_record, damaged, run_lanes, same

from driftfit import Live, track

T = 300


def factors(seed):
    """Times with gaps, weights with zeros, and factors of the drift."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.choice([1.0, 0.5, 1.25, 3.0], T, p=[0.8, 0.1, 0.05, 0.05]))
    weights = rng.choice([1.0, 2.0, 0.25, 0.0], T, p=[0.7, 0.1, 0.1, 0.1])
    drift = rng.choice([1.0, 0.0, 50.0], T, p=[0.8, 0.1, 0.1])
    return {"time": time, "weights": weights, "drift": drift}


def assert_same_run(a, b, upto=None):
    for name in ("theta", "std", "prediction", "innovation", "innovation_std", "ok"):
        assert same(getattr(a, name)[:upto], getattr(b, name)[:upto]), name
    for name in a.tracker.outputs:
        assert same(a.written(name)[:upto], b.written(name)[:upto]), name


@pytest.mark.parametrize("known", [{}, factors(5)], ids=["plain", "times, weights, drift"])
def test_live_says_what_the_record_says(model, tracker, known):
    y, u = damaged(*arx_record(T, 1), seed=2)
    run = track(model, tracker, y, u, **known)
    live = Live(model, tracker)
    names = {"time": "time", "weights": "weight", "drift": "drift"}
    for t in range(T):
        at = {names[name]: float(value[t]) for name, value in known.items()}
        drive = float(u[t]) if t % 2 else u[t : t + 1]  # a number, or an array
        got = live.update(None if np.isnan(y[t]) else float(y[t]), drive, **at)
        innovation_std = np.sqrt(got[2])
        assert same(got[:2], (run.prediction[t], run.innovation[t])), t
        assert same(innovation_std, run.innovation_std[t]), t
        assert got[3] == run.ok[t], t
        assert same(live.theta, run.theta[t]), t
        assert same(live.std, run.std[t]), t


@pytest.mark.parametrize("known", [{}, factors(5)], ids=["plain", "times, weights, drift"])
def test_several_samples_at_once_leave_what_one_after_the_other_leave(model, tracker, known):
    """Results and the bytes of the state, in pieces of any length, some of them single updates; late times too."""
    y, u = damaged(*arx_record(T, 1), seed=2)
    if known:
        known["time"][[0, 40, 41, 299]] = np.nan, 3.0, np.inf, -np.inf
    singly, together = Live(model, tracker), Live(model, tracker)
    names = {"time": "time", "weights": "weight", "drift": "drift"}
    for a, b in [(0, 5), (5, 5), (5, 6), (6, 170), (170, 172), (172, 300)]:
        steps, thetas, stds = [], [], []
        for live in (singly, together):
            live.hold(a == 170)
        for t in range(a, b):
            at = {names[name]: float(value[t]) for name, value in known.items()}
            steps.append(singly.update(y[t], u[t : t + 1], **at))
            thetas.append(singly.theta), stds.append(np.sqrt(singly.lane()["var"]))
        got = together.update_many(y[a:b], u[a:b], **{name: value[a:b] for name, value in known.items()})
        assert len(got) == b - a
        y_hat, e, s, ok = np.reshape(steps, (-1, 4)).T
        assert same(got.prediction, y_hat)
        assert same(got.innovation, e)
        assert same(got.innovation_var, s)
        assert same(got.ok, ok > 0)
        assert same(got.theta, np.reshape(thetas, (-1, len(live.names))))
        assert same(got.std, np.reshape(stds, (-1, len(live.names))))
        assert together._tile.tobytes() == singly._tile.tobytes(), (a, b)
        assert together.to_bytes() == singly.to_bytes()
        assert together.ignored == singly.ignored
    assert singly.ignored == (4 if known else 0)


def test_a_lane_says_what_the_record_says(model, tracker):
    series = [damaged(*arx_record(T, lane), seed=lane, share=0.01 * lane) for lane in range(tracker.width)]
    known = [factors(lane) for lane in range(tracker.width)]
    runs = [track(model, tracker, y, u, gate=False, **k) for (y, u), k in zip(series, known, strict=True)]
    y, u = (np.stack(signal, axis=1) for signal in zip(*series, strict=True))
    out, _ = run_lanes(
        model, [tracker] * tracker.width, y, u[:, None, :], np.stack([run.known.columns for run in runs], axis=2)
    )
    for lane, run in enumerate(runs):
        for name in run.stores():
            assert same(out[name][..., lane], run.written(name)), (lane, name)


def test_chunks_do_not_show(model, tracker, monkeypatch):
    y, u = damaged(*arx_record(T, 4))
    whole = track(model, tracker, y, u, **factors(1))
    for name, value in (("PROGRESS_SAMPLES", 37), ("FIRST_PART", 37), ("PART_SECONDS", 0.0)):
        monkeypatch.setattr(sys.modules["driftfit.run.program"], name, value)
    assert_same_run(whole, track(model, tracker, y, u, **factors(1)))


@pytest.mark.filterwarnings("ignore:.*looks? like (a )?fault code")  # what comes is a hundred times as large
@pytest.mark.parametrize("cut", [2, 3, 6, 150])
def test_nothing_looks_ahead(model, tracker, cut):
    y, u = damaged(*arx_record(T, 6))
    known = factors(2)
    run = track(model, tracker, y, u, **known)
    rng = np.random.default_rng(0)
    late = slice(cut, None)
    y2, u2, known2 = y.copy(), u.copy(), {name: value.copy() for name, value in known.items()}
    y2[late], u2[late] = 100.0 * rng.standard_normal((2, T - cut))
    known2["time"][late] += 40.0
    known2["weights"][late], known2["drift"][late] = 3.0, 7.0
    other = track(model, tracker, y2, u2, **known2)
    assert_same_run(run, other, upto=cut)
    assert same(run.cov(cut - 1), other.cov(cut - 1))
    assert not same(run.theta[late], other.theta[late])
    assert_same_run(run, track(model, tracker, y[:cut], u[:cut], **{k: v[:cut] for k, v in known.items()}), upto=cut)


def test_what_was_given_stays_as_it_was(model, tracker):
    y, u = damaged(*arx_record(T, 8))
    given = {"y": y, "u": u, **factors(3)}
    before = {name: value.copy() for name, value in given.items()}
    for value in given.values():
        value.setflags(write=False)
    run = track(model, tracker, **given)
    run.cov(T // 2)
    live = Live(model, tracker)
    for t in range(20):
        live.update(y[t], u[t : t + 1])
    for name, value in given.items():
        assert same(value, before[name]), name


def test_predict_leaves_the_state_alone(model, tracker):
    y, u = arx_record(60, 10)
    live = Live(model, tracker)
    for t in range(60):
        before = live._tile.tobytes()
        expected = live.predict(float(u[t]))
        assert live._tile.tobytes() == before
        y_hat, _, s, _ = live.update(float(y[t]), float(u[t]))
        assert same((y_hat, s), expected)


def test_a_sample_before_the_last_is_counted_and_ignored(model, tracker):
    y, u = arx_record(50, 11)
    live = Live(model, tracker)
    for t in range(50):
        live.update(y[t], u[t : t + 1], time=float(t))
    before = live._tile.tobytes()
    for late in (49.0, 10.0):
        assert not live.update(1e3, u[:1], time=late)[3]
    assert live.ignored == 2
    assert live._tile.tobytes() == before

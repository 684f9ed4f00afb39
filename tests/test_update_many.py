"""Several samples of a stream at once: what `update` gives for one after the other, whatever follows the samples.

`tests/contract/test_modes.py` does this for every tracker; here are several outputs, alarms, windows, limits and dates.
"""

from datetime import datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from support import arx_record, damaged, same
from test_bank import N, R, changes
from test_bank import record as jumping
from test_outputs import NAMES, coupled, measured

from driftfit import ARX, FLS, RLS, Bank, Beam, Kalman, Live, Regression, Sensor, track

K = Kalman(q=1e-4, r=0.01)
PIECES = [(0, 1), (1, 1), (1, 30), (30, 32), (32, 60)]


def compare(singly, together, signals, known=None):
    """Feed two equal streams, one sample by sample and one in pieces; results and states must agree bit for bit."""
    y, u = signals
    known = known or {}
    one = {"weights": "weight"}
    for a, b in PIECES:
        steps, thetas = [], []
        for t in range(a, b):
            at = {one.get(name, name): values[t] for name, values in known.items()}
            steps.append(singly.update(y[t], None if u is None else u[t], **at))
            thetas.append(singly.theta)
        got = together.update_many(
            y[a:b], None if u is None else u[a:b], **{name: values[a:b] for name, values in known.items()}
        )
        assert len(got) == b - a
        columns = zip(*steps, strict=True) if steps else [()] * 4
        for name, values in zip(("prediction", "innovation", "innovation_var", "ok"), columns, strict=True):
            assert same(getattr(got, name), np.reshape(values, getattr(got, name).shape)), name
        assert same(got.theta, np.reshape(thetas, got.theta.shape))
        assert got.std.shape == got.theta.shape
        assert together._tile.tobytes() == singly._tile.tobytes()
        assert together.to_bytes() == singly.to_bytes()


def late(T, seed=3):
    """Times with gaps, some of them not after the last, not known or infinite."""
    time = np.cumsum(np.random.default_rng(seed).choice([1.0, 0.5, 3.0], T, p=[0.8, 0.1, 0.1]))
    time[[0, 7, 8, 31]] = np.nan, 2.0, np.inf, 5.0
    return time


@pytest.mark.parametrize("lag", [0, 3])
@pytest.mark.parametrize("case", ["joint", "shared"])
def test_several_outputs(case, lag):
    y, u = coupled(60) if case == "joint" else measured(60)
    y[[10, 30], [0, 1]] = np.nan
    model = ARX(1, 1, inputs=1, ny=NAMES) if case == "joint" else Regression(2, ny=2, shared=True)
    rng = np.random.default_rng(0)
    n = 3 if case == "joint" else 2
    known = {"time": late(60), "weights": rng.uniform(0.2, 2.0, (60, 2)), "drift": rng.uniform(0.2, 2.0, (60, n))}
    limits = {NAMES[0] if case == "joint" else "y1": (-0.5, 0.5)}
    compare(*(Live(model, FLS(1e3), lag=lag, limits=limits) for _ in range(2)), (y, u), known)


@pytest.mark.parametrize("kind", ["glr", "band"])
def test_alarms_and_windows(kind):
    y, u = damaged(*arx_record(360, 5), share=0.02)
    before = track(ARX(2, 2), K, y[:300], u[:300])
    rule = before.detect(kind, every=10.0, reference=300).rule
    y[310:] += 0.5
    streams = [Live(ARX(2, 2), K, warm_start=before, dt=timedelta(minutes=1)) for _ in range(2)]
    alarms = [live.detect(rule) for live in streams]
    start = datetime(2024, 3, 31, 1, 30, tzinfo=ZoneInfo("Europe/Vienna"))
    time = [start + timedelta(minutes=int(5 * (k // 20) + k - 3 * (k == 40))) for k in range(60)]
    compare(*streams, (y[300:], u[300:]), {"time": time})
    onsets = [alarm.onsets() for alarm in alarms]
    assert onsets[0] == onsets[1] != []
    compare(*(Live(ARX(2, 2), K, lag=4) for _ in range(2)), (y, u), {"drift": np.linspace(0.5, 2.0, 60)})


def test_valid_ranges_with_and_without_inputs():
    y, u = arx_record(60, 6)
    for model, given, limits in ((ARX(2, 2), u, {"y": (-2, 2), "u": (None, 1)}), (ARX(2, 0), None, {"y": (-2, 2)})):
        streams = [Live(model, RLS(0.98), limits=limits) for _ in range(2)]
        compare(*streams, (y, given), {"time": late(60)})
        assert streams[0].outside == streams[1].outside != {}


def test_a_bank_with_known_probabilities_and_drifts():
    y, u = jumping(60, 5, (20, 40))
    bank = Bank(changes(), [Sensor.nominal(R)], reduce=Beam(9), p0=2.0)
    prob = np.full((60, 3), np.nan)
    prob[20], prob[31] = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    drift = np.random.default_rng(1).uniform(0.5, 2.0, (60, 3))
    compare(*(Live(Regression(N), bank) for _ in range(2)), (y, u), {"prob": prob, "drift": drift})


def test_steps_of_the_calendar_and_columns_by_name():
    y, u = arx_record(60, 6)
    months = pd.date_range("2020-01-31", periods=60, freq="ME", tz="America/New_York")
    months = months.delete([4, 5]).append(months[:2])
    table = pd.DataFrame({"other": u[::-1], "flow": u}, index=months)
    model = ARX(1, [1, 1], inputs=["flow", "other"])
    whole, parts = Live(model, K, dt="month"), Live(model, K, dt="month")
    got = whole.update_many(pd.Series(y, index=months), table, time=months)
    for t in range(60):
        y_hat, *_ = parts.update(y[t], {"other": u[59 - t], "flow": u[t]}, time=months[t])
        assert same(y_hat, got.prediction[t])
    assert whole.to_bytes() == parts.to_bytes()
    assert whole.ignored == 2


def test_what_is_refused_changes_nothing():
    live = Live(ARX(2, 2), K)
    y, u = arx_record(10, 1)
    live.update_many(y, u)
    before = live.to_bytes()
    for given, message in [
        ((y, None), "the model has 1 inputs, but u has shape \\(\\)"),
        ((y, np.ones((10, 2))), "the model has 1 inputs, but u has shape \\(10, 2\\)"),
        ((y, u[:5]), "y has 10 samples but u has shape"),
        ((y, u, np.arange(9.0)), "time has shape \\(9,\\), but y has 10 samples"),
        ((y, u, pd.date_range("2024", periods=10)), "with datetimes dt must be given"),
        ((y, u, None, np.full(10, -1.0)), "weights must be finite and not negative"),
        ((["a"] * 10, u), "is not a number"),
    ]:
        with pytest.raises(ValueError, match=message):
            live.update_many(*given)
        assert live.to_bytes() == before
    late_input = Live(ARX(2, 2), K)
    late_input.update(1.0)
    with pytest.raises(ValueError, match="has not been given yet"):
        late_input.update_many(y, u)

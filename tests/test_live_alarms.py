"""Alarms, forecasts and systems on a stream: those of `Track` on the record, bit for bit, also across a file."""

import pickle
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from support import arx_record, damaged, same

from driftfit import ARX, AugmentedFLS, Kalman, Live, Regression, track
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import lanes_of

K = Kalman(q=1e-4, r=0.01)
T, CUT, FAULT = 900, 500, 700


@pytest.fixture(scope="module")
def record():
    """Outages and bad values all along; the first gain grows from sample 700 on."""
    path = np.tile([1.2, -0.5, 1.0, 0.4], (T, 1))
    path[FAULT:, 2] += 0.5
    return damaged(*arx_record(T, 5, theta=path), share=0.02)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [("glr", {"reference": CUT}), ("band", {"reference": CUT}), ("band", {"reference": {"b1": (0.9, 1.1)}})],
    ids=["glr", "band", "band given"],
)
def test_a_stream_says_what_the_record_says(record, kind, settings):
    (y, u), tracker = record, K
    before = track(ARX(2, 2), tracker, y[:CUT], u[:CUT])
    rule = before.detect(kind, every=50.0, **settings).rule
    whole = track(ARX(2, 2), tracker, y, u)
    record_alarms = whole.detect(rule, start=CUT)
    if settings["reference"] == CUT:
        own = whole.detect(kind, every=50.0, **settings)
        assert own.rule == rule  # limits and reference are those of the first samples, whatever comes later
        assert same(own.active, record_alarms.active)
    assert FAULT - CUT > 100 > len(record_alarms.onsets) > 0
    live = Live(ARX(2, 2), tracker, warm_start=before)
    alarm = live.detect(rule)
    begun, onsets = [], []
    for t in range(CUT, T):
        live.update(y[t], u[t], time=float(t))
        if t % 60 == 0:
            live = pickle.loads(pickle.dumps(live)) if t % 120 else Live.from_bytes(live.to_bytes())
            (alarm,) = live.alarms
        assert alarm.active == record_alarms.active[t], t
        if alarm.active:
            assert same(alarm.statistic, record_alarms.statistic[t]), t
            assert alarm.cause == record_alarms.cause(t)
            now, then = alarm.change, record_alarms.change(t)
            assert same(now[1:4], then[1:4]) if kind == "glr" else now is then is None
        begun += [t] if alarm.begun else []
        onsets += alarm.onsets()
    assert begun == record_alarms.onsets.tolist()
    assert [onset.sample + CUT for onset in onsets] == begun
    assert [onset.time for onset in onsets] == [float(t) for t in begun]
    assert all(onset.statistic > onset.limit and onset.limit in rule.limits for onset in onsets)
    assert [onset.cause for onset in onsets] == [record_alarms.cause(t) for t in begun]
    assert alarm.onsets() == []
    many, causes = in_parts(before, whole, rule), []
    for found in many[1]:
        causes += found
    assert causes == [record_alarms.cause(t) if record_alarms.active[t] else None for t in range(CUT, T)]
    assert many[0].onsets() == [onset._replace(time=None) for onset in onsets]
    assert same(many[0].statistic, alarm.statistic)


@pytest.mark.parametrize("way", ["one by one", "many", "timed", "apply", "saved"])
def test_samples_of_an_alarm_count_from_the_start_of_the_stream(record, way):
    """A rule that is given to the stream at sample 500 says of onsets and changes what the record says."""
    y, u = record
    whole = track(ARX(2, 2), K, y, u)
    rule = whole.detect("glr", every=50.0, reference=CUT).rule
    record_alarms = whole.detect(rule, start=CUT)
    live = Live(ARX(2, 2), K)
    if way == "many":
        live.update_many(y[:CUT], u[:CUT])
    for t in range(live.samples, CUT):
        if way == "apply":
            live.update(y[t])
            live.apply(u[t])
        elif way == "timed":
            live.update(y[t], u[t], time=float(t))
            live.update(y[t], u[t], time=float(t))  # ignored
        else:
            live.update(y[t], u[t])
    alarm = live.detect(rule, wait=0)
    if way == "saved":
        live = Live.from_bytes(live.to_bytes())
        (alarm,) = live.alarms
    found = []
    for t in range(CUT, T):
        live.update(y[t], u[t], time=float(t) if way == "timed" else None)
        assert repr(alarm.change) == repr(record_alarms.change(t))
        found += [onset.sample for onset in alarm.onsets()]
    assert live.samples == T
    assert found == record_alarms.onsets.tolist() != []


def in_parts(before, whole, rule):
    """(an alarm that judges many samples at a time, what it says of them)."""
    program, tile = whole.program, whole.program.tile(before.end().states[0])
    run, out = program.loop(tile, T - CUT, "std", float, rule.kind == "glr")
    run(tile, *lanes_of(whole.record.part(slice(CUT, T))), out)
    alarm = LiveAlarm(rule, program.tracker, program.names)
    cuts = np.sort(np.random.default_rng(2).integers(0, T - CUT, 12))
    parts = zip(np.split(out, cuts), np.split(whole.y[CUT:], cuts), strict=True)
    return alarm, [alarm.take_many(part, 0, y, np.ones(len(y))) for part, y in parts]


def test_the_start_of_an_estimate_is_no_alarm(record):
    y, u = record
    rule = track(ARX(2, 2), K, y[:CUT], u[:CUT]).detect("band", every=20.0, reference=CUT).rule
    record_alarms = track(ARX(2, 2), K, y, u).detect(rule)
    assert record_alarms.start == 50
    live = Live(ARX(2, 2), K)
    alarm = live.detect(rule)
    active = []
    for t in range(T):
        live.update(y[t], u[t])
        active.append(alarm.active)
    assert same(active, record_alarms.active)
    assert FAULT < np.flatnonzero(active)[0] < FAULT + 50
    assert "on after" in repr(alarm) or "off after" in repr(alarm)


def test_alarms_of_several_outputs(record):
    y, u = record
    both = np.column_stack([y, 2.0 * y[::-1]])
    before = track(Regression(1, ny=("level", "flow")), K, both[:CUT], u[:CUT])
    kinds = {"level": "band", "flow": "glr"}
    rules = {name: before[name].detect(kind, every=30.0, reference=CUT).rule for name, kind in kinds.items()}
    whole = track(Regression(1, ny=("level", "flow")), K, both, u)
    live = Live(Regression(1, ny=("level", "flow")), K, warm_start=before)
    live.detect(rules)
    record_alarms = {name: whole[name].detect(rule, start=CUT) for name, rule in rules.items()}
    for t in range(CUT, CUT + 120):
        live.update(both[t], u[t])
        if t == CUT + 60:
            live = type(live).from_bytes(live.to_bytes())
        assert {name: alarm.active for name, alarm in live.alarms.items()} == {
            n: s.active[t] for n, s in record_alarms.items()
        }
    assert all(len(one.onsets) for one in record_alarms.values())
    ahead, whole = live.forecast(3, u[:3]), track(whole.model, K, both[: CUT + 120], u[: CUT + 120]).forecast(3, u[:3])
    assert ahead.table.drop("output").equals(whole.table.drop("output"))
    with pytest.raises(ValueError, match=r"by the name of their output; got \['speed'\]"):
        live.detect({"speed": rules["flow"]})


def test_forecast_and_system_are_those_of_the_record(record):
    y, u = record
    run, live = track(ARX(2, 2), K, y, u), Live(ARX(2, 2), K)
    for t in range(T):
        live.update(y[t], u[t])
    live.hold()  # an order to the next samples, not to the forecast
    assert live.forecast(5, u[:5]).table.equals(run.forecast(5, u[:5]).table)
    assert np.isnan(live.forecast(2).y_hat[1])
    with pytest.raises(ValueError, match="2 columns"):
        live.forecast(3, np.ones((3, 2)))
    system = live.system
    assert same(system.poles(), run.poles(-1)[0])
    for name in ("largest_pole", "dc_gain"):
        for now, then in zip(getattr(system, name)(), getattr(run, name)(-1), strict=True):
            assert same(now, then[0]), name
            assert np.isfinite(now).all()
    for name in ("step_response", "impulse_response"):
        assert all(same(a, b[0]) for a, b in zip(getattr(system, name)(6), getattr(run, name)(6), strict=True))
    now, then = system.frequency_response([0.1, 1.0]), run.frequency_response([0.1, 1.0])
    assert all(same(a, b if a.shape == b.shape else b[0]) for a, b in zip(now, then, strict=True))
    assert system.long_run() == run.long_run()
    assert same(system.to_scipy().den, run.to_scipy().den)
    with pytest.raises(ValueError, match="belong to runs of ARX"):
        _ = Live(Regression(1), K).system


def test_references_in_times():
    y, u = arx_record(400, 3)
    start = datetime(2024, 3, 1)
    hours = [start + timedelta(hours=t) for t in range(400)]
    plain = track(ARX(2, 2), K, y, u)
    dated = track(ARX(2, 2), K, y, u, time=hours, dt=timedelta(hours=1))
    expected = plain.detect("band", reference=(96, 240))
    assert expected.start == 240
    assert expected.rule.low == tuple(plain.theta[96:240].min(axis=0).tolist())
    assert plain.detect("band", reference=(0, 240)).rule == plain.detect("band", reference=240).rule
    for given in (
        ("2024-03-05", "2024-03-11"),
        (hours[96], hours[240]),
        (np.datetime64("2024-03-05"), np.datetime64("2024-03-11T00:00")),
        (hours[96].date(), hours[240].replace(tzinfo=UTC)),
        (96, 240),
        [hours[95] + timedelta(minutes=1), hours[239] + timedelta(minutes=1)],
    ):
        assert dated.detect("band", reference=given).rule == expected.rule, given
    seconds = track(ARX(2, 2), K, y, u, time=10.0 * np.arange(400), dt=10.0)
    assert seconds.detect("band", reference=(960.0, 2400.0)).rule == expected.rule
    assert plain.detect("band", reference=400).start == 400  # a rule may be made of the whole record
    for wrong, match in (
        (("2024-03-05", "2024-03-05 04:00"), "at least 20 are needed"),
        (("2025-03-05", "2025-04-05"), "0 remain, and at least 20 are needed"),
        (("in March", "2024-03-05"), "must be a date or a datetime, or None; got 'in March'"),
        ((1, 2, 3), "or an interval"),
    ):
        with pytest.raises(ValueError, match=match):
            dated.detect("band", reference=wrong)
    with pytest.raises(ValueError, match="must be a number, or None; got '2024-03-05'"):
        plain.detect("band", reference=("2024-03-05", "2024-03-11"))


def test_a_reference_in_local_time():
    import polars as pl

    y, u = arx_record(300, 3)
    local = pl.datetime_range(
        datetime(2024, 1, 1), datetime(2024, 1, 13, 11), "1h", time_zone="Europe/Berlin", eager=True
    )
    data = pl.DataFrame({"t": local, "y": y, "u": u})
    run = track(ARX(2, 2), K, "y", "u", data=data, time="t", dt=timedelta(hours=1))
    record_alarms = run.detect("band", reference=("2024-01-04", "2024-01-08"))
    assert record_alarms.start == 7 * 24
    assert record_alarms.rule.low == tuple(run.theta[3 * 24 : 7 * 24].min(axis=0).tolist())


def test_rules_are_plain_settings_and_fit_what_they_watch():
    y, u = arx_record(300, 3)
    run = track(ARX(2, 2), K, y, u)
    rule = run.detect(reference=200, records=8).rule
    assert AlarmRule.from_settings(rule.settings()) == rule
    assert hash(AlarmRule.from_settings(rule.settings())) == hash(rule)
    assert "one false alarm in 10000 samples, limits one parameter" in repr(rule)
    live = Live(ARX(2, 2), K)
    for wrong in (run.detect("band", reference=200), "band", None):
        with pytest.raises(TypeError, match=r"detect\(reference=500\).rule"):
            live.detect(wrong)
    with pytest.raises(ValueError, match="wait"):
        live.detect(rule, wait=-1)
    band = run.detect("band", reference={"b2": (0.0, 1.0)}).rule
    with pytest.raises(ValueError, match="no parameter 'b2'"):
        Live(ARX(1, 1), K).detect(band)
    blind = track(ARX(2, 2), AugmentedFLS(mu=10.0), y, u)
    with pytest.raises(ValueError, match="no covariance"):
        LiveAlarm(band, AugmentedFLS(1.0), run.names)
    with pytest.raises(ValueError, match="no covariance"):
        blind.detect("band", reference={"b2": (0.0, 1.0)})
    assert live.alarms == ()

"""What a worker of Spark runs, without Spark: pieces of a table, batches of a stream, one unit with keyed state."""

import json
import pickle
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from spark_support import HOLD, KINDS, MODEL, PAIR, ByHand, K, arriving, fleet_of, flow_of, packed, rows_of, task_of
from support import same

from driftfit import AdaptiveKalman, Kalman, Live, track
from driftfit.bridges import spark
from driftfit.bridges.spark import units as tasks
from driftfit.bridges.spark.batch import Partition, schema_of
from driftfit.bridges.spark.frames import java, missing
from driftfit.bridges.spark.keyed import Unit

TYPES = {"unit": pa.string(), **dict.fromkeys(("t", "y", "flow", "pressure", "u"), pa.float64())}


def pieces_of(rows, task, kind):
    """(the sizes of the pieces of a partition, its results)."""
    batches = rows.to_arrow().cast(pa.schema([(name, TYPES[name]) for name in rows.columns])).to_batches(30)
    kinds = KINDS | dict.fromkeys(task.y, "double")
    part, sizes, found = Partition(task, kind, schema_of(task, kinds, kind)), [], []
    for table, more in tasks.chunks(iter(batches), ("unit",), parts=kind != "verdict"):
        sizes.append(table.num_rows)
        found += [pl.from_arrow(one) for one in part.run(table, more)]
    return sizes, pl.concat(found)


@pytest.mark.parametrize("model", [MODEL, PAIR])
def test_a_unit_is_run_in_parts(monkeypatch, model):
    """A piece ends where a unit ends; a longer unit is cut, and goes on from its state."""
    monkeypatch.setattr(tasks, "ROWS", 100)
    long = rows_of(1, 2, 900, y=model.outputs).with_columns(unit=pl.lit("z"))
    rows = pl.concat([rows_of(6, 1, 60, y=model.outputs), long]).sort("unit", "t")
    fleet = fleet_of(rows, model=model)
    sizes, samples = pieces_of(rows, task_of(model), "samples")
    assert max(sizes) < 130
    assert samples.select(fleet.to_table().columns).equals(fleet.to_table())
    _, states = pieces_of(rows, task_of(model), "states")
    assert {unit: state[24:] for unit, state in states.select("unit", "state").rows()} == packed(fleet)


def test_outputs_have_a_summary_each():
    rows = rows_of(3, 1, 90, y=PAIR.outputs).sort("unit", "t")
    fleet = fleet_of(rows, model=PAIR)
    _, found = pieces_of(rows, task_of(PAIR), "verdict")
    for unit, run in fleet.series().items():
        (one,) = found.filter(pl.col("unit") == unit).to_dicts()
        assert one["used"] == int(run.ok.any(axis=1).sum())
        for j, name in enumerate(PAIR.outputs):
            judged = run.ok[:, j] & np.isfinite(run.innovation_std[:, j])
            e = run.innovation[judged, j]
            assert one[f"rms[{name}]"] == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-12)
            message = run[name].verdict()
            assert same([one[f"p[{name}]"], one[f"theta_{run.names[j][1]}"]], [message.p, run.theta[-1, j, 1]])
            assert (one[f"drifts[{name}]"], one[f"pays[{name}]"]) == (message.drifts, message.pays)


@pytest.mark.parametrize("model", [MODEL, PAIR])
def test_what_waits_is_processed_when_a_unit_ends(model):
    """Rows that arrive later begin the unit again; a unit with rows does not end, however old they are."""
    rows = rows_of(4, 4, 50, y=model.outputs)
    stream = ByHand(model)
    for part in arriving(rows, 3):
        stream.batch(part)
    new = rows.head(1).with_columns(t=pl.lit(400.0), unit=pl.lit("new"))
    slow = rows.filter(pl.col("unit") == "2")
    later = slow.with_columns(pl.col("t") + slow["t"].max() + 1.0)
    stream.batch(pl.concat([new, later]), expired=300.0)
    assert sorted(stream.rows("expired")["unit"]) == ["0", "1", "3"]
    stream.batch(new.with_columns(t=pl.lit(401.0)), expired=300.0)
    every = pl.concat([rows.filter(pl.col("unit") != "2"), slow, later])
    fleet = fleet_of(every, model=model)
    expected = fleet.to_table().sort("unit", "t")
    assert stream.rows().filter(pl.col("unit") != "new").select(expected.columns).equals(expected)
    ended = stream.rows("expired")
    assert ended["unit"].to_list() == ["0", "1", "2", "3"]
    assert {unit: state[24:] for unit, state in ended.select("unit", "state").rows()} == packed(fleet)
    assert list(stream.states()) == ["new"]
    again = rows.filter(pl.col("unit") == "0")
    stream.batch(again, expired=300.0)
    found = stream.found["result"][-1].filter(pl.col("unit") == "0").select(expected.columns)
    assert found.equals(expected.filter(pl.col("unit") == "0").head(len(found)))
    assert (list(stream.states()), len(found)) == (["0", "new"], int((again["t"] <= again["t"].max() - HOLD).sum()))


def test_outputs_have_alarms_each():
    rows = rows_of(2, 6, 600, y=PAIR.outputs)
    y, u = 0.1 * np.random.default_rng(1).normal(size=(400, 2)), np.random.default_rng(2).normal(size=400)
    reference = track(PAIR, K, y, u)
    rule = reference["pressure"].detect(every=20.0, reference=300).rule
    stream = ByHand(PAIR, rules=(None, rule), hold=0.0)
    for part in np.array_split(np.arange(len(rows)), 3):
        stream.batch(rows[part])
    found = stream.rows()
    assert "alarm[flow]" not in found.columns
    for unit in "01":
        live, on = Live(PAIR, K), []
        alarm = live.detect({"pressure": rule})["pressure"]
        for flow, pressure, u, t in rows.filter(pl.col("unit") == unit).select("flow", "pressure", "u", "t").rows():
            live.update([flow, pressure], u, time=t)
            on.append(alarm.active)
        assert found.filter(pl.col("unit") == unit)["alarm[pressure]"].to_list() == on
    assert found["alarm[pressure]"].any()


@pytest.mark.parametrize("model", [MODEL, PAIR])
def test_states_survive_other_settings(model):
    rows = rows_of(5, 7, 40, y=model.outputs)
    first, rest = rows.filter(pl.col("t") < 20.0), rows.filter(pl.col("t") >= 20.0)
    other = replace(K, r=0.3)
    before = fleet_of(first, model=model)
    warm = {key: run for key, run in before.series().items() if key in rest["unit"]}
    expected = fleet_of(rest, other, model, warm).to_table().sort("unit", "t")
    old, stream = ByHand(model, hold=0.0), ByHand(model, other, hold=0.0, origins=(other, K))
    old.batch(first)
    stream.kept = list(old.kept)
    stream.batch(rest)
    assert stream.rows().select(expected.columns).equals(expected)
    foreign = ByHand(model, AdaptiveKalman(), hold=0.0, origins=())
    foreign.kept = list(old.kept)
    with pytest.raises(ValueError, match="a state of another model, tracker, gate, setting or version"):
        foreign.batch(rest)


def test_outputs_have_trackers_each():
    """In a table, in a stream and with keyed state; the results are those of `track` for one unit."""
    rows = rows_of(2, 7, 60, y=PAIR.outputs)
    own = {"flow": K, "pressure": replace(K, r=0.4)}
    _, table = pieces_of(rows.sort("unit", "t"), task_of(PAIR, own), "samples")
    stream, unit = ByHand(PAIR, own, hold=0.0), Unit(flow_of(task_of(PAIR, own), 0.0))
    for part in (rows.filter(pl.col("t") < 20.0), rows.filter(pl.col("t") >= 20.0)):
        stream.batch(part)
    assert stream.rows().select(table.columns).equals(table)
    state, keyed = None, []
    for key in "01":
        one = rows.filter(pl.col("unit") == key)
        run = track(PAIR, own, ["flow", "pressure"], "u", data=one, time="t")
        found = table.filter(pl.col("unit") == key)
        for j, names in enumerate(run.names):
            assert same(found.select(f"theta_{name}" for name in names), run.theta[:, j])
    for part in (one[:20], one[20:]):
        state, some = unit.step(state, part.select("t", "flow", "pressure", "u").rows())
        keyed += some
    assert pl.DataFrame(keyed).select(found.columns[1:-1]).equals(found[:, 1:-1])


def test_a_unit_whose_settings_go_wrong_keeps_its_state():
    """For one batch unit 1 has a wrong setting and unit 2 none; what waited goes on, no row is lost."""
    rows = rows_of(4, 7, 60)
    parts = [rows.filter(pl.col("t") // 12 == k) for k in range(int(rows["t"].max() // 12) + 1)]
    given = pl.DataFrame({"unit": list("0123"), "_set_r": [0.1, 0.2, 0.3, 0.4]})
    wrong = given.with_columns(_set_r=pl.Series([0.1, -1.0, None, 0.4]))
    stream = ByHand(tracker=Kalman(q=1e-4), settings=("r",))
    stream.batch(parts[0].join(given, on="unit"))
    before, states = stream.kept, stream.states()
    stream.batch(parts[1].join(wrong, on="unit"))
    for old, new in zip(before, stream.kept, strict=True):
        rest = pl.col("unit").is_in(["1", "2"])
        assert new.filter(rest).sort("unit", "t").equals(old.filter(rest).sort("unit", "t"))
    for part in parts[2:]:
        stream.batch(part.join(given, on="unit"))
    refused = stream.rows("late")
    reasons = dict(refused.select("unit", "failed").rows())
    assert reasons["1"].startswith("settings: Kalman: r must be finite and above 0; got -1")
    assert reasons["2"].startswith("settings: Kalman: r must be given")
    assert len(refused) == len(parts[1].filter(pl.col("unit").is_in(["1", "2"]))) > 0
    assert stream.rows("failed")["unit"].to_list() == ["1", "2"]
    assert len(refused) + len(stream.rows()) + len(stream.found["waiting"][-1]) == len(rows)
    used = rows.join(refused, on=["unit", "t"], how="anti")
    due = used.filter(pl.col("t") <= pl.col("t").max().over("unit") - HOLD)
    expected = fleet_of(due, {unit: Kalman(q=1e-4, r=r) for unit, r in given.rows()}).to_table().sort("unit", "t")
    assert stream.rows().select(expected.columns).equals(expected)

    # a tracker that lacks this setting, and does not say so before a unit has a row
    other = ByHand(tracker=AdaptiveKalman(), settings=("r",))
    other.kept = before
    new = parts[1].filter(pl.col("unit") == "1").with_columns(_set_r=0.1)
    other.batch(new, expired=-1.0)
    assert other.states() == states
    assert len(other.rows("late")) == len(new)
    other.batch(new.with_columns(unit=pl.lit("new")), expired=1e9)
    assert dict(other.rows("expired").select("unit", "state").rows()) == states
    assert len(other.rows("late")) == 2 * len(new) + len(before[0])


def test_a_setting_of_a_wrong_length_is_a_reason():
    task = task_of()
    for q in ([1.0, 2.0], []):
        assert "but the model has 4 parameters" in task.joint_for(json.dumps({"q": q}))


def test_a_unit_with_keyed_state_gives_what_the_sorted_table_gives():
    """With numbers and dates; it begins with a state, goes on with other settings, and ends with what waits."""
    rows = rows_of(1, 3, 80)
    y, u, t = (rows[name].to_numpy() for name in "yut")
    reference = track(MODEL, K, *np.random.default_rng(1).normal(size=(2, 400)))
    for dated in (False, True):
        rule = reference.detect(every=20.0, reference=300).rule
        hold = np.timedelta64(4, "s") if dated else HOLD
        task = replace(task_of(), dt="1s" if dated else None)
        time = (t * 1e6).astype("M8[us]") if dated else t
        unit, state, found = Unit(flow_of(task, hold, (rule,), time="timestamp" if dated else "double")), None, []
        order = np.argsort(t + np.random.default_rng(1).uniform(0.0, 3.5, len(t)), kind="stable")
        for part in np.array_split(order, 12):
            stamps = time[part].astype(int) if dated else time[part]
            given = list(zip(stamps.tolist(), y[part].tolist(), u[part].tolist(), strict=True))
            state, some = unit.step(state, [*given, given[0], (None, 1.0, 1.0)])
            found += some
        assert state["newest"] == t[-1] * (1e6 if dated else 1.0)
        *rest, end = unit.ended(state, "silent")
        assert 0 < len(rest) < 6
        found += rest
        fleet = fleet_of(rows)
        run = fleet["0"]
        assert end["state"][24:] == packed(fleet)["0"]
        good = [one for one in found if one["failed"] is None]
        for name, path in (("prediction", run.prediction), ("theta_b1[u]", run.theta[:, 2]), ("std_a1", run.std[:, 0])):
            assert same([one[name] for one in good], path)
        assert sorted({one["failed"] for one in found} - {None}) == ["at a repeated time", "without a time"]
        live, watch = Live(MODEL, K, dt="1s" if dated else None), []
        alarm = live.detect(rule)
        stamps = np.array([one["t"] for one in good]).astype("M8[us]") if dated else t
        for one, stamp in zip(good, stamps, strict=True):
            live.update(one["y"], one["u"], time=stamp)
            watch.append((alarm.active, alarm.cause if alarm.active else None))
        assert [(one["alarm"], one["cause"]) for one in good] == watch


def test_a_unit_with_keyed_state_continues_with_other_settings():
    rows = rows_of(1, 3, 80, y=PAIR.outputs)
    first, rest = rows[:30], rows[30:]
    other = replace(K, r=0.3)
    before = fleet_of(first, model=PAIR)
    run = fleet_of(rest, other, PAIR, dict(before.series()))["0"]
    old, new, foreign = (
        Unit(flow_of(task_of(PAIR, one), 0.0, origins=made)) for one, made in ((K, ()), (other, (K,)), (other, ()))
    )
    given = [part.select("t", "flow", "pressure", "u").rows() for part in (first, rest)]
    state, _ = old.step(None, given[0])
    _, found = new.step(state, given[1])
    assert same([one["theta_a1[flow<-flow]"] for one in found], run.theta[:, 0, 0])
    *_, ended = old.ended(state, "silent")
    counts = dict.fromkeys(("samples", "used", "without_time", "repeated", "late"))
    begun = new.begun({"state": ended["state"], "watch": None, "last": ended["t"], "newest": ended["t"], **counts})
    again = new.step(begun, given[1])[1]
    assert same([one["std_b1[pressure<-u]"] for one in again], run.std[:, 1, 2])
    with pytest.raises(ValueError, match="a state of another model, tracker, gate, setting or version"):
        foreign.step(state, given[1])


def test_a_flow_is_pickled_without_what_it_has_made():
    task = task_of()
    assert task.joint_for(None).programs[0].names == task.names[0]
    again = pickle.loads(pickle.dumps(flow_of(task)))
    assert again.task == task
    assert not again.task._made


def test_a_missing_requirement_is_reported(monkeypatch, tmp_path):
    """Tests of Spark are skipped with this sentence."""
    monkeypatch.setenv("JAVA_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "pyspark", SimpleNamespace(__version__="4.1.0"))
    assert java() == (None, None)
    assert "Spark needs Java 17 or 21, and no java is on the PATH" in missing()
    with pytest.raises(ImportError, match="Java 17 or 21"):
        spark.session()
    monkeypatch.setitem(sys.modules, "pyspark", SimpleNamespace(__version__="3.5.1"))
    assert "needs PySpark 4; this is 3.5.1" in missing()
    monkeypatch.setitem(sys.modules, "pyspark", None)
    assert missing() == "driftfit.bridges.spark needs PySpark: pip install driftfit[spark]"


def test_a_table_without_a_usable_unit_gives_reasons():
    rows = pl.DataFrame({"unit": ["a", None], "t": [None, 1.0], "y": [1.0, 1.0], "u": [1.0, 1.0]})
    for kind in ("samples", "summary", "verdict", "states"):
        _, found = pieces_of(rows.with_columns(pl.col("t").cast(pl.Float64)), task_of(), kind)
        assert found["failed"].to_list() == ["no row has a time", "rows without a unit"]
    stream = ByHand()
    stream.batch(rows)
    assert stream.found["failed"][0]["failed"].to_list() == ["rows without a unit"]
    late = pl.concat(stream.found["late"])
    assert late["failed"].to_list() == ["without a time", "rows without a unit"]


def test_units_have_a_gate():
    """Results are those of one machine, and a state of another gate is refused."""
    rows = rows_of(4, 3, 60).with_columns(y=pl.when(pl.col("t") == 30.0).then(9999.0).otherwise("y"))
    gated = replace(task_of(), gate=True)
    _, samples = pieces_of(rows.sort("unit", "t"), gated, "samples")
    fleet = track(MODEL, K, "y", "u", data=rows, by="unit", time="t", gate=True)
    assert sum(len(run.left_out) for run in fleet.values()) > 0
    assert samples.select(fleet.to_table().columns).equals(fleet.to_table())
    joint = gated.joint_for(None)
    with pytest.raises(ValueError, match="another model, tracker, gate"):
        task_of().joint_for(None).unpack(joint.start)

"""Spark: batch and streams give what `track` gives on one machine, bit for bit, also after a crash."""

import os
import warnings
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from support import same

from driftfit import ARX, Kalman, Live, track
from driftfit.bridges.spark.session import java, missing

if reason := missing():
    pytest.skip(reason, allow_module_level=True)

from driftfit.bridges import spark
from driftfit.bridges.spark import task as tasks
from driftfit.bridges.spark.flow import Flow

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:pyspark", "ignore::ResourceWarning")

MODEL, K = ARX(2, 2), Kalman(q=1e-4, r=0.1)
COLUMNS = {"y": "y", "u": "u", "by": "unit", "time": "t"}
HOLD = 4.0


@pytest.fixture(scope="module")
def session():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = spark.session(
            "local[2]", spark__sql__shuffle__partitions="2", spark__ui__enabled="false", spark__driver__memory="1g",
            spark__python__unix__domain__socket__enabled="true",
        )  # fmt: skip
        found.sparkContext.setLogLevel("OFF")
        yield found
        found.stop()


def rows_of(units=40, seed=0, most=40):
    """Units of unequal lengths with gaps and missing values; unit names read as numbers."""
    rng = np.random.default_rng(seed)
    length = rng.integers(1, most, units)
    N = int(length.sum())
    time = np.concatenate([np.cumsum(rng.choice([1.0, 2.5], T, p=[0.95, 0.05])) for T in length])
    y, u = 0.3 * rng.normal(size=N).cumsum(), rng.normal(size=N)
    y[rng.random(N) < 0.05], u[rng.random(N) < 0.02] = np.nan, np.nan
    return pl.DataFrame({"unit": np.repeat([str(k) for k in range(units)], length), "t": time, "y": y, "u": u})


def fleet_of(rows, tracker=K):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return track(MODEL, tracker, "y", "u", data=rows, by="unit", time="t")


def polars(frame):
    return pl.from_arrow(frame.toArrow()).sort("unit", "t")


def test_a_table_gives_what_one_machine_gives(session, tmp_path, monkeypatch):
    """A row twice, units without a time, without a name and with wrong settings; a unit that is cut into parts."""
    long = rows_of(1, 5, 3000).with_columns(unit=pl.lit("long"))
    rows = pl.concat([rows_of(), long])
    odd = pl.DataFrame({"unit": ["no time", None, "bad"], "t": [None, 1.0, 1.0], "y": [1.0] * 3, "u": [1.0] * 3})
    pl.concat([rows, rows.head(7), odd]).sample(fraction=1.0, shuffle=True, seed=1).write_parquet(tmp_path / "rows")
    settings = pl.DataFrame({"unit": ["3", "bad"], "r": [0.5, -1.0], "q": [None, [1e-3] * 4]},
                            schema_overrides={"q": pl.List(pl.Float64)})  # fmt: skip
    settings.write_parquet(tmp_path / "settings")
    frame, own = (session.read.parquet(str(tmp_path / name)) for name in ("rows", "settings"))
    fleet = fleet_of(rows, {key: replace(K, r=0.5) if key == "3" else K for key in rows["unit"].unique()})
    expected = fleet.to_table().sort("unit", "t")
    found = polars(spark.track(frame, MODEL, K, settings=own, **COLUMNS))
    failed = {unit: text for unit, text in found.filter(pl.col("failed").is_not_null()).select("unit", "failed").rows()}
    assert failed.pop("bad").startswith("settings: Kalman: r must be finite and above 0; got -1")
    assert failed == {"no time": "no row has a time", None: "rows without a unit"}
    good = found.filter(pl.col("failed").is_null()).drop("failed")
    assert good.columns == expected.columns
    assert good.equals(expected)
    ends = polars(spark.track(frame, MODEL, K, settings=own, outputs="verdict", arrays=True, **COLUMNS))
    ends = ends.filter(pl.col("failed").is_null())
    assert same(np.stack(ends["theta"].to_list()), [fleet[unit].theta[-1] for unit in ends["unit"]])
    assert ends["used"].to_list() == [int(fleet[unit].ok.sum()) for unit in ends["unit"]]
    assert (ends["repeated"].sum(), ends["p"].to_list()[-1]) == (7, fleet[ends["unit"][-1]].verdict().p)


def test_a_unit_is_run_in_parts(monkeypatch):
    """A piece ends where a unit ends; a longer unit is cut, and goes on from its state."""
    import pyarrow as pa

    from driftfit.bridges.spark.batch import Partition, schema_of

    monkeypatch.setattr(tasks, "ROWS", 100)
    rows = pl.concat([rows_of(6, 1, 60), rows_of(1, 2, 900).with_columns(unit=pl.lit("z"))]).sort("unit", "t")
    task = tasks.Task(MODEL, K, "y", ("u",), ("unit",), "t")
    kinds = {"unit": "string", "t": "double"}
    types = pa.schema({"unit": pa.string(), **dict.fromkeys("tyu", pa.float64())})
    batches = rows.to_arrow().cast(types).to_batches(30)
    sizes, tables = [], {kind: [] for kind in ("samples", "states")}
    for kind, parts in tables.items():
        part = Partition(task, kind, schema_of(task, kinds, kind))
        for table, more in tasks.chunks(iter(batches), ("unit",), parts=True):
            sizes.append(table.num_rows)
            parts += part.run(table, more)
    assert max(sizes) < 130
    fleet = fleet_of(rows)
    samples = pl.concat([pl.from_arrow(one) for one in tables["samples"]])
    assert samples.drop("failed").equals(fleet.to_table())
    for unit, state in pl.concat([pl.from_arrow(one) for one in tables["states"]]).select("unit", "state").rows():
        run = fleet[unit]
        assert state[24:] == run.program.pack(run._lane.tile, run._lane.lane)[24:]


def stream_of(session, folder, rows, files=3, seed=0):
    """Rows in the order in which they arrive, five per cent late but within the hold, as a stream of files."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    time = rows["t"].to_numpy()
    arrival = time + np.where(rng.random(len(time)) < 0.05, rng.uniform(0.0, 0.9 * HOLD, len(time)), 0.0)
    order = np.argsort(arrival, kind="stable")
    for i, part in enumerate(np.array_split(order, files)):
        pl.concat([rows[part], rows[part].head(3)]).write_parquet(folder / f"{i}.parquet")
        os.utime(folder / f"{i}.parquet", (1e9 + i, 1e9 + i))
    schema = "unit string, t double, y double, u double"
    return session.readStream.schema(schema).option("maxFilesPerTrigger", 1).parquet(str(folder))


def run(stream, tmp_path, tracker=K, **more):
    query = spark.follow(
        stream, MODEL, tracker, path=str(tmp_path / "out"), trigger={"availableNow": True}, **COLUMNS, **more
    )
    query.awaitTermination()
    assert query.exception() is None
    return spark.Store(stream.sparkSession, str(tmp_path / "out"))


def test_a_stream_gives_what_the_sorted_table_gives(session, tmp_path):
    """Rows out of order and twice; a batch that Spark runs again; an alarm; other settings from there on."""
    rows = rows_of(12, 3, 80)
    reference = track(MODEL, K, *np.random.default_rng(1).normal(size=(2, 400)))
    rule = reference.detect("glr", every=200.0, reference=300).rule
    seen = []
    stream = stream_of(session, tmp_path / "in", rows)
    store = run(stream, tmp_path, hold=HOLD, rule=rule, sink=lambda table, batch: seen.append((batch, table.count())))
    due = rows.filter(pl.col("t") <= pl.col("t").max().over("unit") - HOLD)
    fleet = fleet_of(due)
    expected = fleet.to_table().sort("unit", "t")
    found = polars(store.results())
    assert found.select(expected.columns).equals(expected)
    assert [batch for batch, _ in seen] == store.batches() == [0, 1, 2]
    assert sum(count for _, count in seen) == len(expected)
    assert polars(store.late())["failed"].to_list() == ["at a repeated time"] * 9
    unit = max(fleet, key=lambda key: len(fleet[key]))
    alarms = Live(MODEL, K)
    watch = alarms.detect(rule)
    own = due.filter(pl.col("unit") == unit).select("y", "u", "t").rows()
    on = [(alarms.update(y, u, time=t), watch.active)[1] for y, u, t in own]
    assert set(on) == {False, True}
    assert found.filter(pl.col("unit") == unit)["alarm"].to_list() == on
    states = {unit: state for unit, state in store.states().select("unit", "state").collect()}
    for key, one in fleet.items():
        assert bytes(states[key])[24:] == one.program.pack(one._lane.tile, one._lane.lane)[24:]

    # the last batch again, as after a crash: once complete, and once as if it had been cut off
    before = found.sort("batch", "unit", "t")
    for lost in (False, True):
        if lost:
            (tmp_path / "out" / "batch=2" / "_SUCCESS").unlink()
        (tmp_path / "out" / "checkpoint" / "commits" / "2").unlink()
        (tmp_path / "out" / "checkpoint" / "commits" / ".2.crc").unlink(missing_ok=True)
        again = run(stream, tmp_path, hold=HOLD, rule=rule)
        assert polars(again.results()).sort("batch", "unit", "t").equals(before)

    other = replace(K, r=0.3)
    with pytest.raises(ValueError, match=r"were made with Kalman\(q=0.0001, r=0.1\), not with .*migrate=True"):
        run(stream, tmp_path, other, hold=HOLD, rule=rule)
    more = rows.with_columns(pl.col("t") + 200.0)
    more.write_parquet(tmp_path / "in" / "9.parquet")
    migrated = run(stream, tmp_path, other, hold=HOLD, rule=rule, migrate=True)
    (last,) = (polars(migrated.results().where(f"unit = '{unit}' and batch = 3")),)
    held = rows.filter(pl.col("unit") == unit, pl.col("t") > pl.col("t").max() - HOLD)
    rest = pl.concat([held, more.filter(pl.col("unit") == unit)]).sort("t")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rest_run = track(MODEL, other, "y", "u", data=rest, time="t", warm_start=fleet[unit])
    assert same(last["theta_a1"].to_numpy(), rest_run.theta[: len(last), 0])


def test_a_stream_begins_with_states_and_ends_silent_units(session, tmp_path):
    rows = rows_of(6, 4, 60)
    first, rest = rows.filter(pl.col("t") < 20.0), rows.filter(pl.col("t") >= 20.0)
    late = pl.DataFrame({"unit": ["new"], "t": [500.0], "y": [1.0], "u": [1.0]})
    rest.write_parquet(tmp_path / "rest")
    first.write_parquet(tmp_path / "first")
    begin = spark.track(session.read.parquet(str(tmp_path / "first")), MODEL, K, outputs="states", **COLUMNS)
    (tmp_path / "in").mkdir()
    for i, part in enumerate((rest, late, late.with_columns(t=pl.lit(501.0)))):
        part.write_parquet(tmp_path / "in" / f"{i}.parquet")
        os.utime(tmp_path / "in" / f"{i}.parquet", (1e9 + i, 1e9 + i))
    schema = "unit string, t double, y double, u double"
    stream = session.readStream.schema(schema).option("maxFilesPerTrigger", 1).parquet(str(tmp_path / "in"))
    store = run(stream, tmp_path, initial=begin, expire=100.0)
    expected = fleet_of(rows).to_table().filter(pl.col("t") >= 20.0).sort("unit", "t")
    found = polars(store.results())
    assert found.filter(pl.col("unit") != "new").select(expected.columns).equals(expected)
    assert [row[0] for row in store.states().select("unit").collect()] == ["new"]
    assert store.read("expired").count() == rows["unit"].n_unique()


def test_what_cannot_run_is_said_before_any_job(session):
    frame = session.createDataFrame([("a", 0.0, 1.0, "x")], "unit string, t double, y double, u string")
    with pytest.raises(ValueError, match=r"u: column 'u' is of type string; .*cast\('double'\)"):
        spark.track(frame, MODEL, K, **COLUMNS)
    with pytest.raises(ValueError, match="there is no column 'flow'"):
        spark.track(frame, MODEL, K, **{**COLUMNS, "y": "flow"})
    with pytest.raises(ValueError, match="Kalman: q, r must be given"):
        spark.track(frame, MODEL, Kalman(), **{**COLUMNS, "u": "y"})
    with pytest.raises(ValueError, match="Data frames of Spark have no order"):
        spark.track(frame, MODEL, K, **{**COLUMNS, "time": None})
    dated = session.sql("select 'a' unit, timestamp'2024-01-01' t, 1.0d y, 1.0d u")
    with pytest.raises(ValueError, match="with datetimes dt must be given"):
        spark.track(dated, MODEL, K, **COLUMNS)
    kinds = dict(spark.track(dated, MODEL, K, dt="1min", **COLUMNS).dtypes)
    assert (kinds["t"], kinds["theta_a1"], kinds["failed"]) == ("timestamp", "double", "string")
    with pytest.raises(ValueError, match="hold must be a duration"):
        spark.follow(dated, MODEL, K, path="x", dt="1min", hold=3, **COLUMNS)


def test_what_is_missing_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("JAVA_HOME", str(tmp_path))
    assert java() == (None, None)
    assert "Spark needs Java 17 or 21, and no java is on the PATH" in missing()
    with pytest.raises(ImportError, match="Java 17 or 21"):
        spark.session()


def test_a_flow_is_pickled_without_what_it_has_made():
    import pickle

    task = tasks.Task(MODEL, K, "y", ("u",), ("unit",), "t")
    assert task.program.names == task.names
    again = pickle.loads(pickle.dumps(Flow(task, {}, 0.0)))
    assert again.task == task
    assert "program" not in vars(again.task)


def test_a_unit_with_keyed_state_gives_what_the_sorted_table_gives():
    """The step by itself, with numbers and dates."""
    from driftfit.bridges.spark.keyed import Unit

    rows = rows_of(1, 3, 80)
    y, u, t = (rows[name].to_numpy() for name in "yut")
    for dated in (False, True):
        hold = np.timedelta64(4, "s") if dated else HOLD
        task = tasks.Task(MODEL, K, "y", ("u",), ("unit",), "t", "1s" if dated else None)
        time = (t * 1e6).astype("M8[us]") if dated else t
        unit, state, found = Unit(task, hold, dated), None, []
        order = np.argsort(t + np.random.default_rng(1).uniform(0.0, 3.5, len(t)), kind="stable")
        for part in np.array_split(order, 12):
            stamps = time[part].astype(int) if dated else time[part]
            given = [("a", *row) for row in zip(stamps.tolist(), y[part].tolist(), u[part].tolist(), strict=True)]
            state, some = unit.step(state, [*given, given[0], ("a", None, 1.0, 1.0)])
            found += some
        run = fleet_of(rows)["0"]
        good = [one for one in found if "failed" not in one]
        assert len(good) > len(run) - 6
        for name, path in (("prediction", run.prediction), ("theta_b1[u]", run.theta[:, 2]), ("std_a1", run.std[:, 0])):
            assert same([one[name] for one in good], path[: len(good)])
        assert sorted({one["failed"] for one in found if "failed" in one}) == ["at a repeated time", "without a time"]
        assert len(state) < 1100


def test_a_stream_with_keyed_state_gives_what_the_sorted_table_gives(session, tmp_path):
    from pyspark.sql.group import GroupedData

    if not hasattr(GroupedData, "transformWithState"):
        pytest.skip("this PySpark has no keyed state for rows; 4.1 has it")
    session.conf.set("spark.sql.streaming.stateStore.providerClass",
                     "org.apache.spark.sql.execution.streaming.state.RocksDBStateStoreProvider")  # fmt: skip
    few = rows_of(3, 3, 60)
    keyed = spark.follow_keyed(stream_of(session, tmp_path / "in", few, files=2), MODEL, K, hold=HOLD, **COLUMNS)
    query = (
        keyed.writeStream.format("parquet").option("path", str(tmp_path / "out"))
        .option("checkpointLocation", str(tmp_path / "check")).trigger(availableNow=True).start()
    )  # fmt: skip
    query.awaitTermination()
    due = few.filter(pl.col("t") <= pl.col("t").max().over("unit") - HOLD)
    expected = fleet_of(due).to_table().sort("unit", "t")
    good = pl.read_parquet(tmp_path / "out" / "*.parquet").filter(pl.col("failed").is_null()).sort("unit", "t")
    assert good.select(expected.columns).equals(expected)

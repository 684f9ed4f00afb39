"""Spark: batch and streams give what `track` gives on one machine, bit for bit, also after a crash."""

import importlib
import os
import re
import textwrap
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from spark_support import COLUMNS, HOLD, MODEL, PAIR, K, arriving, fleet_of, packed, rows_of
from support import same

from driftfit import ARX, Kalman, Live, Regression, track
from driftfit.bridges import spark
from driftfit.bridges.spark.frames import missing

if reason := missing():
    pytest.skip(reason, allow_module_level=True)

PAGE = Path(__file__).parent.parent / "docs" / "spark.md"

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:pyspark", "ignore::ResourceWarning")


@pytest.fixture(scope="module")
def session():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = spark.session(
            "local[2]", spark__sql__shuffle__partitions="2", spark__ui__enabled="false", spark__driver__memory="1g",
            spark__python__unix__domain__socket__enabled="true", spark__sql__codegen__wholeStage="false",
            spark__driver__extraJavaOptions="-XX:TieredStopAtLevel=1 -XX:+UseSerialGC",  # half the CPU of short jobs
        )  # fmt: skip
        found.sparkContext.setLogLevel("OFF")
        yield found
        found.stop()


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
    assert ends["repeated"].sum() == 7
    own = [
        "unit",
        "p",
        "constant_ls",
        "coverage",
        "left_out",
        "untested",
    ]  # the rest depends on the rate of discoveries
    assert ends.select(own).sort("unit").equals(fleet.verdict().table.select(own).sort("unit"))


def stream_of(session, folder, parts):
    """Tables as a stream of files."""
    folder.mkdir()
    for i, part in enumerate(parts):
        part.write_parquet(folder / f"{i}.parquet")
        os.utime(folder / f"{i}.parquet", (1e9 + i, 1e9 + i))
    schema = ", ".join(f"{name} {'string' if name == 'unit' else 'double'}" for name in parts[0].columns)
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
    reference = track(MODEL, K, *np.random.default_rng(1).normal(scale=3.0, size=(2, 400)))
    rule = reference.detect("glr", every=200.0, reference=300).rule
    seen = []
    stream = stream_of(session, tmp_path / "in", arriving(rows, 3))
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
    for key, state in packed(fleet).items():
        assert bytes(states[key])[24:] == state

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


def begun(session, tmp_path, rows, model, columns):
    """(the states after the first rows, a stream of the others, the rows of a unit that lags).

    The stream has a unit that comes much later, too; those of the unit that lags come after it.
    """
    rows.filter(pl.col("t") < 20.0).write_parquet(tmp_path / "first")
    begin = spark.track(session.read.parquet(str(tmp_path / "first")), model, K, outputs="states", **columns)
    late = rows.head(1).with_columns(unit=pl.lit("new"), t=pl.lit(500.0))
    slow = rows.filter(pl.col("unit") == "0").with_columns(unit=pl.lit("slow"))
    parts = [rows.filter(pl.col("t") >= 20.0), late, late.with_columns(t=pl.lit(501.0))]
    parts = [parts[0], pl.concat([late, slow[:9]]), pl.concat([parts[2], slow[9:]])]
    return begin, stream_of(session, tmp_path / "in", parts), slow


def rest(rows, slow, model):
    """(the results, the states) of what the stream of `begun` has."""
    fleet = fleet_of(pl.concat([rows, slow]), model=model)
    table = fleet.to_table().filter((pl.col("t") >= 20.0) | (pl.col("unit") == "slow"))
    return table.sort("unit", "t"), packed(fleet)


def test_a_stream_begins_with_states_and_ends_silent_units(session, tmp_path):
    """Two outputs; what waits when a unit ends is processed, once."""
    columns = {**COLUMNS, "y": ["flow", "pressure"]}
    rows = rows_of(6, 4, 60, y=columns["y"])
    begin, stream, slow = begun(session, tmp_path, rows, PAIR, columns)
    more = {"trigger": {"availableNow": True}, "hold": HOLD, "initial": begin, "expire": 100.0}
    query = spark.follow(stream, ARX(1, 1, ny=2), K, path=str(tmp_path / "out"), **columns, **more)
    query.awaitTermination()
    store = spark.Store(session, str(tmp_path / "out"))
    expected, states = rest(rows, slow.filter(pl.col("t") <= pl.col("t").max() - HOLD), PAIR)
    found = polars(store.results())
    assert found.filter(pl.col("unit") != "new").select(expected.columns).equals(expected)
    going = {unit: bytes(state)[24:] for unit, state in store.states().select("unit", "state").collect()}
    assert (sorted(going), going["slow"]) == (["new", "slow"], states.pop("slow"))
    expired = {unit: bytes(state)[24:] for unit, state in store.read("expired").select("unit", "state").collect()}
    assert expired == states


def test_wrong_arguments_are_reported_before_any_job(session):
    frame = session.createDataFrame([("a", 0.0, 1.0, "x")], "unit string, t double, y double, u string")
    with pytest.raises(ValueError, match=r"u: column 'u' is of type string; .*cast\('double'\)"):
        spark.track(frame, MODEL, K, **COLUMNS)
    with pytest.raises(ValueError, match="there is no column 'flow'"):
        spark.track(frame, MODEL, K, **{**COLUMNS, "y": "flow"})
    with pytest.raises(ValueError, match="Several outputs need ny= in the model"):
        spark.track(frame, MODEL, K, **{**COLUMNS, "y": ["y", "t"]})
    with pytest.raises(ValueError, match="share one theta are not followed on Spark"):
        spark.track(frame, Regression(1, ny=2, shared=True), K, **COLUMNS)
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


def test_a_stream_with_keyed_state_gives_what_the_sorted_table_gives(session, tmp_path):
    from pyspark.sql.group import GroupedData

    if not hasattr(GroupedData, "transformWithState"):
        pytest.skip("this PySpark has no keyed state for rows; 4.1 has it")
    session.conf.set("spark.sql.streaming.stateStore.providerClass",
                     "org.apache.spark.sql.execution.streaming.state.RocksDBStateStoreProvider")  # fmt: skip
    rows = rows_of(3, 3, 60)
    begin, stream, slow = begun(session, tmp_path, rows, MODEL, COLUMNS)
    keyed = spark.follow_keyed(stream, MODEL, K, hold=HOLD, initial=begin, expire=100.0, **COLUMNS)
    query = (
        keyed.writeStream.format("parquet").option("path", str(tmp_path / "out"))
        .option("checkpointLocation", str(tmp_path / "check")).trigger(availableNow=True).start()
    )  # fmt: skip
    query.awaitTermination()
    expected, states = rest(rows, slow, MODEL)
    found = pl.read_parquet(tmp_path / "out" / "*.parquet").sort("unit", "t")
    assert found.filter(pl.col("failed").is_null()).select(expected.columns).equals(expected)
    expired = found.filter(pl.col("failed") == "silent for too long").select("unit", "state").rows()
    assert [unit for unit, _ in expired] == ["0", "1", "2", "slow"]
    assert {unit: state[24:] for unit, state in expired} == states


def test_the_chapter_is_followed_word_by_word(session, tmp_path, capsys):
    """Its first section, from the Parquet file to the table that it shows; Java stays in the folder where it began."""
    chapter = PAGE.read_text().split("\n## ")[1]
    blocks = re.findall(r"(?:^    .*\n|^\n)+", re.sub(r"```.*?```", "", chapter, flags=re.S), re.M)
    code = "".join(textwrap.dedent(one) for one in blocks if re.match(r"\s*(import|from) ", one))
    code = code.replace('"readings.parquet"', repr(str(tmp_path / "readings.parquet")))
    exec(compile(code, PAGE.name, "exec"), {})
    (table,) = re.findall(r"```text\n(.*?)```", chapter, re.S)
    assert capsys.readouterr().out.split() == table.split()


@pytest.mark.filterwarnings("ignore:time. .* rows repeat:driftfit.DataWarning")
def test_benchmarks_run_quickly(session, capsys):
    """Those of streams; `benchmarks/spark_kill.py --quick` kills processes, and can wait for minutes afterwards."""
    costs = importlib.import_module("benchmarks.spark").main
    costs(True, "equal")
    costs(True, "streams")
    assert "0 of 11 columns differ" in capsys.readouterr().out

"""Sessions and data frames of Spark: which columns a task reads, checked before any job runs, and what is missing."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from driftfit.bridges.spark.units import SETTING, Task, results_schema, trackers_of
from driftfit.data.arguments import check_roles
from driftfit.data.arrays import named_outputs
from driftfit.engine.settings import near
from driftfit.models.base import Model

KEYS = ("string", "tinyint", "smallint", "int", "bigint", "date", "timestamp", "boolean")
"""Types of columns that identify units."""
NUMBERS = ("tinyint", "smallint", "int", "bigint", "float", "double", "decimal", "boolean")
TIMES = ("timestamp", "timestamp_ntz", "date", "tinyint", "smallint", "int", "bigint", "float", "double")


def task_of(
    df: Any, model: Model, tracker: Any, columns: Mapping[str, Any], dt: Any, settings: Any, arrays: bool,
    gate: Any = None,
) -> Task:  # fmt: skip
    """The task for a data frame; ``columns`` are y, u, by and time. ValueError for what cannot run."""
    if problem := missing():
        raise ImportError(problem)
    check_roles("track", model, tracker, several=True)
    if model.shared:
        raise ValueError("spark: outputs that share one theta are not followed on Spark; leave out shared=True.")
    names = {name: _names(name, columns[name]) for name in ("y", "u", "by", "time")}
    if len(names["time"]) != 1:
        raise ValueError(
            f"spark: time= is the name of one column; got {columns['time']!r}. Data frames of Spark have no order, so "
            "samples need a time."
        )
    if len(names["y"]) != len(model.outputs):
        raise ValueError(
            f"spark: y= names the columns of the model's outputs, which are {', '.join(model.outputs)}; got "
            f"{columns['y']!r}. Several outputs need ny= in the model, as in ARX(2, 2, ny=2)."
        )
    if len(names["y"]) > 1:
        model, place = named_outputs(model, names["y"])
        names["y"] = tuple(names["y"][j] for j in place)
        if isinstance(tracker, Mapping) and set(tracker) == set(names["y"]):
            tracker = {name: tracker[name] for name in names["y"]}
    if not names["by"]:
        raise ValueError("spark: by= names the columns that identify units; a single series runs on one machine.")
    kinds = dict(df.dtypes)
    for argument, allowed in (("by", KEYS), ("time", TIMES), ("y", NUMBERS), ("u", NUMBERS)):
        for name in names[argument]:
            if name not in kinds:
                raise ValueError(f"spark: {argument}: there is no column {name!r}: {near(name, list(kinds))}")
            if kinds[name].partition("(")[0] not in allowed:
                raise ValueError(
                    f"spark: {argument}: column {name!r} is of type {kinds[name]}; it must be one of "
                    f"{', '.join(allowed)}. Cast it first: df.withColumn({name!r}, F.col({name!r}).cast('double'))."
                )
    kind = kinds[names["time"][0]]
    dated = kind in ("timestamp", "timestamp_ntz", "date")
    zone = df.sparkSession.conf.get("spark.sql.session.timeZone") if kind == "timestamp" else None
    own = () if settings is None else _settings(settings, tracker, names["by"])
    task = Task(model, tracker, names["y"], names["u"], names["by"], names["time"][0], dt, zone, own, arrays, gate)
    task.clock.steps(np.array([0, 1], "M8[us]") if dated else np.array([0.0, 1.0]))
    if not own:
        task.joint_of(None, tracker)
    used = [*names["by"], *names["time"], *names["y"], *names["u"]]
    results = [*used, *results_schema(task), "failed"]
    if twice := [name for name in dict.fromkeys(results) if results.count(name) > 1]:
        raise ValueError(f"spark: the table of results would have {twice[0]!r} twice; rename that column first.")
    return task


def _names(argument: str, value: Any) -> tuple[str, ...]:
    given = () if value is None else (value,) if isinstance(value, str) else tuple(value)
    if not all(isinstance(name, str) for name in given):
        raise ValueError(f"spark: {argument}= takes names of columns; got {value!r}.")
    return given


def _settings(settings: Any, tracker: Any, by: Sequence[str]) -> tuple[str, ...]:
    """The settings that a table gives for every unit."""
    one = trackers_of(tracker)[0]
    known = [field.name for field in fields(one) if field.init]  # type: ignore[arg-type]
    own = [name for name in settings.columns if name not in by]
    if wrong := [name for name in by if name not in settings.columns]:
        raise ValueError(f"spark: the table of settings has no column {wrong[0]!r}, by which units are found.")
    if wrong := [name for name in own if name not in known]:
        raise ValueError(f"spark: {type(one).__name__} has no setting {wrong[0]!r}: {near(wrong[0], known)}")
    kinds = dict(settings.dtypes)
    for name in own:
        if kinds[name].replace("array<", "").rstrip(">").partition("(")[0] not in (*NUMBERS, "string", "void"):
            raise ValueError(
                f"spark: the setting {name!r} is of type {kinds[name]}; it must be a number, a string or an array of "
                "numbers."
            )
    return tuple(own)


def rows_of(df: Any, task: Task, settings: Any) -> Any:
    """The columns that the task reads, with the settings of every unit."""
    from pyspark.sql import functions as F  # noqa: N812  (as everybody calls it)

    kind = dict(df.dtypes)[task.time]
    to = "timestamp_ntz" if kind == "date" else kind if kind.startswith("timestamp") else "double"
    columns = [*(F.col(name) for name in task.by), F.col(task.time).cast(to).alias(task.time)]
    columns += [F.col(name).cast("double").alias(name) for name in (*task.y, *task.u)]
    rows = df.select(*columns)
    if settings is None:
        return rows
    own = [F.col(name).alias(SETTING + name) for name in task.settings]
    return rows.join(settings.select(*task.by, *own), on=list(task.by), how="left")


OLDEST_JAVA = 17
"""The oldest version of Java with which PySpark 4 runs; 21 is the newest."""


def java() -> tuple[str | None, int | None]:
    """(the path of Java, its version); None where there is none."""
    home = os.environ.get("JAVA_HOME")
    path = shutil.which("java", path=os.path.join(home, "bin")) if home else shutil.which("java")
    if path is None:
        return None, None
    printed = subprocess.run([path, "-version"], capture_output=True, text=True, check=False).stderr
    found = re.search(r'version "(\d+)', printed)
    return path, int(found[1]) if found else None


def missing() -> str:
    """What is missing to run Spark here, in a sentence; empty if nothing is."""
    try:
        import pyspark
    except ImportError:
        return "driftfit.bridges.spark needs PySpark: pip install driftfit[spark]"
    if int(pyspark.__version__.split(".")[0]) < 4:
        return f"driftfit.bridges.spark needs PySpark 4; this is {pyspark.__version__}: pip install driftfit[spark]"
    path, version = java()
    if path is None:
        return (
            "Spark needs Java 17 or 21, and no java is on the PATH or in JAVA_HOME: install it, as by "
            "apt-get install openjdk-17-jre-headless."
        )
    if version is not None and version < OLDEST_JAVA:
        return f"Spark needs Java 17 or 21; {path} is version {version}. Install one and set JAVA_HOME."
    return ""


def session(master: str = "local[2]", **settings: Any) -> Any:
    """A session of Spark, with what suits this package.

    Parameters
    ----------
    master : str
        Where it runs; "local[2]" is two cores of this computer.
    settings : str
        Further settings of Spark, with "__" in place of dots: ``spark__driver__memory="4g"``.

    Raises
    ------
    ImportError
        If PySpark or Java is missing or too old.
    """
    if problem := missing():
        raise ImportError(problem)
    from pyspark.sql import SparkSession

    builder = SparkSession.builder.master(master).appName("driftfit")
    given = {name.replace("__", "."): value for name, value in settings.items()}
    usual = {
        "spark.sql.session.timeZone": "UTC",
        "spark.ui.showConsoleProgress": "false",
        "spark.sql.shuffle.partitions": "8",
        "spark.sql.execution.arrow.maxRecordsPerBatch": "32000",
        "spark.sql.maxConcurrentOutputFileWriters": "8",  # a batch is written by kind without being sorted again
    }
    if master.startswith("local"):  # the workers are this interpreter, whichever comes first on the PATH
        os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
    for name, value in {**usual, **given}.items():
        builder = builder.config(name, value)
    return builder.getOrCreate()


def sql_of(schema: Mapping[str, str]) -> str:
    """Names and types of columns, as Spark reads them."""
    return ", ".join(f"`{name}` {kind}" for name, kind in schema.items())


def by_unit(rows: Any, task: Task, work: Any, schema: Mapping[str, str], first: Sequence[str] = ()) -> Any:
    """What ``work`` makes of the rows of each partition: those of a unit are together, in the order of the columns
    ``first``, of time and of signals.
    """
    order = [*task.by, *first, task.time, *task.y, *task.u]
    return rows.repartition(*task.by).sortWithinPartitions(*order).mapInArrow(work, sql_of(schema))

"""The table of a stream: a folder for each batch, with its results and the states after it, in one write.

    PATH/batch=17/kind=result/*.parquet     a row per sample
                 /kind=late                 rows that came too late, twice, without a time or to a unit that cannot run,
                                            with the reason
                 /kind=failed               units that cannot run, with the reason
                 /kind=expired              states of units that were silent for too long
                 /kind=state, kind=waiting  what the next batch begins with
                 /_SUCCESS                  written last: without it the batch does not exist
    PATH/programs/0, 1, ..                  model and tracker of the states, each time that they changed
    PATH/checkpoint                         Spark's own

Batch i reads the states of the batch before and writes its own folder, so doing it again changes nothing.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

KINDS = ("result", "late", "failed", "expired", "state", "waiting")
"""Kinds of rows."""
NEXT = ("state", "waiting")
"""Those that the next batch reads."""


class Store:
    """The table of a stream.

    Parameters
    ----------
    spark : pyspark.sql.SparkSession
    path : str
        A folder in any file system that Spark reads and writes.
    """

    def __init__(self, spark: Any, path: str) -> None:
        self.spark, self.path = spark, path.rstrip("/")
        self._newest: dict[str, Any] | None = None
        """What `begin` noted last; reading it is a job."""

    def __repr__(self) -> str:
        return f"Store({self.path!r}): {len(self.batches())} batches"

    def _folder(self, *parts: str) -> tuple[Any, Any]:
        """(the file system, a path in it)."""
        path = self.spark._jvm.org.apache.hadoop.fs.Path("/".join([self.path, *parts]))
        return path.getFileSystem(self.spark._jsc.hadoopConfiguration()), path

    def _names(self, *parts: str) -> list[str]:
        files, path = self._folder(*parts)
        return [one.getPath().getName() for one in files.listStatus(path)] if files.exists(path) else []

    def has(self, batch: int) -> bool:
        return "_SUCCESS" in self._names(f"batch={batch}")

    def batches(self) -> list[int]:
        """The batches that are complete, in order."""
        found = [int(name.removeprefix("batch=")) for name in self._names() if name.startswith("batch=")]
        return sorted(batch for batch in found if self.has(batch))

    def write(self, table: Any, batch: int) -> None:
        """Write a batch, completely or not at all."""
        table.write.partitionBy("kind").mode("overwrite").parquet(f"{self.path}/batch={batch}")

    def read(self, *kinds: str, batches: Sequence[int] | None = None) -> Any:
        """The rows of some kinds, of all complete batches or of some, with the columns that these kinds have.

        Raises
        ------
        ValueError
            If there is no such batch, or no such kind.
        """
        from pyspark.sql import functions as F  # noqa: N812

        if wrong := [kind for kind in kinds if kind not in KINDS]:
            raise ValueError(f"Store.read: {wrong[0]!r} is none of the kinds {', '.join(KINDS)}.")
        found = self.batches() if batches is None else list(batches)
        if not found:
            raise ValueError(f"Store.read: {self.path} has no complete batch.")
        reader = self.spark.read.schema(self.schema()).option("basePath", self.path)
        rows = reader.parquet(*(f"{self.path}/batch={batch}" for batch in found))
        return rows.where(F.col("kind").isin(*kinds))

    def results(self) -> Any:
        """The results of all complete batches: a row per sample."""
        columns = self.schema_of("results")
        return self.read("result").select("batch", *columns)

    def states(self, batch: int | None = None) -> Any:
        """The states after a batch, the last one by default: a row per unit."""
        last = self.batches()[-1] if batch is None else batch
        return self.read("state", batches=[last]).select(*self.schema_of("states"))

    def late(self) -> Any:
        """Rows that were left out, with the reason."""
        return self.read("late").select("batch", *self.schema_of("rows"), "failed")

    def forget(self, before: int) -> None:
        """Delete the states of batches before this one; their results stay."""
        for batch in self.batches():
            if batch < before:
                for kind in NEXT:
                    files, path = self._folder(f"batch={batch}", f"kind={kind}")
                    if files.exists(path):
                        files.delete(path, True)

    def begin(self, about: dict[str, Any]) -> None:
        """Note model, tracker and columns of what follows."""
        count = len([name for name in self._names("programs") if name.isdigit()])
        text = json.dumps(about, sort_keys=True)
        frame = self.spark.createDataFrame([(text,)], "value string").coalesce(1)
        frame.write.mode("overwrite").text(f"{self.path}/programs/{count}")
        self._newest = about

    def abouts(self) -> list[dict[str, Any]]:
        """What `begin` noted, the oldest first."""
        names = sorted((name for name in self._names("programs") if name.isdigit()), key=int)
        rows = [self.spark.read.text(f"{self.path}/programs/{name}", wholetext=True).first() for name in names]
        return [json.loads(row[0]) for row in rows if row is not None]

    def schema(self) -> str:
        return str(self._about()["schema"])

    def schema_of(self, what: str) -> list[str]:
        """The columns that "results", "states" or "rows" have."""
        return list(self._about()[what])

    def _about(self) -> dict[str, Any]:
        if self._newest is None:
            found = self.abouts()
            if not found:
                raise ValueError(f"{self.path} is not the table of a stream: driftfit.bridges.spark.follow makes one.")
            self._newest = found[-1]
        return self._newest

"""Fleets for the tests of Spark, and batches of a stream without Spark."""

import warnings
from dataclasses import replace

import numpy as np
import polars as pl
import pyarrow as pa

from driftfit import ARX, Kalman, track
from driftfit.bridges.spark.batch import NEW, OLD, WAITED, Flow
from driftfit.bridges.spark.units import ARROW, SETTING, Task
from driftfit.run import layout

MODEL, K = ARX(2, 2), Kalman(q=1e-4, r=0.1)
PAIR = ARX(1, 1, ny=("flow", "pressure"))
COLUMNS = {"y": "y", "u": "u", "by": "unit", "time": "t"}
HOLD = 4.0


def rows_of(units=40, seed=0, most=40, y=("y",)):
    """Units of unequal lengths with gaps and missing values; unit names read as numbers."""
    rng = np.random.default_rng(seed)
    length = rng.integers(1, most, units)
    N = int(length.sum())
    time = np.concatenate([np.cumsum(rng.choice([1.0, 2.5], T, p=[0.95, 0.05])) for T in length])
    signals = {name: 0.3 * rng.normal(size=N).cumsum() for name in y} | {"u": rng.normal(size=N)}
    for name in y:
        signals[name][rng.random(N) < 0.05] = np.nan
    signals["u"][rng.random(N) < 0.02] = np.nan
    return pl.DataFrame({"unit": np.repeat([str(k) for k in range(units)], length), "t": time} | signals)


def fleet_of(rows, tracker=K, model=MODEL, before=None):
    """What one machine gives."""
    y = "y" if len(model.outputs) == 1 else list(model.outputs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return track(model, tracker, y, "u", data=rows, by="unit", time="t", warm_start=before)


def arriving(rows, files, seed=0):
    """Rows in the order in which they arrive, five per cent late but within the hold, three of every part twice."""
    rng = np.random.default_rng(seed)
    time = rows["t"].to_numpy()
    arrival = time + np.where(rng.random(len(time)) < 0.05, rng.uniform(0.0, 0.9 * HOLD, len(time)), 0.0)
    order = np.argsort(arrival, kind="stable")
    return [pl.concat([rows[part], rows[part].head(3)]) for part in np.array_split(order, files)]


def task_of(model=MODEL, tracker=K):
    return Task(model, tracker, tuple(model.outputs), ("u",), ("unit",), "t")


KINDS = {"unit": "string", "t": "double", "u": "double"}


def flow_of(task, hold=HOLD, rules=None, origins=(), time="double"):
    kinds = KINDS | dict.fromkeys(task.y, "double") | {"t": time}
    return Flow(task, kinds, hold, (None,) * len(task.y) if rules is None else rules, origins)


class ByHand:
    """A stream whose batches are given one by one: what Spark does for `driftfit.bridges.spark.follow`."""

    def __init__(self, model=MODEL, tracker=K, rules=None, hold=HOLD, origins=(), settings=()):
        self.flow = flow_of(replace(task_of(model, tracker), settings=tuple(settings)), hold, rules, origins)
        self.kept = []
        self.found = {}

    def batch(self, rows, expired=None):
        """Process new rows; units without a row since ``expired`` end."""
        task, schema = self.flow.task, self.flow.schema
        columns = [*task.columns, *self.flow.state]
        own = dict.fromkeys((SETTING + name for name in task.settings), pa.float64())
        types = pa.schema({name: ARROW[schema[name]] for name in columns} | own | {"_kind": pa.int32()})
        parts = [rows.with_columns(_kind=pl.lit(NEW)), *self.kept]
        every = pl.concat(parts, how="diagonal_relaxed").sort("unit", "_kind", "t", *task.y, "u")
        table = pa.Table.from_pydict({name: every[name].to_list() if name in every.columns else [None] * len(every)
                                      for name in types.names}, types)  # fmt: skip
        self.kept = []
        for one in self.flow.work(iter(table.to_batches()), expired):
            frame = pl.from_arrow(one)
            kind = frame["kind"][0]
            self.found.setdefault(kind, []).append(frame)
            if kind in ("state", "waiting"):
                self.kept.append(frame.select(columns).with_columns(_kind=pl.lit(OLD if kind == "state" else WAITED)))

    def rows(self, kind="result"):
        """All rows of a kind."""
        return pl.concat(self.found.get(kind, [])).sort("unit", "t")

    def states(self):
        """The last state of every unit."""
        return dict(self.found["state"][-1].select("unit", "state").rows())


def packed(fleet):
    """The state of every unit of a fleet without its head, which has the fingerprint of the model's unnamed inputs."""
    found = {}
    for key, run in fleet.series().items():
        lanes = [run._lane] if len(run.outputs) == 1 else run._lanes
        programs = [run.program] if len(run.outputs) == 1 else run.programs
        words = [one.layout.taken(lane.tile)[lane.lane] for one, lane in zip(programs, lanes, strict=True)]
        found[key] = layout.packed(bytes(8), np.concatenate(words))[layout.HEAD.size :]
    return found

"""Results as tables: polars, pandas, pyarrow, Arrow streams, CSV and Parquet.

One row per sample. The columns are those that identify the series of a fleet, the time (or the sample number), the
signals under their own names, ``prediction``, ``innovation``, ``innovation_std``, ``ok``, and for every parameter
``theta_<name>`` and ``std_<name>``. Units are stored where each format has room for them: ``attrs`` in pandas, the
metadata of fields in pyarrow, the metadata of the file in Parquet.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from driftfit.data.clock import Clock
from driftfit.data.record import Labels
from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.run.result import Track

if TYPE_CHECKING:
    from driftfit.run.fleet import Fleet
    from driftfit.run.outputs import Outputs
    from driftfit.run.shared_outputs import Shared
    from driftfit.run.track_outputs import OutputsFleet

ENDINGS = (".csv", ".parquet", ".npz")
_OWN = ("prediction", "innovation", "innovation_std", "ok")


def as_table(result: Track | Fleet) -> pl.DataFrame:
    """A result as a polars table."""
    runs, keys = _runs(result)
    columns: dict[str, Any] = {}
    lengths = [len(run) for run in runs]
    for place, name in enumerate(runs[0].labels.by if keys else ()):
        values = [key[place] if isinstance(key, tuple) else key for key in keys]
        columns[name] = pl.Series(values).gather(np.repeat(np.arange(len(runs)), lengths))
    for name, parts in _signals(runs).items():
        columns[name if name not in columns else f"{name}_"] = np.concatenate(parts)
    table = pl.DataFrame(columns)
    zone, time = runs[0].labels.zone, _time_name(runs[0])
    if zone is not None:
        table = table.with_columns(pl.col(time).dt.replace_time_zone("UTC").dt.convert_time_zone(zone))
    return table


def _runs(result: Track | Fleet) -> tuple[list[Track], list[Any]]:
    """(runs, keys); no keys for a single run."""
    return ([result], []) if isinstance(result, Track) else (list(result.values()), list(result))


def _time_name(run: Track | Outputs | Shared) -> str:
    return run.labels.time or ("sample" if run._time is None else "time")


def _signals(runs: Sequence[Track]) -> dict[str, list[Array]]:
    """The columns of all runs, by name; a signal with the name of a result gets a trailing underscore."""
    first = runs[0]
    inputs = first.labels.u or tuple(f"u{j + 1}" for j in range(first.u.shape[1]))
    columns = {_time_name(first): [run.time for run in runs], _free(first.labels.y): [run.y for run in runs]}
    columns |= {_free(name): [run.u[:, j] for run in runs] for j, name in enumerate(inputs)}
    columns |= {name: [getattr(run, name) for run in runs] for name in _OWN}
    for i, name in enumerate(first.names):
        columns |= {f"theta_{name}": [run.theta[:, i] for run in runs], f"std_{name}": [run.std[:, i] for run in runs]}
    return columns


def _free(name: str) -> str:
    return f"{name}_" if name in _OWN else name


def units_of(result: Track | Fleet) -> dict[str, str]:
    """Units of the columns of a result that have one."""
    run = _runs(result)[0][0]
    given = run.labels.units
    units = {_free(name): given[name] for name in (run.labels.y, *run.labels.u) if name in given}
    if run.labels.y in given:
        units |= dict.fromkeys(("prediction", "innovation", "innovation_std"), given[run.labels.y])
    for name, unit in zip(run.names, run.units, strict=True):
        units |= {f"theta_{name}": unit, f"std_{name}": unit} if unit else {}
    return units


def outputs_table(runs: Outputs | Shared | OutputsFleet, kind: str = "polars") -> Any:
    """Records of several outputs: each result has its output in brackets; inputs and parameters have their names."""
    one_of("to_table", "kind", kind, ("polars", "pandas", "pyarrow"))
    if isinstance(runs, dict):
        parts = []
        for key, run in runs.items():
            keys = zip(runs.by, key if isinstance(key, tuple) else (key,), strict=True)
            parts.append(_of_outputs(run).select([*(pl.lit(k).alias(name) for name, k in keys), pl.all()]))
        table = pl.concat(parts)
    else:
        table = _of_outputs(runs)
    return table if kind == "polars" else table.to_pandas() if kind == "pandas" else table.to_arrow()


def _of_outputs(run: Outputs | Shared) -> pl.DataFrame:
    columns: dict[str, Any] = {_time_name(run): run.time}
    for j, output in enumerate(run.outputs):
        columns[_free(output)] = run.y[:, j]
        columns |= {f"{name}[{output}]": getattr(run, name)[:, j] for name in _OWN}
    shared = run.model.shared
    if not shared:
        inputs = run.labels.u or tuple(f"u{j + 1}" for j in range(run.u.shape[1]))
        columns |= {_free(name): run.u[:, j] for j, name in enumerate(inputs) if _free(name) not in columns}
    for j, names in enumerate([run.names] if shared else run.names):
        theta, std = (run.theta, run.std) if shared else (run.theta[:, j], run.std[:, j])
        for i, name in enumerate(names):
            columns |= {f"theta_{name}": theta[:, i], f"std_{name}": std[:, i]}
    return pl.DataFrame(columns)


def forecasts_table(runs: Mapping[Any, Track], labels: Labels, h: int, u: Any) -> pl.DataFrame:
    """The forecasts of many runs in one table, one row per sample."""
    parts = []
    for key, run in runs.items():
        found = run.forecast(h, u.get(key) if isinstance(u, Mapping) else u)
        columns: dict[str, Any] = {"step": np.arange(1, h + 1)}
        ahead = None if run._time is None else Clock.of(labels.dt, labels.zone).ahead(run._time[-1], h)
        if ahead is not None:
            columns[_time_name(run)] = ahead
        columns |= {"y_hat": found.y_hat, "y_std": found.y_std}
        for i, name in enumerate(run.names):
            columns |= {f"theta_{name}": found.theta[:, i], f"std_{name}": found.std[:, i]}
        keys = zip(labels.by, key if isinstance(key, tuple) else (key,), strict=True)
        part = pl.DataFrame(columns).select([*(pl.lit(k).alias(name) for name, k in keys), pl.all()])
        if labels.zone is not None and ahead is not None:
            shown = pl.col(_time_name(run)).dt.replace_time_zone("UTC").dt.convert_time_zone(labels.zone)
            part = part.with_columns(shown)
        parts.append(part)
    return pl.concat(parts)


def to_table(result: Track | Fleet, kind: str = "polars") -> Any:
    """A result as a table of polars, pandas or pyarrow (each must be installed)."""
    one_of("to_table", "kind", kind, ("polars", "pandas", "pyarrow"))
    table = as_table(result)
    if kind == "polars":
        return table
    units = units_of(result)
    return _to_pandas(table, units) if kind == "pandas" else _to_pyarrow(table, units)


def _to_pandas(table: pl.DataFrame, units: Mapping[str, str]) -> Any:
    import pandas as pd

    frame = pd.DataFrame({name: table[name].to_numpy() for name in table.columns})
    for name, kind in table.schema.items():
        if isinstance(kind, pl.Datetime) and kind.time_zone is not None:  # numpy has no time zones: these times are UTC
            frame[name] = frame[name].dt.tz_localize("UTC").dt.tz_convert(kind.time_zone)
    frame.attrs["units"] = dict(units)
    return frame


def _to_pyarrow(table: pl.DataFrame, units: Mapping[str, str]) -> Any:
    import pyarrow as pa

    plain = table.to_arrow()
    fields = [f.with_metadata({"unit": units[f.name]}) if f.name in units else f for f in plain.schema]
    return plain.cast(pa.schema(fields))


def to_parquet(result: Track | Fleet, path: str | PathLike[str]) -> None:
    """Write a result as Parquet; units, model and tracker are stored in the metadata of the file, under "driftfit"."""
    runs, _ = _runs(result)
    trackers = dict.fromkeys(repr(run.tracker) for run in runs)
    about = {"model": repr(runs[0].model), "trackers": list(trackers), "units": units_of(result)}
    as_table(result).write_parquet(Path(path), metadata={"driftfit": json.dumps(about)})


def check_ending(path: str | PathLike[str]) -> str:
    """The ending of a file to which results can be written; ValueError for any other."""
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"{path}: results are written to {', '.join(ENDINGS)}, by the ending of the name.")
    return ending


def write(result: Any, path: str | PathLike[str]) -> None:
    """Write a result: a table as .csv or .parquet, or a complete run as .npz, depending on the ending of the name."""
    ending = check_ending(path)
    single = hasattr(result, "to_parquet")  # a single output
    if ending == ".npz" and hasattr(result, "save"):
        result.save(path)
    elif ending == ".npz":
        raise ValueError(f"{path}: an .npz file holds one run; write a fleet as .parquet, or fleet[key].save(...).")
    elif ending == ".parquet" and single:
        to_parquet(result, path)
    elif ending == ".parquet":
        outputs_table(result).write_parquet(Path(path))
    else:
        (as_table(result) if single else outputs_table(result)).write_csv(Path(path))

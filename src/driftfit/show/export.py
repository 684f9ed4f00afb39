"""Results as tables: polars, pandas, pyarrow, Arrow streams, CSV and Parquet.

One row per sample. The columns are those that identify the series of a fleet, the time (or the sample number), the
signals under their own names, ``prediction``, ``innovation``, ``innovation_std``, ``ok``, and for every parameter
``theta_<name>`` and ``std_<name>``, or all in the array columns ``theta`` and ``std``. Units are stored where each
format has room for them: ``attrs`` in pandas, the metadata of fields in pyarrow, the metadata of the file in Parquet.

xarray datasets have labelled dimensions:

    run.to_xarray()      dimensions time (or sample), parameter, input
    fleet.to_xarray()    the same and one dimension more, `unit`, over the union of all times (absent samples are NaN)

Variables: ``theta``, ``theta_std`` (time, parameter); ``y``, ``prediction``, ``innovation``, ``innovation_std``,
``used`` (time); ``u`` (time, input). Of several outputs with one theta each, `output` is the further dimension; of
outputs that share one theta, y and what follows it are (time, output). Units are attributes. Times are UTC where the
record had a time zone; ``attrs`` names it.

Needs xarray (``pip install "driftfit[xarray]"``).
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

import numpy as np
import polars as pl

from driftfit.data.files import without_formulas
from driftfit.data.instants import in_zone
from driftfit.data.storage import replace_file
from driftfit.engine.kernel import Array
from driftfit.engine.settings import of_series, one_of
from driftfit.run.fleet import Fleet, KeyedResults, Outputs, table_by_key
from driftfit.run.result import Track
from driftfit.show.text import key_text
from driftfit.use.forecast import forecast, forecast_outputs

if TYPE_CHECKING:
    import xarray


Result = Track | KeyedResults
Single = Track | Outputs
"""One record."""

ENDINGS = (".csv", ".parquet", ".npz")
_OWN = ("prediction", "innovation", "innovation_std", "ok")


def as_table(result: Result, arrays: bool = False) -> pl.DataFrame:
    """A result as a polars table; with ``arrays`` all parameters of a sample are in one column."""
    records, keys = _records(result)
    if not records:
        assert isinstance(result, Fleet)
        return _of_nothing(result, arrays)
    signals = [_columns(one, arrays) for one in records]
    columns = {name: np.concatenate([part[name] for part in signals]) for name in signals[0]}
    return _of_records(result.labels.by if isinstance(result, Fleet) else (), keys, records, columns)


def paths_table(fleet: Fleet, paths: Mapping[Hashable, tuple[Array, Array]]) -> pl.DataFrame:
    """theta and std (T, n) of each result of a fleet in one table, one row per sample."""
    if not paths:
        return _of_nothing(fleet, False)
    runs = [fleet[key] for key in paths]
    theta, std = (np.concatenate(parts) for parts in zip(*paths.values(), strict=True))
    columns = {_time_name(runs[0]): np.concatenate([run.time for run in runs])}
    return _of_records(fleet.by, paths, runs, columns | _parameters(runs[0].names, theta, std, None))


def _of_records(
    by: tuple[str, ...], keys: Iterable[Any], records: Sequence[Single], columns: dict[str, Array]
) -> pl.DataFrame:
    table = table_by_key(by, keys, [len(one) for one in records], columns)
    return in_zone(table, _time_name(records[0]), records[0].labels.zone)


class Written(NamedTuple):
    """Results that were written to Parquet: the folder, how many series and rows, and units without a result."""

    path: Path
    series: int
    rows: int
    failed: dict[Hashable, str]


def write_parts(fleets: Iterator[Fleet], to: str | PathLike[str]) -> Written:
    """Write the table of each fleet to a file of the folder ``to``, before the next is run; ValueError if it has any.

    Each file is complete or absent.
    """
    folder, series, rows = Path(to), 0, 0
    failed: dict[Hashable, str] = {}
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"track: to={str(to)!r} exists and is not empty; give a new folder.")
    folder.mkdir(parents=True, exist_ok=True)
    for k, fleet in enumerate(fleets):
        failed |= fleet.failed
        if not len(fleet):
            continue
        table = as_table(fleet)
        replace_file(folder / f"part-{k:06d}.parquet", table.write_parquet)
        series, rows = series + len(fleet.series()), rows + len(table)
    return Written(folder, series, rows, failed)


def _of_nothing(fleet: Fleet, arrays: bool) -> pl.DataFrame:
    """The table of a fleet in which no series has a result."""
    given = fleet.labels
    program = fleet.programs[0]
    time = pl.Datetime("us", given.zone) if given.zone else pl.Float64
    columns: dict[str, Any] = {**dict.fromkeys(given.by, pl.String), given.time or "sample": time}
    columns |= {_free(name): pl.Float64 for name in (given.y, *given.u)}
    kinds = {"double": pl.Float64, "boolean": pl.Boolean, "array<double>": pl.Array(pl.Float64, program.model.n)}
    return pl.DataFrame(schema=columns | {name: kinds[kind] for name, kind in program.schema(arrays).items()})


def _records(result: Result) -> tuple[list[Single], list[Any]]:
    """(records, keys); the key of a single one has no parts."""
    if isinstance(result, Fleet):
        found = result.series()
        return list(found.values()), list(found)
    assert isinstance(result, Track | Outputs)
    return [result], [()]


def _time_name(run: Single) -> str:
    return run.labels.time or ("time" if run.timed else "sample")


def _is_single(run: Single) -> TypeGuard[Track]:
    """Whether a record has one output."""
    return len(run.outputs) == 1


def _parameters(names: Sequence[str], theta: Array, std: Array, of: str | None) -> dict[str, Array]:
    """The columns of the parameters; ``of`` follows the names of array columns, None gives a column for each."""
    if of is not None:
        return {f"theta{of}": theta, f"std{of}": std}
    each = [
        (f"{what}_{name}", path[:, i])
        for i, name in enumerate(names)
        for what, path in (("theta", theta), ("std", std))
    ]
    return dict(each)


def _columns(run: Single, arrays: bool) -> dict[str, Array]:
    """The columns of a record, by name; a signal that is called like a result gets a trailing underscore.

    Of several outputs each result has its output in brackets.
    """
    single, columns = _is_single(run), {_time_name(run): run.time}
    inputs = {} if run.u.ndim > 2 else {_free(name): run.u[:, j] for j, name in enumerate(_inputs(run))}
    for j, output in enumerate((run.labels.y,) if single else run.outputs):
        own = {"": run.y} | {name: getattr(run, name) for name in _OWN}
        for name, values in own.items():
            where = f"{name}{'' if single else f'[{output}]'}" if name else _free(output)
            columns[where] = values if single else values[:, j]
            columns |= inputs if single and not name else {}
    columns |= {name: column for name, column in inputs.items() if name not in columns}
    parts: list[tuple[Any, Array, Array, str]] = [(run.names, run.theta, run.std, "")]
    if isinstance(run, Outputs):
        each = zip(run.outputs, run.names, strict=True)
        parts = [(names, run.theta[:, j], run.std[:, j], f"[{output}]") for j, (output, names) in enumerate(each)]
    for names, theta, std, of in parts:
        columns |= _parameters(names, theta, std, of if arrays else None)
    return columns


def _inputs(run: Single) -> tuple[str, ...]:
    return run.labels.u or tuple(f"u{j + 1}" for j in range(run.u.shape[1]))


def _free(name: str) -> str:
    return f"{name}_" if name in _OWN else name


def units_of(result: Result) -> dict[str, str]:
    """Units of the columns of a result that have one."""
    if not (records := _records(result)[0]):
        return {}
    run = records[0]
    given = run.labels.units
    single = _is_single(run)
    signals = (run.labels.y,) if single else run.outputs
    units = {_free(name): given[name] for name in (*signals, *run.labels.u) if name in given}
    for name in signals:
        own = _OWN[:3] if single else [f"{what}[{name}]" for what in _OWN[:3]]
        units |= dict.fromkeys(own, given[name]) if name in given else {}
    for one in run.values() if isinstance(run, Outputs) else [run]:
        for name, unit in zip(one.names, one.units, strict=True):
            units |= {f"theta_{name}": unit, f"std_{name}": unit} if unit else {}
    return units


def forecasts_table(fleet: Fleet, h: int, u: Any) -> pl.DataFrame:
    """The forecasts of a fleet in one table, one row per sample of each output."""
    parts = []
    labels, series = fleet.labels, fleet.series()
    of_series("forecast", "u", u, series)
    for key, run in series.items():
        own = u.get(key) if isinstance(u, Mapping) else u
        found = forecast_outputs(run, h, own) if isinstance(run, Outputs) else forecast(run, h, own)
        identity = zip(labels.by, key if isinstance(key, tuple) else (key,), strict=False)
        parts.append(found.table.select(*(pl.lit(k).alias(name) for name, k in identity), pl.all()))
    return pl.concat(parts, how="diagonal")


def to_table(result: Result, kind: str = "polars", arrays: bool = False) -> Any:
    """A result as a table of polars, pandas or pyarrow (each must be installed)."""
    one_of("to_table", "kind", kind, ("polars", "pandas", "pyarrow"))
    table = as_table(result, arrays)
    if kind == "polars":
        return table
    units = units_of(result)
    if kind == "pandas":
        return _to_pandas(table, units)
    import pyarrow as pa

    plain = table.to_arrow()
    fields = [f.with_metadata({"unit": units[f.name]}) if f.name in units else f for f in plain.schema]
    return plain.cast(pa.schema(fields))


def _to_pandas(table: pl.DataFrame, units: Mapping[str, str]) -> Any:
    import pandas as pd

    nested = [name for name, kind in table.schema.items() if kind.is_nested()]
    frame = pd.DataFrame(
        {name: table[name].to_list() if name in nested else table[name].to_numpy() for name in table.columns}
    )
    for name, kind in table.schema.items():
        if isinstance(kind, pl.Datetime) and kind.time_zone is not None:  # numpy has no time zones: these times are UTC
            frame[name] = frame[name].dt.tz_localize("UTC").dt.tz_convert(kind.time_zone)
    frame.attrs["units"] = dict(units)
    return frame


def to_parquet(result: Result, path: str | PathLike[str]) -> None:
    """Write a result as Parquet; units, model and tracker are stored in the metadata of the file, under "driftfit"."""
    records, _ = _records(result)
    each = (run.trackers if isinstance(run, Outputs) else (run.tracker,) for run in records)
    trackers = dict.fromkeys(repr(one) for own in each for one in own)
    about = {"model": repr(records[0].model), "trackers": list(trackers), "units": units_of(result)}
    as_table(result).write_parquet(Path(path), metadata={"driftfit": json.dumps(about)})


def check_ending(path: str | PathLike[str]) -> str:
    """The ending of a file to which results can be written; ValueError for any other."""
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"{path}: results are written to {', '.join(ENDINGS)}, by the ending of the name.")
    return ending


def write(result: Result, path: str | PathLike[str]) -> None:
    """Write a result: a table as .csv or .parquet, or a complete run as .npz, depending on the ending of the name."""
    ending = check_ending(path)
    if ending == ".npz":
        result.save(path)
    elif ending == ".parquet":
        to_parquet(result, path)
    else:
        write_table(as_table(result), Path(path))


def write_table(table: pl.DataFrame, path: Path) -> None:
    """Write a table as .csv or .parquet, depending on the ending of the name."""
    if path.suffix.lower() == ".csv":
        without_formulas(table).write_csv(path)
    else:
        table.write_parquet(path)


def to_xarray(result: Track | KeyedResults) -> xarray.Dataset:
    """A result as a dataset; ImportError without xarray."""
    try:
        import xarray
    except ImportError:
        raise ImportError('to_xarray needs xarray: pip install "driftfit[xarray]"') from None
    if isinstance(result, KeyedResults):
        dimension = "output" if isinstance(result, Outputs) else "unit"
        keys = xarray.DataArray([key_text(key) for key in result], dims=dimension, name=dimension)
        return xarray.concat([_dataset(xarray, run) for run in result.values()], dim=keys, join="outer")
    return _dataset(xarray, result)


def _dataset(xarray: Any, run: Track) -> xarray.Dataset:
    labels, time = run.labels, _time_name(run)
    rows: tuple[str, ...] = (time, "output") if run.rows_per_instant > 1 else (time,)
    inputs = labels.u or tuple(f"u{j + 1}" for j in range(run.u.shape[-1]))
    variables = {
        "theta": ((time, "parameter"), run.theta),
        "theta_std": ((time, "parameter"), run.std),
        "y": (rows, run.y, {"long_name": labels.y, "units": labels.units.get(labels.y, "")}),
        "prediction": (rows, run.prediction),
        "innovation": (rows, run.innovation),
        "innovation_std": (rows, run.innovation_std),
        "used": (rows, run.ok.astype(bool)),
    }
    coordinates: dict[str, Any] = {time: run.time, "parameter": list(run.names)}
    if inputs:
        variables["u"] = ((*rows, "input"), run.u)
        coordinates["input"] = list(inputs)
    if run.rows_per_instant > 1:
        coordinates["output"] = list(run.outputs)
    attributes = {"model": repr(run.model), "tracker": repr(run.tracker), "loglik": float(run.loglik)}
    if labels.zone is not None:
        attributes["time_zone"] = str(labels.zone)
    found: xarray.Dataset = xarray.Dataset(variables, coordinates, attributes)
    return found.assign_coords(unit_of_parameter=("parameter", np.array(run.units, dtype=str)))

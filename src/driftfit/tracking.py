"""track: the one call for records, fleets, grids of settings and records of several outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

from driftfit.data.record import Reading
from driftfit.fleets import Fleet
from driftfit.models.base import Model
from driftfit.results import Track
from driftfit.run import track as plain
from driftfit.run.track import Trackers
from driftfit.run.warm_start import Run
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    from driftfit.show.export import Written

Ranges = Mapping[Any, tuple[float | None, float | None]] | None
"""From signals to their valid ranges."""


Missing = str | float | Sequence[str | float]
"""What means "no value"."""


class Given(TypedDict, total=False):
    """Arguments that every form of `track` takes by name."""

    data: Any
    time: Any
    dt: Any
    weights: Any
    drift: Any
    units: Mapping[str, str] | None
    limits: Ranges
    exclude: Any
    gate: Any
    missing: Missing
    keep: str
    dtype: Any


@overload
def track(
    model: Model,
    tracker: Trackers,
    y: Any,
    u: Any = None,
    *,
    by: str | Sequence[str] | None = None,
    to: str | PathLike[str],
    **given: Unpack[Given],
) -> Written: ...


@overload
def track(
    model: Model,
    tracker: Tracker,
    y: Any,
    u: Any = None,
    *,
    by: None = None,
    warm_start: Run | bytes | None = None,
    prob: Any = None,
    **given: Unpack[Given],
) -> Track: ...


@overload
def track(
    model: Model,
    tracker: Trackers,
    y: Any,
    u: Any = None,
    *,
    by: str | Sequence[str] | None = None,
    warm_start: Fleet | Mapping[Any, Run | bytes] | None = None,
    **given: Unpack[Given],
) -> Fleet: ...


def track(
    model: Model,
    tracker: Trackers,
    y: Any,
    u: Any = None,
    *,
    data: Any = None,
    time: Any = None,
    by: str | Sequence[str] | None = None,
    dt: Any = None,
    weights: Any = 1.0,
    drift: Any = 1.0,
    units: Mapping[str, str] | None = None,
    limits: Ranges = None,
    exclude: Any = None,
    gate: Any = None,
    missing: Missing = (),
    keep: str = "std",
    dtype: Any = "float64",
    warm_start: Any = None,
    prob: Any = None,
    to: str | PathLike[str] | None = None,
) -> Any:
    """Track the parameters of a model in a record, or in many records.

    Nothing looks ahead: the result at sample t is what `Live` would have given at t.

    Parameters
    ----------
    model : Model
        Turns signals into a regression, such as ``ARX(2, 2)`` or ``Regression(3)``.
    tracker : Tracker, or a list or mapping of them
        Estimates theta, such as ``Kalman(q=1e-4, r=0.1)``. Without ``by`` several trackers are a grid of settings for
        one record; with it they are the settings of each series, in order or by key.
    y : (T,), with by="row" (units, T), or the name of a column of ``data``; a list of names for several outputs
        Output. NaN, inf and None are missing. A Series keeps its name; its index of dates labels the samples.
    u : (T,), (T, m) or None, with by="row" (units, T) or (units, T, m), or names of columns
        Inputs. Columns of a data frame, of a mapping or of ``data`` are matched by name with a model with named inputs.
    data : table, path, pattern or list of paths
        A table that narwhals reads (pandas, polars, pyarrow), or CSV and Parquet files such as ``"runs/*.parquet"``.
        y, u, time, by, weights and drift are then names of its columns.
    time : (T,) numbers or datetimes, increasing, or the name of a column
        The times of the samples. Drift scales with the interval, and a gap above 1.5 ``dt`` breaks the lags. Rows of a
        table are sorted; of several rows at the same time the first is used. If no time is given, an index of dates, or
        the only column of dates of a table, is used, with ``dt="label"`` unless dt is given.
    by : names of columns, "row" or None
        The columns that identify the series of a table ("file": the file of a row). "row": every row of the array y is
        a separate series.
    dt : number, duration, step of the calendar or "label"
        Nominal interval: 1 in the unit of ``time`` by default, required for datetimes ("1s", "15min", "30d", a
        timedelta, "business day", "month", "quarter", "year", an offset of pandas; `driftfit.data.clock`). "label":
        times are only labels, and samples are one step apart.
    weights : number or (T,)
        The noise variance of a sample is r / weight; 0 marks a sample that is not used.
    drift : number or (T,), or (T, n), with by="row" (units, T) or (units, T, n), or names of columns
        Known factors of the drift before each sample, such as 100 where a set-point was changed; 0 means no drift. With
        a column for each parameter, `FLS` has a separate weight mu / drift for every step and parameter, and `Kalman`
        and `ExtendedKalman` have a separate drift. For a `Bank` pass a column for each change.
    units : mapping from names of columns to their units, such as {"flow": "l/min"}
        Shown in summary, plots and exports.
    limits : mapping from signals to (low, high), such as {"flow": (0, 80), "pressure": (None, 16)}
        Valid ranges: a number outside its range is missing, and the summary counts it. Signals of arrays are "y", "u",
        "u1", .., the names of the model's inputs, or 0, 1, .. for the inputs.
    exclude : list of (from, to), or a mapping from the keys of a fleet to such lists
        Intervals to leave out, both ends included, in times or, without time, in sample numbers: nothing in them is
        used or enters a lag, and the summary counts their samples (`driftfit.data.limits`).
    gate : bool, `Gate`, decisions of an earlier run or None
        Whether readings are judged before the tracker uses them: fault codes, spikes, frozen sensors, inputs to which
        the output does not respond (`driftfit.readings.gate`). ``run.left_out`` lists what was refused; given here, it
        applies the same decisions (of several series a mapping from their keys). None: as the tracker asks; those that
        are given their numbers have no gate, and use every reading as their textbook does.
    missing : text or number, or several
        What signals hold where there is no value, such as ``["Offline", -999]``. Texts of tables are known already if
        spreadsheets and historians use them (`driftfit.data.columns`). The summary counts numbers.
    keep : "std", "cov" or "theta"
        What is stored of every sample. "std": theta, std, prediction, innovation and its standard deviation, ok:
        2 n + 4 numbers. "cov": also the covariance, n * n numbers. "theta": that alone, n numbers, for models of one
        output; whatever else is asked for replays the record.
    dtype : "float64" or "float32"
        Precision in which results are stored: "float32" halves their memory. The filter works in double precision.
    warm_start : Track, Live, Fleet, bytes, mapping or None
        Continue where that run ended, given itself or as bytes (``live.to_bytes()``, ``run.end().to_bytes()``); for a
        fleet series by series, from a fleet or a mapping from key to any of these (new series start from the
        beginning).
    prob : (T, changes), (T, joint events) or None
        For a `Bank`: prior probabilities at every sample, NaN in rows where its own prior applies.
    to : path or None
        A new folder, for fleets whose results exceed the memory: they are written there as Parquet files with the
        columns of `Fleet.to_table`, some series at a time, and not kept. Not with ``warm_start`` and ``prob``.

    Returns
    -------
    Track, or a Fleet (from key to Track) for several series or several trackers; with ``to`` the numbers of series and
    rows written. A model with several outputs (``ny``) takes y (T, ny), or as many names, and returns
    `driftfit.Outputs` (from output to Track), or one Track if the outputs share one theta; ``tracker`` may then map the
    name of each output to its tracker, and weights may be (T, ny).

    Raises
    ------
    ValueError
        For shapes that do not fit, times of arrays that do not increase, incomplete settings; for columns that do not
        exist, cells that are not numbers, files that cannot be read; for names of inputs that are not those of the
        model, and indices of pandas that differ. Missing and non-finite data never raise an error.

    Warns
    -----
    DataWarning
        If most samples cannot be used because of ``dt``; if rows are left out because their time repeats, or are sorted
        by dates that were not named as the time; if there is no gate and readings look like fault codes.
    """
    reading = Reading(time, dt, weights, drift, units, limits, exclude, missing, gate)
    if to is not None:
        from driftfit.show.export import write_parts  # importing polars takes as long as all other imports

        if warm_start is not None or prob is not None:
            raise ValueError("track: to= cannot be combined with warm_start= or prob=.")
        return write_parts(plain.parts(model, tracker, y, u, reading, data=data, by=by, keep=keep, dtype=dtype), to)
    return plain.track(
        model, tracker, y, u, reading, data=data, by=by, keep=keep, dtype=dtype, warm_start=warm_start, prob=prob
    )

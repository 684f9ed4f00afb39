"""Record mode: a whole series in one call, causal at every sample."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast, overload

import numpy as np
from rich.console import Console
from rich.progress import Progress

from driftfit.data.arguments import check_roles
from driftfit.data.record import Reading, Records, one_series, rows
from driftfit.data.signals import check_ready
from driftfit.engine.drivers import drivers, output_type
from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.models.base import Model
from driftfit.run.fleet import Fleet, run_fleet
from driftfit.run.result import Track
from driftfit.run.unlearned import warn_unlearned
from driftfit.run.warm_start import Run, carried, first_interval, fresh_tile
from driftfit.trackers.base import Tracker

Trackers = Tracker | Sequence[Tracker] | Mapping[Any, Tracker]
"""One tracker for all, or one per setting of a grid or per series."""

Ranges = Mapping[Any, tuple[float | None, float | None]] | None
"""From signals to their valid ranges."""

CHUNK = 1_000_000
"""Samples between two looks at the progress bar."""


@overload
def track(
    model: Model,
    tracker: Tracker,
    y: Any,
    u: Any = None,
    *,
    data: Any = None,
    time: Any = None,
    by: None = None,
    dt: Any = None,
    weights: Any = 1.0,
    drift: Any = 1.0,
    units: Mapping[str, str] | None = None,
    limits: Ranges = None,
    exclude: Any = None,
    keep: str = "std",
    warm_start: Run | None = None,
    prob: Any = None,
) -> Track: ...


@overload
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
    keep: str = "std",
    warm_start: Fleet | None = None,
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
    keep: str = "std",
    warm_start: Any = None,
    prob: Any = None,
) -> Track | Fleet:
    """Follow the parameters of a model through a record, or through many.

    What is reported at sample t is what `Live` would have said at t: nothing looks ahead.

    Parameters
    ----------
    model : Model
        How signals become a regression, such as ``ARX(2, 2)`` or ``Regression(3)``.
    tracker : Tracker, or a list or mapping of them
        How theta is followed, such as ``Kalman(q=1e-4, r=0.1)``. Without ``by`` several trackers are a grid of settings
        over the one record; with it they are the settings of each series, in order or by key.
    y : (T,), with by="row" (units, T), or the name of a column of ``data``
        Output. NaN, inf and None are missing. A Series keeps its name; its index of dates labels the samples.
    u : (T,), (T, m) or None, with by="row" (units, T) or (units, T, m), or names of columns
        Inputs. The columns of a data frame, of a mapping or of ``data`` go to a model with named inputs by name.
    data : table, path, pattern or list of paths
        A table that narwhals reads (pandas, polars, pyarrow), or CSV and Parquet files such as ``"runs/*.parquet"``.
        y, u, time, by, weights and drift are then names of its columns.
    time : (T,) numbers or datetimes, increasing, or the name of a column
        When the samples were taken. Drift scales with the interval, and a gap above 1.5 ``dt`` breaks the lags. Rows
        of a table are put in order; of rows at the same time the first stands. An index of dates of y or u stands for
        it where it is not given, with ``dt="label"`` unless dt is.
    by : names of columns, "row" or None
        What tells the series of a table apart ("file": the file a row comes from). "row": every row of the array y is
        a series of its own.
    dt : number, duration, step of the calendar or "label"
        Nominal interval: in the unit of ``time`` 1 by default, required for datetimes ("1s", "15min", "30d", a
        timedelta, "business day", "month", "quarter", "year", an offset of pandas; `driftfit.data.clock`). "label":
        times are only labels, and samples are one step apart.
    weights : number or (T,)
        The noise variance of a sample is r / weight; 0 marks a sample that is not to be used.
    drift : number or (T,), or (T, n), with by="row" (units, T) or (units, T, n), or names of columns
        Known factors of the drift before each sample, such as 100 where a set-point was changed; 0 says that nothing
        moves. With a column for each parameter, `FLS` has a weight of its own for every step and parameter, mu /
        drift, `Kalman` and `ExtendedKalman` a drift of their own. For a `Bank` a column for each change.
    units : mapping from names of columns to their units, such as {"flow": "l/min"}
        Carried to summary, plots and exports.
    limits : mapping from signals to (low, high), such as {"flow": (0, 80), "pressure": (None, 16)}
        Valid ranges: a number outside is missing, and the summary counts it. Signals of arrays are "y", "u", "u1", ..,
        the names of the model's inputs, or 0, 1, .. for the inputs.
    exclude : list of (from, to), or a mapping from the keys of a fleet to such lists
        Stretches to leave out, both ends included, in times or, without time, in sample numbers: nothing of them is
        used or reaches a lag, and the summary counts their samples (`driftfit.data.limits`).
    keep : "std" or "cov"
        "cov" also stores the covariance of every sample, n * n numbers each.
    warm_start : Track, Live, Fleet or None
        Begin where that run ended, a fleet series by series (those that it does not have begin afresh).
    prob : (T, changes), (T, joint events) or None
        For a `Bank`: prior probabilities at every sample, NaN in the rows where its own hold.

    Returns
    -------
    Track, or a Fleet (from key to Track) for several series or several trackers. A model with several outputs (``ny``)
    takes y (T, ny), or as many names, and gives `driftfit.run.outputs.Outputs`, or
    `driftfit.run.shared_outputs.Shared` where they share one theta; ``tracker`` may then map the name of each output
    to its own, and weights may be (T, ny).

    Raises
    ------
    ValueError
        Shapes that do not fit, times of arrays that do not increase, settings that are incomplete; columns that are not
        there, cells that are not numbers, files that cannot be read; names of inputs that are not those of the model,
        indices of pandas that differ. Missing and non-finite data never raise.

    Warns
    -----
    DataWarning
        Where most samples cannot be used because of ``dt``.
    """
    check_roles("track", model, tracker, several=True)
    reading = Reading(time, dt, weights, drift, units, limits, exclude)
    if len(model.outputs) > 1:
        if prob is not None:
            raise ValueError("track: prob= is for one series and one tracker.")
        from driftfit.run.track_outputs import track_outputs

        run = track_outputs(model, tracker, y, u, data, by, reading, keep, warm_start)
        return cast("Track", run)
    one_of("track", "keep", keep, ("std", "cov"))
    records, failed = _records(y, u, data, by, reading)
    records = records.for_model(model, reading)
    bound = model.bind(records.labels.u or records.u.shape[1])
    bound.inspect(records.y, records.u)
    if by is None and isinstance(tracker, Tracker):
        records = with_drifts(bound, [_checked(tracker, keep)], records, prob)
        one = _one(bound, tracker, records, keep, warm_start)
        warn_unlearned(one)
        return one
    if prob is not None:
        raise ValueError("track: prob= is for one series and one tracker.")
    if by is None and not isinstance(tracker, Tracker):
        names = tuple(tracker) if isinstance(tracker, Mapping) else tuple(range(len(tracker)))
        records = records.repeated(names)
    trackers = _per_series(tracker, records.keys)
    for each in set(trackers):
        _checked(each, keep)
    records = with_drifts(bound, trackers, records)
    fleet = run_fleet(bound, trackers, records, keep, failed, warm_start)
    warn_unlearned(fleet)
    return fleet


def _records(y: Any, u: Any, data: Any, by: Any, reading: Reading) -> tuple[Records, dict[Hashable, str]]:
    """What is to be run, and the reasons of what cannot be."""
    if data is not None:
        from driftfit.data.tables import read_records  # narwhals and polars take as long to import as all the rest

        return read_records(data, y, u, by, reading)
    if by not in (None, "row"):
        raise ValueError(
            f"track: by={by!r} names a column of a table, so data= is needed; rows of arrays are by='row'."
        )
    if reading.units is not None:
        raise ValueError("track: units= maps the names of columns to their units, so data= is needed.")
    return (rows if by == "row" else one_series)(y, u, reading), {}


def with_drifts(model: Model, trackers: Sequence[Tracker], records: Records, prob: Any = None) -> Records:
    """The records with what is known beside interval, noise and drift as columns of ``known``."""
    if records.drifts is None and prob is None:
        return records
    N = len(records.y)
    columns, *others = (one.beside(model, N, prob, records.drifts) for one in dict.fromkeys(trackers))
    if any(not np.array_equal(columns, other, equal_nan=True) for other in others):
        raise ValueError("track: a drift for each change is for one Bank at a time; the trackers here have others.")
    return replace(records, known=np.hstack([np.broadcast_to(records.known, (N, 3)), columns]), drifts=None)


def _checked(tracker: Tracker, keep: str) -> Tracker:
    """The tracker, if its settings are complete and it has what is to be kept."""
    if keep == "cov" and not tracker.covariance:
        raise ValueError(f"track: {type(tracker).__name__} carries no covariance to keep; use keep='std'.")
    return check_ready(tracker)


def _per_series(tracker: Trackers, keys: Sequence[Hashable]) -> list[Tracker]:
    """The tracker of each series."""
    if isinstance(tracker, Tracker):
        return [tracker] * len(keys)
    if isinstance(tracker, Mapping):
        absent = [key for key in keys if key not in tracker]
        if absent:
            raise ValueError(
                f"track: settings are missing for {len(absent)} of {len(keys)} series, such as {absent[0]!r}."
            )
        return [tracker[key] for key in keys]
    if len(tracker) != len(keys):
        raise ValueError(f"track: {len(tracker)} trackers were given for {len(keys)} series.")
    return list(tracker)


def _one(model: Model, tracker: Tracker, records: Records, keep: str, before: Run | None) -> Track:
    """Run the only series of ``records``."""
    y, u, time, known = records.part(0)
    start = None
    if before is not None:
        start = carried(before, model, tracker)
        known = known.copy()
        known[0, 0] *= first_interval(before, None if time is None else time[0], records.labels)
    tile = fresh_tile(model, tracker, start)
    out = drive(model, tracker, tile, y, u, known, keep)
    return Track(model, tracker, y, u, time, known, out, tile, 0, records.labels_of(0), start)


def drive(model: Model, tracker: Tracker, tile: Array, y: Array, u: Array, known: Array, keep: str = "std") -> Array:
    """Run a tile of one lane over a record and return what the driver wrote, (T,) records of `output_type`."""
    T = len(y)
    out = np.empty(T, output_type(tile, tracker.outputs, keep))
    run = drivers(model.steps, tracker.steps_for(model), keep).run
    with Progress(console=Console(stderr=True), transient=True, disable=T <= CHUNK) as progress:
        task = progress.add_task("tracking", total=T)
        for a in range(0, T, CHUNK):
            b = min(a + CHUNK, T)
            factors = known if len(known) == 1 else known[a:b]
            run(tile, y[a:b, None], u[a:b, :, None], factors[:, :, None], out[a:b])
            progress.advance(task, b - a)
    return out

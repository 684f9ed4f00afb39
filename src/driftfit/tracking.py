"""track: the one call for records, fleets, grids of settings and records of several outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, overload

from driftfit.data.record import Reading
from driftfit.fleets import Fleet
from driftfit.models.base import Model
from driftfit.results import Track
from driftfit.run import track as plain
from driftfit.run.track import Trackers
from driftfit.run.warm_start import Run
from driftfit.trackers.base import Tracker

Ranges = Mapping[Any, tuple[float | None, float | None]] | None
"""From signals to their valid ranges."""


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
) -> Any:
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
    takes y (T, ny), or as many names, and gives `driftfit.fleets.Outputs`, or
    `driftfit.fleets.Shared` where they share one theta; ``tracker`` may then map the name of each output
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
    reading = Reading(time, dt, weights, drift, units, limits, exclude)
    return plain.track(model, tracker, y, u, reading, data=data, by=by, keep=keep, warm_start=warm_start, prob=prob)

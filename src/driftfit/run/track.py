"""Record mode: whole series in one call, causal at every sample. The public function is `driftfit.track`."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from driftfit.data.arguments import check_roles
from driftfit.data.record import Reading, Record, Records, one_series, rows
from driftfit.data.signals import check_ready
from driftfit.engine.settings import one_of
from driftfit.models.base import Model
from driftfit.run.fleet import Fleet, run_fleet
from driftfit.run.outputs import Outputs
from driftfit.run.program import Program
from driftfit.run.result import Track, track_record
from driftfit.run.shared_outputs import Shared
from driftfit.run.track_outputs import OutputsFleet, track_outputs
from driftfit.run.unlearned import warn_unlearned
from driftfit.run.warm_start import Run, carried, first_interval
from driftfit.trackers.base import Tracker

Trackers = Tracker | Sequence[Tracker] | Mapping[Any, Tracker]
"""One tracker for all, or one per setting of a grid or per series."""

Result = Track | Fleet | Outputs | Shared | OutputsFleet
"""The result of `track`, which depends on the number of series, of settings and of outputs."""


def track(
    model: Model, tracker: Trackers, y: Any, u: Any = None, reading: Reading | None = None, *, data: Any = None,
    by: str | Sequence[str] | None = None, keep: str = "std", warm_start: Any = None, prob: Any = None,
) -> Result:  # fmt: skip
    """Track the parameters of a model; arguments as for `driftfit.track`, with time and others in a `Reading`."""
    check_roles("track", model, tracker, several=True)
    one_of("track", "keep", keep, ("std", "cov"))
    reading = Reading() if reading is None else reading
    single = by is None and isinstance(tracker, Tracker) and len(model.outputs) == 1
    if prob is not None and not single:
        raise ValueError("track: prob= is for one series and one tracker.")
    if len(model.outputs) > 1:
        return track_outputs(model, tracker, y, u, data, by, reading, keep, warm_start)
    records, failed = records_of(y, u, reading, data, by)
    records = records.for_model(model, reading)
    bound = model.bind(records.labels.u or records.u.shape[1])
    bound.inspect(records.y, records.u)
    if single:
        assert isinstance(tracker, Tracker)
        records = records.told(bound, [_checked(tracker, keep)], prob)
        run = _one(Program(bound, tracker), records.part(0), keep, warm_start)
        warn_unlearned(run)
        return run
    if by is None and not isinstance(tracker, Tracker):
        names = tuple(tracker) if isinstance(tracker, Mapping) else tuple(range(len(tracker)))
        records = records.repeated(names)
    trackers = _per_series(tracker, records.keys)
    for one in set(trackers):
        _checked(one, keep)
    programs = {one: Program(bound, one) for one in trackers}
    records = records.told(bound, trackers)
    fleet = run_fleet([programs[one] for one in trackers], records, keep, failed, warm_start)
    warn_unlearned(fleet)
    return fleet


def track_one(
    model: Model, tracker: Tracker, y: Any, u: Any = None, reading: Reading | None = None, keep: str = "std",
    warm_start: Run | None = None,
) -> Track:  # fmt: skip
    """`track` for one series of one output with one tracker."""
    run = track(model, tracker, y, u, reading, keep=keep, warm_start=warm_start)
    assert isinstance(run, Track)
    return run


def records_of(
    y: Any, u: Any, reading: Reading, data: Any = None, by: Any = None
) -> tuple[Records, dict[Hashable, str]]:
    """The records to be run, from arrays or a table, and the reasons of those that cannot be."""
    if data is not None:
        # imported here, because narwhals and polars take as long to import as everything else
        from driftfit.data.tables import read_records

        return read_records(data, y, u, by, reading)
    if by not in (None, "row"):
        raise ValueError(
            f"track: by={by!r} names a column of a table, so data= is needed; rows of arrays are by='row'."
        )
    if reading.units is not None:
        raise ValueError("track: units= maps the names of columns to their units, so data= is needed.")
    return (rows if by == "row" else one_series)(y, u, reading), {}


def _checked(tracker: Tracker, keep: str) -> Tracker:
    """The tracker, if its settings are complete and it can keep what is requested."""
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


def _one(program: Program, record: Record, keep: str, before: Run | None) -> Track:
    """Run one series."""
    start = None
    if before is not None:
        (start,) = carried(before, [program])
        begins = None if record.time is None else record.time[0]
        record = replace(record, known=record.known.begun({0: first_interval(before, begins, record.labels)}))
    return track_record(program, record, keep, start)

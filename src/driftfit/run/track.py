"""Record mode: whole series in one call, causal at every sample. The public function is `driftfit.track`.

`decide` makes one decision for many candidates: which readings are left out is decided by one run, and holds for all.
The reference is `AdaptiveKalman` on the largest of the models, so the decision depends neither on the settings that are
tried nor on their number. Refused readings are missing for every candidate, and samples with a refused input have no
weight, so that likelihoods are of the same readings.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.arguments import check_roles, fits
from driftfit.data.arrays import columns_as_outputs, from_arrays
from driftfit.data.record import Reading, Record, Records
from driftfit.engine.settings import near, one_of, warn
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.readings.left_out import NOTHING_LEFT_OUT, LeftOut
from driftfit.readings.screen import apart, screen
from driftfit.run.fleet import Fleet, KeyedResults, Outputs, run_fleet
from driftfit.run.lanes import Lane, Lanes
from driftfit.run.program import Program, State, programs_of, tile_of
from driftfit.run.result import Track, track_record
from driftfit.run.warm_start import Run, carried, ended, first_interval
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.base import Tracker

KEPT = ("std", "cov", "theta")
NAMED = 3
"""Values that a warning names at most."""

Trackers = Tracker | Sequence[Tracker] | Mapping[Any, Tracker]
"""One tracker for all, or one per setting of a grid or per series."""

BYTES_AT_ONCE = 16_000_000
"""Bytes of results that `parts` holds at a time; a table of them and the writer of Parquet take some six times as much.
With four times as many a series costs a quarter more, in memory that the process touches for the first time.
"""

Result = Track | Fleet | Outputs
"""The result of `track`, which depends on the number of series, of settings and of outputs."""


def track(
    model: Model, tracker: Trackers, y: Any, u: Any = None, reading: Reading | None = None, *, data: Any = None,
    by: str | Sequence[str] | None = None, keep: str = "std", dtype: Any = "float64", warm_start: Any = None,
    prob: Any = None,
) -> Result:  # fmt: skip
    """Track the parameters of a model; arguments as for `driftfit.track`, with time and others in a `Reading`."""
    programs, records, failed, many = _task(model, tracker, y, u, reading, data, by, Kept(keep, dtype, prob))
    if many and warm_start is not None and not isinstance(warm_start, Mapping | Fleet):
        raise ValueError(
            "warm_start: with by= or a grid pass the result of such a run, or a mapping from key to its end or bytes; "
            f"got {warm_start!r}."
        )
    run: Any
    if many:
        run = run_fleet(programs, records, keep, failed, warm_start, dtype)
    else:
        run = _one(programs, records, keep, warm_start, dtype)
    warn_unlearned(run)
    warn_astray(run)
    warn_ungated(run)
    return run  # type: ignore[no-any-return]


def run_quietly(
    model: Model, tracker: Trackers, y: Any, u: Any, reading: Reading, data: Any = None, by: Any = None
) -> Result:
    """`track` for its regressors, readings or likelihood: nothing is said of estimates that are not looked at."""
    programs, records, failed, many = _task(model, tracker, y, u, reading, data, by, Kept())
    return run_fleet(programs, records, "std", failed) if many else _one(programs, records, "std", None, "float64")


def parts(
    model: Model, tracker: Trackers, y: Any, u: Any = None, reading: Reading | None = None, *, data: Any = None,
    by: str | Sequence[str] | None = None, keep: str = "std", dtype: Any = "float64",
) -> Iterator[Fleet]:  # fmt: skip
    """`track` for many series, some of them at a time, so that their results need little memory."""
    programs, records, failed, many = _task(model, tracker, y, u, reading, data, by, Kept(keep, dtype))
    if not many:
        raise ValueError("track: to= is for many series: give by=, or several trackers.")
    ny = records.ny
    if not records.keys:
        yield run_fleet(programs, records, keep, failed, dtype=dtype)
        return
    row = programs[0].written(programs[0].tile(), 0, keep, dtype).dtype.itemsize * ny
    upto = np.cumsum(records.length) * row // BYTES_AT_ONCE
    bounds = [0, *(np.flatnonzero(np.diff(upto)) + 1).tolist(), len(records.keys)]
    for k, (a, b) in enumerate(pairwise(bounds)):
        yield run_fleet(programs[a * ny : b * ny], records.some(a, b), keep, {} if k else failed, dtype=dtype)


class Kept(NamedTuple):
    """What is stored for every sample, in which precision, and the known prior probabilities of events."""

    keep: str = "std"
    dtype: Any = "float64"
    prob: Any = None


def _task(
    model: Model, tracker: Trackers, y: Any, u: Any, reading: Reading | None, data: Any, by: Any, kept: Kept
) -> tuple[list[Program], Records, Mapping[Hashable, str], bool]:
    """(the program of each output of each series, the checked series, units without data with the reasons, whether the
    result is a fleet)."""
    alone = fits(type(model), type(tracker)) or check_roles("track", model, tracker, several=True)
    if data is not None:
        model, y = columns_as_outputs(model, y)
    if kept.keep not in KEPT:
        one_of("track", "keep", kept.keep, KEPT)
    if kept.dtype != "float64":  # the default, whose name NumPy would look up for a microsecond
        one_of("track", "dtype", np.dtype(kept.dtype).name, ("float64", "float32"))
    if kept.keep == "theta" and len(model.outputs) > 1:
        raise ValueError("track: keep='theta' is for models of one output.")
    reading = Reading() if reading is None else reading
    model, records, failed = records_of(model, y, u, reading, data, by)
    records, gate = records.for_model(model, reading), reading.gate
    if isinstance(gate, LeftOut | Mapping):
        (records, _), gate = decided(model, records, gate), False
    # several trackers, other than one for each output
    grid = not alone and not (isinstance(tracker, Mapping) and bool(records.outputs))
    many = grid or by is not None
    if kept.prob is not None and (many or len(model.outputs) > 1):
        raise ValueError("track: prob= is for one series and one tracker.")
    if grid and by is None:
        if gate:  # one decision for all settings
            records, gate = decide(model, records, gate)[0], False
        records = records.repeated(tuple(tracker) if isinstance(tracker, Mapping) else tuple(range(len(tracker))))  # type: ignore[arg-type]
    trackers = (_per_series(tracker, records) if grid else [tracker] * len(records.keys)) or _any_of(tracker)
    programs, records = _prepared(model, trackers, records, kept.keep, kept.prob, gate)
    return programs, records, failed, many


def _prepared(
    model: Model, trackers: Sequence[Any], records: Records, keep: str, prob: Any, gate: Any
) -> tuple[list[Program], Records]:
    """(the program of each output of each series, the records as these take them)."""
    inputs = records.labels.u or records.u.shape[-1]
    made: dict[int, tuple[Program, ...]] = {}
    programs: list[Program] = []
    for one in trackers:
        if id(one) not in made:
            made[id(one)] = programs_of(model, one, inputs, gate)
        programs += made[id(one)]
    for program in programs if keep == "cov" else ():
        if not program.tracker.covariance:
            raise ValueError(f"track: {type(program.tracker).__name__} carries no covariance to keep; use keep='std'.")
    for lane, program in enumerate(programs[: records.ny]):
        if program.shared is None:
            y = records.y[:, lane] if records.outputs else records.y
            own = program if program.alone is None else program.alone
            if own.inspects:
                own.model.inspect(y, records.u)
    records = records.for_trackers(programs[0].model, (program.tracker for program in programs), prob)
    return programs, records if programs[0].shared is None else records.in_rows()


def _any_of(tracker: Any) -> list[Any]:
    """Some tracker: a fleet without a series needs one for the names of its parameters."""
    some = tracker.values() if isinstance(tracker, Mapping) else [tracker] if isinstance(tracker, Tracker) else tracker
    return [next(iter(some))]


def records_of(
    model: Model, y: Any, u: Any, reading: Reading, data: Any = None, by: Any = None
) -> tuple[Model, Records, Mapping[Hashable, str]]:
    """(the model, its outputs named; the series; the reasons of those without data) from arrays or a table."""
    if data is None and by not in (None, "row"):
        raise ValueError(
            f"track: by={by!r} names a column of a table, so data= is needed; rows of arrays are by='row'."
        )
    if data is None and reading.units is not None:
        raise ValueError("track: units= maps the names of columns to their units, so data= is needed.")
    failed: Mapping[Hashable, str] = {}
    if data is None:
        model, records = from_arrays(model, y, u, reading, by == "row")
    else:
        # imported here, because narwhals and polars take as long to import as everything else
        from driftfit.data.tables import from_table

        model, records, failed = from_table(model, y, u, data, by, reading)
    columns = _flat(y, u, reading.time) if reading.units else []
    for name in reading.units or ():
        if name not in columns:
            raise ValueError(f"track: units: no signal has the name {name!r}; {near(str(name), columns)}")
    return model, records, failed


def _flat(*names: Any) -> list[str]:
    """Names of columns, which a model with shared parameters takes in lists of lists."""
    each = ([one] if isinstance(one, str) else _flat(*one) for one in names if one is not None)
    return [name for part in each for name in part]


def _per_series(tracker: Trackers, records: Records) -> list[Any]:
    """The tracker of each series, of several that are given: one for all its outputs, or one for each by its name."""
    keys = records.keys
    if isinstance(tracker, Mapping):
        absent = [key for key in keys if key not in tracker]
        if absent:
            raise ValueError(
                f"track: settings are missing for {len(absent)} of {len(keys)} series, such as {absent[0]!r}."
            )
        return [tracker[key] for key in keys]
    assert isinstance(tracker, Sequence)
    if len(tracker) != len(keys):
        raise ValueError(f"track: {len(tracker)} trackers were given for {len(keys)} series.")
    return list(tracker)


def _one(programs: Sequence[Program], records: Records, keep: str, before: Run | None, dtype: Any) -> Track | Outputs:
    """Run one series."""
    program, record = programs[0], records.part(0)
    starts: tuple[State, ...] = ()
    if before is not None:
        before = ended(before, programs)
        starts = carried(before, programs)
        begins = None if record.time is None else record.time[0]
        record = replace(record, known=record.known.begun({0: first_interval(before, begins, record.labels)}))
    tile = tile_of(programs, starts)
    out = program.run(tile, record, keep, dtype)
    if records.outputs:
        each = np.arange(records.ny)
        lanes = Lanes([(out, tile, each, each)], np.full(records.ny, len(record)))
        return Outputs(programs, records._replace(known=record.known), lanes, {}, dict(enumerate(starts)))
    left_out = records.left_out.get(records.keys[0], NOTHING_LEFT_OUT)
    return Track(program, record, Lane(out, tile), starts[0] if starts else None, left_out)


def warn_astray(run: Track | KeyedResults) -> None:
    """Warn of a model linearised at its estimates whose predictions are no longer of the size of the output."""
    if not isinstance(run, Track) or not 0.0 < 2.0 * run.program.settling <= len(run):
        return
    late = slice(len(run) // 2, None)
    e, y = run.innovation[late], run.record.y[late]
    error, varies = float(np.nanmedian(np.abs(e))), float(np.nanstd(y)) if np.isfinite(y).any() else 0.0
    if varies > 0.0 and error > varies:
        warn(
            f"{type(run.model).__name__} with {type(run.tracker).__name__}: half the prediction errors in the second "
            f"half of the record are above {error:.3g}, but y varies by {varies:.3g}: the estimates went astray. "
            "Disturbances that pass through the plant call for ARX or ARMAX, large means for offset=True or deviations "
            "from them; gradients (RLS) are more robust than instruments.",
            UserWarning,
        )


def warn_ungated(run: Result, verb: str = "track") -> bool:
    """Warn once, for any number of series, of readings that look like codes and that no gate judged; says whether."""
    programs = [run.program] if isinstance(run, Track) else run.programs
    if all(one.gate is not None for one in programs):
        return False
    given = run.record if isinstance(run, Track) else run.records
    ny, rows = len(run.model.outputs) or 1, len(programs[0].rows) or 1
    y, u = given.y.reshape(-1, ny), given.u.reshape(len(given.y) // rows, rows * given.u.shape[-1])
    given = Records.of(given) if isinstance(given, Record) else given
    first, length = given.first // rows, given.length // rows
    inputs = np.any([screen(signal, first, length) for signal in u.T], axis=0) if u.shape[-1] else False
    may = np.stack([screen(signal, first, length) | inputs for signal in y.T], axis=1).reshape(-1, rows)
    return bool(may.any()) and warn_of_codes(verb, [run] if isinstance(run, Track) else run.some(np.any(may, axis=1)))


def warn_of_codes(verb: str, runs: Iterable[Track]) -> bool:
    """Warn of the readings of runs without a gate that one would have refused; says whether there are any."""
    found: defaultdict[str, list[float]] = defaultdict(list)
    linear = True
    for run in runs:
        for name, values in {} if run.program.gate else _codes(run).items():
            found[name] += values
            linear &= run.model.hidden is None and not (run.model.implicit or run.program.settling)
    if found:
        said = "; ".join(_named(name, values) for name, values in found.items())
        lasting = "" if linear else " An estimate of a model that is not linear in theta may not come back from them."
        warn(f"{verb}: {said}. Such readings enter the estimate; gate=True leaves them out.{lasting}")
    return bool(found)


def _named(name: str, values: Sequence[float]) -> str:
    different = list(dict.fromkeys(values))
    named = ", ".join(f"{value:g}" for value in different[:NAMED]) + (", .." if len(different) > NAMED else "")
    which = "value looks like a fault code" if len(values) == 1 else "values look like fault codes"
    return f"{name}: {len(values)} {which} ({named})"


def _codes(run: Track) -> dict[str, list[float]]:
    """The values of each signal, far apart from all others, that a run with a gate leaves out."""
    signals = np.column_stack([run.record.y, run.record.u]).reshape(len(run), -1).T
    far = [np.flatnonzero(apart(signal)) for signal in signals]
    if not any(map(len, far)):
        return {}
    left, found = track_record(replace(run.program, gate=Gate()), run.record).left_out, {}
    names, given = run.program.signals, (run.labels.y, *run.labels.u)
    labels = names if run.program.rows else (*given, *names[len(given) :])
    for name, label, signal, places in zip(names, labels, signals, far, strict=True):
        ages = 0 if name == names[0] else run.program.model.steps.ages
        blamed = left.sample[left.signal == name][:, None] - np.arange(ages + 1)
        found[label] = signal[np.intersect1d(blamed, places)].tolist()
    return {label: values for label, values in found.items() if values}


def warn_unlearned(run: Track | KeyedResults) -> None:
    """Warn of the parameters that `Tracker.unlearned` marks."""
    if isinstance(run, Track):
        ends = [(run.program, run.state)] if np.inf in run.last_var.tolist() else []
    else:
        ends = list(run.undetermined())
    if not ends:
        return
    found, counts, owners = 0, Counter[str](), []
    for program, state in ends:
        missed = [name for name, left in zip(program.names, program.tracker.unlearned(state), strict=True) if left]
        found += bool(missed)
        counts.update(missed)
        owners += [type(program.tracker).__name__] if missed else []
    if not found:
        return
    named = ", ".join(counts)
    if not isinstance(run, Track):
        named = (
            f"in {found} of {len(run.keys())} series {', '.join(f'{name} ({k})' for name, k in counts.most_common())}"
        )
    reason = "its regressor" if len(counts) == 1 else "their regressors"
    warn(
        f"{owners[0]}: {named} could not be learned, because {reason} never varied separately from the "
        "others: std is inf. The other parameters are not affected; to avoid this warning leave out columns that are "
        "constant or repeat another.",
        UserWarning,
    )


Decisions = Mapping[Hashable, LeftOut]
"""What was left out of each series, by its key."""


def decide(model: Model, records: Records, gate: Any) -> tuple[Records, Decisions]:
    """(the series as every candidate takes them, what was left out of each), given the largest model and a
    gate (None or False: none), or decisions that were made before; ValueError for a model that the reference does not
    follow.
    """
    if gate is None or gate is False:
        return records, {}
    if not isinstance(gate, LeftOut | Mapping):
        if model.hidden is not None:
            raise ValueError(
                f"gate: {type(model).__name__} has no reference run that could decide; give the decisions of a run, "
                "gate=track(model, tracker, y, u, gate=True).left_out."
            )
        reference = AdaptiveKalman()
        programs = programs_of(model, reference, records.labels.u or records.u.shape[-1], gate)
        given = records.in_rows() if model.shared else records
        runs = (_one(programs, given.some(k, k + 1), "std", None, "float64") for k in range(len(records.keys)))
        left: Any = [
            run.left_out if isinstance(run, Track) else {j: run[j].left_out for j in run.outputs} for run in runs
        ]
        gate = dict(zip(records.keys, left, strict=True))
    return decided(model, records, gate)


def decided(model: Model, records: Records, gate: Any) -> tuple[Records, Decisions]:
    """The series with decisions that were made before: of one series, or by its key; of several outputs by their names,
    and of outputs that share one theta together."""
    if isinstance(gate, LeftOut) or (records.outputs and set(gate) == set(records.outputs)):
        if len(records.keys) > 1:
            raise ValueError("gate: decisions of one run are for one series; give a mapping from every key to its own.")
        gate = {records.keys[0]: gate}
    if records.outputs and not model.shared:
        if any(isinstance(one, LeftOut) for one in gate.values()):
            raise ValueError("gate: decisions are those of one output; give those of each by its name, run.left_out.")
        gate = {(key, name): one for key, own in gate.items() for name, one in own.items()}
    y, noise = records.y.copy(), np.array(np.broadcast_to(records.known.noise, records.y.shape))
    for k, key in enumerate(records.keys):
        part = slice(records.first[k], records.first[k] + records.length[k])
        places = {(key, name): (part, j) for j, name in enumerate(records.outputs)} | {key: (part,)}
        for at, one in ((at, gate[own]) for own, at in places.items() if own in gate):
            changed = one.applied(y[at].ravel(), noise[at].ravel())
            y[at], noise[at] = (values.reshape(y[at].shape) for values in changed)
    return records._replace(y=y, known=records.known.changed(noise=noise), left_out=gate), gate

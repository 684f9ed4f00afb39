"""Results by key: series of a fleet, settings of a grid and outputs of a record are lanes with keys.

Their common part is a mapping from key to `Track`, their copies, and their files. Several outputs are

    ARX(.., ny=2), Regression(n, ny=2)     yo_t = phi_t' theta_o,t + v_o,t     the outputs are lanes of one tile
    Regression(n, ny=2, shared=True)       yo_t = phi_o,t' theta_t + v_o,t     one Track, see `driftfit.run.columns`

Each output may have its own settings, as a mapping from its name to its tracker; all trackers are of one kind, because
they share the compiled step. Each output of a record is a `Track` (``run["level"]``): a regression on the regressors
that the joint run used, with all methods of a Track.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, KeysView, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from driftfit.data.record import Labels, Record, Records
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near, warn
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.readings.left_out import NOTHING_LEFT_OUT
from driftfit.run.columns import COLLECTED, OfRecord, attribute, collect
from driftfit.run.gating import left_out_of
from driftfit.run.lanes import Lane, Lanes, Results, decided_record, names_of, read_results, write_results
from driftfit.run.parallel_lanes import run_lanes
from driftfit.run.program import PROGRESS_SAMPLES, Program, State, kept, lanes_of, shown, state_of, tile_of
from driftfit.run.result import Plain, Track
from driftfit.run.warm_start import End, Run, carried, ended, first_interval
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    import polars


class KeyedResults(Plain):
    """Results of many lanes, from key to `Track` like a dict; ``by`` names the parts of a key.

    ``programs``, ``lanes`` and ``starts`` have an entry for each output of each series of ``records``, in that order;
    without a series there are the programs of some tracker, so that parameters have names.
    """

    _kind: ClassVar[str]

    programs: tuple[Program, ...]
    """The program of each lane; without a series, those of some tracker."""
    failed: dict[Hashable, str]
    """The reason why a series has no result."""

    def __init__(
        self,
        programs: Sequence[Program],
        records: Records,
        lanes: Lanes,
        failed: Mapping[Hashable, str],
        starts: Mapping[int, State],
    ) -> None:
        self.records = records
        self.failed = dict(failed)
        self.programs = tuple(programs)
        self._lanes = lanes
        self._starts = dict(starts)
        done = self._lanes.done.tolist()
        self._index = {key: j for j, key in enumerate(self._named()) if done[j]}

    def __reduce__(self) -> Any:
        """A copy does not contain other series of a tile."""
        alone = {j: self._lanes[j].alone(self.programs[j]) for j in self._index.values()}
        lanes = Lanes.of(alone, len(self._lanes))
        return type(self), (self.programs, self.records, lanes, self.failed, self._starts)

    def _named(self) -> Sequence[Hashable]:
        """The key of every lane."""
        raise NotImplementedError

    def _run(self, j: int) -> Track:
        """The result of lane j."""
        raise NotImplementedError

    @property
    def by(self) -> tuple[str, ...]:
        """Names of the parts of a key."""
        raise NotImplementedError

    @property
    def model(self) -> Model:
        """The model of all series, with all their outputs."""
        return self.programs[0].whole

    @property
    def labels(self) -> Labels:
        """Names and units of the signals."""
        return self.records.labels

    @property
    def dropped(self) -> dict[str, int]:
        """Rows that never became samples, by reason."""
        return dict(sum((Counter(counts) for counts in self.records.dropped.values()), Counter()))

    @property
    def nbytes(self) -> int:
        """Bytes of the results of all series."""
        length = self._lanes.length
        each = ((out, tile["theta"].shape[-1], length[lanes].sum()) for out, tile, lanes, _ in self._lanes.tiles)
        return sum(out.dtype.itemsize // L * int(samples) for out, L, samples in each)

    def __len__(self) -> int:
        return len(self._index)

    def __iter__(self) -> Iterator[Hashable]:
        return iter(self._index)

    def keys(self) -> KeysView[Hashable]:
        """Keys of the results."""
        return self._index.keys()

    def values(self) -> Iterator[Track]:
        """The results."""
        return map(self._run, self._index.values())

    def items(self) -> Iterator[tuple[Hashable, Track]]:
        """Keys and results."""
        return ((key, self._run(j)) for key, j in self._index.items())

    def some(self, wanted: Array) -> Iterator[Track]:
        """The results of some lanes, of which ``wanted`` has an entry for each."""
        return (self._run(j) for j in self._index.values() if wanted[j])

    def undetermined(self) -> Iterator[tuple[Program, dict[str, Array]]]:
        """The programs and final states of the lanes whose record does not determine every parameter."""
        for _, tile, lanes, places in self._lanes.tiles:
            for k in np.flatnonzero(np.isinf(tile["var"][0]).any(axis=0)[places]).tolist():
                yield self.programs[lanes[k]], state_of(tile, places[k])

    def stack(self, name: str) -> Array:
        """One result of every lane in natural order, (lanes, T, ...), NaN after the end of a series.

        ``name`` is that of an attribute of `Track`: "theta", "std", "prediction", "innovation", "innovation_std".
        """
        parts = [np.asarray(getattr(run, name), dtype=float) for run in self.values()]
        longest = max(len(part) for part in parts)
        stacked = np.full((len(parts), longest, *parts[0].shape[1:]), np.nan)
        for row, part in zip(stacked, parts, strict=True):
            row[: len(part)] = part
        return stacked

    def save(self, path: str | PathLike[str]) -> None:
        """Write all results to one file without pickle, completely or not at all.

        Keys must be text, numbers, times, or tuples of them.
        """
        results = Results(self.programs, self.records, self._lanes, self.failed, self._starts)
        write_results(path, self._kind, results)

    @classmethod
    def load(cls, path: str | PathLike[str], classes: Iterable[Any] = ()) -> Self:
        """Read a file that `save` wrote; ``classes`` are classes and functions of your own that it needs."""
        return cls(*read_results(path, cls._kind, classes))


def table_by_key(
    by: Sequence[str], keys: Iterable[Hashable], often: Sequence[int], columns: Mapping[str, Any]
) -> polars.DataFrame:
    """Columns beside the keys, key k in ``often[k]`` rows: each part under its name in ``by``, and of its own type.

    A column that is called like a part of the key has "_" after its name.
    """
    import polars

    parts = [key if isinstance(key, tuple) else (key,) for key in keys]
    rows = np.repeat(np.arange(len(parts)), often)
    table = {name: polars.Series([part[place] for part in parts]).gather(rows) for place, name in enumerate(by)}
    return polars.DataFrame(table | {f"{name}_" if name in table else name: one for name, one in columns.items()})


class Outputs(KeyedResults, OfRecord):
    """A record with several outputs, each with its own theta.

    Attributes
    ----------
    theta, std : (T, ny, n)
    prediction, innovation, innovation_std, ok : (T, ny)
        As in `Track`, output by output.
    outputs : tuple of str
        Names of the outputs; ``run[name]`` is the Track of one.
    names : tuple of tuples of str
        Names of the parameters of each output.
    trackers : tuple of Tracker
        The tracker of each output.
    """

    _kind = "outputs of a record"
    outputs: tuple[str, ...] = attribute("records.outputs")

    @cached_property
    def record(self) -> Record:
        """The record, y (T, ny)."""
        return self.records.part(0)

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        return tuple(one.names for one in self.programs)

    @property
    def trackers(self) -> tuple[Tracker, ...]:
        return tuple(one.tracker for one in self.programs)

    @property
    def by(self) -> tuple[str, ...]:
        return ("output",)

    def _named(self) -> Sequence[Hashable]:
        return self.records.outputs

    def __len__(self) -> int:
        return len(self.record)

    def __repr__(self) -> str:
        used = ", ".join(f"{name} {int(ok)}" for name, ok in zip(self.outputs, self.ok.sum(axis=0), strict=True))
        return f"Outputs of {len(self)} samples, used: {used}: {self.model!r}, {shown(self.trackers)}"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(missing(name, self.outputs[0]) if not name.startswith("_") else name)

    def in_rows(self, name: str) -> Array:
        """A field of the driver's output, (T, ny, ..)."""
        if name not in self._stacked:
            self._stacked[name] = np.stack([lane.written(name) for lane in self._lanes], axis=1)
        return self._stacked[name]

    @cached_property
    def _stacked(self) -> dict[str, Array]:
        return {}

    @cached_property
    def loglik(self) -> float:
        """Sum over the outputs: their noises are assumed to be independent."""
        return sum(track.loglik for track in self.values())

    def band(self, level: float = 0.95, conformal: bool = False) -> tuple[Array, Array]:
        """(low, high), each (T, ny, n): pointwise bands of theta at this level; ``conformal`` as for `Track.band`."""
        low, high = zip(*(track.band(level, conformal) for track in self.values()), strict=True)
        return np.stack(low, axis=1), np.stack(high, axis=1)

    def cov(self, t: int) -> Array:
        """Covariances (ny, n, n) of the theta of each output after sample t."""
        return np.array([track.cov(t) for track in self.values()])

    @cached_property
    def _collected(self) -> Array:
        """The samples as the trackers received them once all was decided, with the regressors that outputs share."""
        return self.decided.replayed(collect, COLLECTED)

    @cached_property
    def decided(self) -> Outputs:
        """The run without the codes that its gate found among the first samples; see `Track.decided`."""
        if self._start_decided is None:
            return self
        record, starts, _ = self._start_decided
        tile, each = tile_of(self.programs, starts), np.arange(len(self.outputs))
        lanes = Lanes([(self.programs[0].run(tile, record), tile, each, each)], self._lanes.length)
        return Outputs(self.programs, self.records._replace(y=record.y, u=record.u), lanes, {}, dict(enumerate(starts)))

    @cached_property
    def _start_decided(self) -> Any:
        return decided_record(self.programs, self.record, self._starts, self.in_rows)

    def replayed(self, store: Any, fields: tuple[str, ...]) -> Array:
        """The run again, (T,) records of a lane for each output, with these fields as ``store`` writes them."""
        tile = tile_of(self.programs, [self._starts[j] for j in sorted(self._starts)])
        out = self.programs[0].inspected(tile, len(self), fields)
        steps = self.programs[0].steps._replace(store=store)
        self.programs[0].drivers(steps=steps).run(tile, *lanes_of(self.record), out)
        return out

    def __getitem__(self, output: str | int) -> Track:
        """The record of one output, by name or index."""
        if output not in self.outputs and output not in range(len(self.outputs)):
            raise KeyError(f"there is no output {output!r}; there are {', '.join(self.outputs)}.")
        return self._tracks[output if isinstance(output, int) else self.outputs.index(output)]

    @cached_property
    def _tracks(self) -> tuple[Track, ...]:
        return tuple(self._track(lane) for lane in range(len(self.outputs)))

    def _run(self, j: int) -> Track:
        return self._tracks[j]

    def _track(self, j: int) -> Track:
        """One output alone, as a regression whose regressors may contain the other outputs."""
        alone, y, u, lane = self.programs[j].alone, self.y[:, j], self.u, self._lanes[j]
        known, names = self.record.known.for_output(j), self.labels.u
        left = self.records.left_out.get((self.records.keys[0], self.outputs[j]), NOTHING_LEFT_OUT)
        units = dict(self.labels.units)
        if alone is None or self.decided is not self:
            found, names = self._collected, self.names[j]
            alone, known = Program(Regression(names), self.trackers[j]), known.changed(interval=found["dt"][:, j])
            signals = {("y", k): name for k, name in enumerate(self.outputs)}
            signals |= {("u", k): name for k, name in enumerate(self.labels.u)}
            held = [(name, signals.get(term[:2])) for name, term in zip(names, self.model.terms or (), strict=False)]
            units |= {name: units[source] for name, source in held if source in units}
            u = np.where(found["valid"][:, j, None] > 0.0, found["phi"][..., j], np.nan)
            if self.programs[j].gate is not None:
                used, start = self.decided.ok[:, j], self._start_decided
                left = left_out_of(self.programs[j], lane.written("reason"), y, used, start)
                y, noise = left.applied(y, known.noise)
                known = known.changed(noise=noise)
        tile = alone.tile()
        shapes = {name: value.shape for name, value in state_of(tile).items() if name != "u"}
        state = state_of(lane.tile, lane.lane)
        own = [name for name, shape in shapes.items() if shape == state[name].shape]
        for name in own:
            tile[name][0, ..., 0] = state[name]
        out = alone.written(tile, len(self), *kept(lane.out.dtype))
        for name in names_of(out):
            out[name][..., 0] = lane.written(name)
        start = {name: value for name, value in self._starts[j].items() if name in own} if self._starts else None
        others = tuple(f"of {name} " for name in self.outputs if name != self.outputs[j])
        missing = {reason: c for reason, c in self.record.labels.missing.items() if not reason.startswith(others)}
        labels = replace(self.record.labels, y=self.outputs[j], u=names, missing=missing, units=units)
        record = Record(y, u, known, self.record.time, labels)
        made = Track(alone, record, Lane(out, tile), start, left)
        vars(made).update({} if self.decided is self else {"decided": self.decided[j]})
        return made

    def __contains__(self, output: object) -> bool:
        return output in self.outputs

    def end(self) -> End:
        """The end of the run, from which another one can continue (`warm_start`)."""
        lanes = [state_of(lane.tile, lane.lane) for lane in self._lanes]
        states = tuple({name: value.copy() for name, value in lane.items()} for lane in lanes)
        labels = self.labels
        return End(self.programs, states, self.time[-1] if self.timed else None, dt=labels.dt, zone=labels.zone)


def missing(name: str, output: str) -> str:
    """The message for an attribute that a run of several outputs does not have."""
    if hasattr(Track.public(), name):
        return f"{name} is of one output at a time: run[{output!r}].{name}"
    known = [one for one in dir(Outputs.public()) if one[0] != "_"]
    return f"a run of several outputs has no {name!r}; {near(name, known)}"


class Fleet(KeyedResults):
    """Results of many series, from key to `Track` like a dict, in the order of the table.

    ``fleet[key]`` is a view, nothing is copied. ``failed`` maps the key of each series without a result to the reason.
    If series have several outputs, keys are (series, output), and ``fleet[series]`` is the record of one series with
    all of them, an `Outputs`. Outputs that share one theta are one Track.
    """

    _kind = "fleet"

    def _named(self) -> Sequence[Hashable]:
        keys = self.records.keys
        if not self.records.outputs:
            return keys
        return [(*_parts(key), output) for key in keys for output in self.records.outputs]

    @property
    def by(self) -> tuple[str, ...]:
        return (*self.records.labels.by, *(("output",) if self.records.outputs else ()))

    @cached_property
    def _series(self) -> dict[Hashable, int]:
        """The number of each series that has a result."""
        done = self._lanes.done[:: self.records.ny].tolist()
        return {key: k for k, key in enumerate(self.records.keys) if done[k]}

    def __getitem__(self, key: Hashable) -> Any:
        if key in self._series:
            return self._whole(self._series[key])
        if key in self._index:
            return self._run(self._index[key])
        if key in self.failed:
            raise KeyError(f"{key!r} has no result: {self.failed[key]}")
        some = ", ".join(repr(k) for k in list(self._index)[:5])
        more = ", ..." if len(self) > 5 else ""
        raise KeyError(f"the fleet has no {key!r}; it has {len(self)} keys: {some}{more}")

    def __contains__(self, key: object) -> bool:
        return key in self._index or key in self._series

    def series(self) -> dict[Hashable, Track | Outputs]:
        """Every record by the key of its series, with all its outputs."""
        return {key: self._whole(k) for key, k in self._series.items()}

    def states(self) -> dict[Hashable, bytes]:
        """The final state of every series, as bytes from which it can be continued: ``track(..., by=..,
        warm_start=fleet.states())``.

        Each is what `driftfit.Live.from_bytes` reads, too.
        """
        return {key: run.end().to_bytes() for key, run in self.series().items()}

    def _whole(self, k: int) -> Track | Outputs:
        """The record of series k."""
        if not self.records.outputs:
            return self._run(k)
        lanes = range(k * self.records.ny, (k + 1) * self.records.ny)
        starts = {place: self._starts[j] for place, j in enumerate(lanes) if j in self._starts}
        programs = [self.programs[j] for j in lanes]
        return Outputs(programs, self.records.some(k, k + 1), self._lanes.part(lanes), {}, starts)

    def _run(self, j: int) -> Track:
        if self.records.outputs:
            k, output = divmod(j, self.records.ny)
            return self._whole(k)[output]  # type: ignore[index]
        left_out = self.records.left_out.get(self.records.keys[j], NOTHING_LEFT_OUT)
        return Track(self.programs[j], self.records.part(j), self._lanes[j], self._starts.get(j), left_out)

    def __repr__(self) -> str:
        samples = sum(int(self.records.length[k]) for k in self._series.values())
        ny = len(self.model.outputs)
        what = f"{len(self._series)} series" + (f" with {ny} outputs" if ny > 1 else "")
        return f"Fleet of {what}, {samples} samples: {self.model!r}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, of all outputs."""
        return tuple(name for one in self.programs[: self.records.ny] for name in one.names)


def run_fleet(
    programs: Sequence[Program],
    records: Records,
    keep: str = "std",
    failed: Mapping[Hashable, str] | None = None,
    before: Mapping[Hashable, Run | bytes] | None = None,
    dtype: Any = np.float64,
) -> Fleet:
    """Run every series by its programs (one for each output) and return the results; all have one bound model.

    ``failed`` gives the reasons why units did not become series, ``before`` the earlier runs that series continue. An
    interrupt (Ctrl-C) stops the fleet and returns what is finished, with a warning.
    """
    if not records.keys:
        return Fleet(programs, records, Lanes.of({}, 0), failed or {}, {})
    starts, records = _begun(programs, records, before or {})
    _check_memory(programs, records, keep, dtype)
    lanes = run_lanes(programs, records, keep, starts, dtype)
    done = lanes.done[:: records.ny].tolist()
    series = zip(records.keys, done, strict=True)
    absent = {key: "interrupted before it was run" for key, finished in series if not finished}
    if absent:
        warn(
            f"interrupted: {sum(done)} of {len(done)} series are finished; the others are listed in fleet.failed.",
            UserWarning,
        )
    return Fleet(programs, records, lanes, {**(failed or {}), **absent}, starts)


def _check_memory(programs: Sequence[Program], records: Records, keep: str, dtype: Any) -> None:
    """Warn before the run of results that exceed the memory of this machine."""
    samples = int(records.length.sum()) * records.ny
    if samples > PROGRESS_SAMPLES:
        size = samples * programs[0].written(programs[0].tile(), 0, keep, dtype).dtype.itemsize / 1e9
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
        if size > memory:
            warn(
                f"track: the results of {len(records.keys)} series take {size:.0f} GB, and this machine has "
                f"{memory:.0f} GB of memory. keep='theta' and dtype='float32' store less, and to= writes the results "
                "to a folder as they come."
            )


def _begun(
    programs: Sequence[Program], records: Records, before: Mapping[Hashable, Run | bytes]
) -> tuple[dict[int, State], Records]:
    """(fields that lanes take over, by their number; the records with the intervals since the earlier runs)."""
    starts: dict[int, State] = {}
    factors: dict[int, float] = {}
    ny = records.ny
    if before and records.keys and not any(key in before for key in records.keys):
        warn(
            f"warm_start: all series start from the beginning, because the earlier run has none of them: the first is "
            f"{records.keys[0]!r} here and {next(iter(before))!r} there."
        )
    for k, key in enumerate(records.keys):
        if key in before:
            first, lanes = int(records.first[k]), range(k * ny, (k + 1) * ny)
            own = [programs[j] for j in lanes]
            run = ended(before[key], own)
            starts |= zip(lanes, carried(run, own), strict=True)
            if records.time is not None:
                factors[first] = first_interval(run, records.time[first], records.labels)
    return starts, records._replace(known=records.known.begun(factors)) if factors else records


def _parts(key: Hashable) -> tuple[Hashable, ...]:
    return key if isinstance(key, tuple) else (key,)

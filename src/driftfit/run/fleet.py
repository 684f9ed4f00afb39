"""Fleets: many series, many settings for one series, or many records of several outputs; results by key."""

from __future__ import annotations

import os
import warnings
from collections.abc import Hashable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from driftfit.data.record import Records
from driftfit.engine.settings import warn
from driftfit.readings.left_out import NOTHING_LEFT_OUT
from driftfit.run.keyed_results import KeyedResults
from driftfit.run.lanes import Lanes
from driftfit.run.outputs import Outputs
from driftfit.run.parallel_lanes import run_lanes
from driftfit.run.program import PROGRESS_SAMPLES, Program, State
from driftfit.run.result import Track
from driftfit.run.warm_start import Run, carried, ended, first_interval


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
        raise KeyError(self._absent(key))

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
        programs = [self._programs[j] for j in lanes]
        return Outputs(programs, self.records.some(k, k + 1), self._lanes.part(lanes), {}, starts)

    def _run(self, j: int) -> Track:
        if self.records.outputs:
            k, output = divmod(j, self.records.ny)
            whole = self._whole(k)
            assert isinstance(whole, Outputs)
            return whole[output]
        left_out = self.records.left_out.get(self.records.keys[j], NOTHING_LEFT_OUT)
        return Track(self._programs[j], self.records.part(j), self._lanes[j], self._starts.get(j), left_out)

    def _absent(self, key: Hashable) -> str:
        if key in self.failed:
            return f"{key!r} has no result: {self.failed[key]}"
        some = ", ".join(repr(k) for k in list(self._index)[:5])
        return f"the fleet has no {key!r}; it has {len(self)} keys: {some}{', ...' if len(self) > 5 else ''}"

    def __repr__(self) -> str:
        samples = sum(int(self.records.length[k]) for k in self._series.values())
        ny = len(self.model.outputs)
        what = f"{len(self._series)} series" + (f" with {ny} outputs" if ny > 1 else "")
        return f"Fleet of {what}, {samples} samples: {self.model!r}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, of all outputs."""
        return tuple(name for one in self._programs[: self.records.ny] for name in one.names)


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
        warnings.warn(
            f"interrupted: {sum(done)} of {len(done)} series are finished; the others are listed in fleet.failed.",
            stacklevel=3,
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

"""Fleets: many series, or many settings for one series, in parallel in the lanes of tiles, on all cores.

A tile holds up to thirty-two series of one model and one kind of tracker; the compiled step works on all its lanes at
once. Tiles are distributed over a pool of threads, which run in parallel because compiled code releases the GIL. Every
lane does the same arithmetic in the same order as its series would alone, so results agree bit for bit.

Series are sorted by length, so that those of one tile end at about the same time. A lane whose series has ended
continues with dt = 0 and no output, which changes only the lags of its model; its state is copied when its series ends.
"""

from __future__ import annotations

import os
import threading
import warnings
from collections import Counter, defaultdict
from collections.abc import Hashable, Iterator, KeysView, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from driftfit.data.record import Records
from driftfit.engine.drivers import repeat_tile
from driftfit.engine.kernel import Array, Driver
from driftfit.models.base import Model
from driftfit.run.program import Program, State, tile_of
from driftfit.run.public_class import Plain
from driftfit.run.result import Lane, Track
from driftfit.run.warm_start import carried, first_interval
from driftfit.trackers.base import Tracker

BLOCK = 256
"""Number of samples that are copied into lane order at a time: a block of a tile fits into the second-level cache."""

FEWEST = 10
"""Fewer series than this are run one by one: a tile of 32 lanes costs as much as about ten single lanes."""

LARGEST = 10
"""With more parameters than this loops over lanes stay scalar and are slower than single lanes (docs/design.md)."""

SHOWN = 1_000_000
"""Samples above which a progress bar appears."""


_thread = threading.local()


class Many(Plain):
    """Results of many series, from key to `Track` like a dict; ``by`` names the meaning of the keys."""

    failed: dict[Hashable, str]
    """The reason why a key has no result."""

    @property
    def by(self) -> tuple[str, ...]:
        """Names of what identifies the results, one for each part of a key."""
        raise NotImplementedError

    def runs(self) -> dict[Hashable, Track]:
        """Every single result with its key."""
        raise NotImplementedError

    @property
    def dropped(self) -> dict[str, int]:
        """Rows that never became samples, by reason."""
        return dict(sum((Counter(run.labels.dropped) for run in self.runs().values()), Counter()))

    def stack(self, name: str) -> Array:
        """One result of every series in natural order, (series, T, ...), NaN after a series' end.

        ``name`` is that of an attribute of `Track`: "theta", "std", "prediction", "innovation", "innovation_std".
        """
        parts = [np.asarray(getattr(run, name), dtype=float) for run in self.runs().values()]
        longest = max(len(part) for part in parts)
        stacked = np.full((len(parts), longest, *parts[0].shape[1:]), np.nan)
        for row, part in zip(stacked, parts, strict=True):
            row[: len(part)] = part
        return stacked


class Fleet(Many):
    """Results of many series, from key to `Track` like a dict, in the order of the table.

    ``fleet[key]`` is a view, nothing is copied. ``failed`` maps the key of each series without a result to the reason.
    """

    def __init__(
        self,
        programs: Sequence[Program],
        records: Records,
        lanes: Sequence[Lane | None],
        failed: Mapping[Hashable, str],
        starts: Mapping[int, State],
    ) -> None:
        self.records = records
        self.failed = dict(failed)
        self._programs = programs
        self._lanes = lanes
        self._starts = starts
        self._index = {key: k for k, key in enumerate(records.keys) if lanes[k] is not None}

    def __getitem__(self, key: Hashable) -> Track:
        try:
            k = self._index[key]
        except KeyError:
            raise KeyError(self._absent(key)) from None
        return self._track(k)

    def _track(self, k: int) -> Track:
        record, lane = self.records.part(k), self._lanes[k]
        assert lane is not None
        return Track(self._programs[k], record, lane._replace(out=lane.out[: len(record)]), self._starts.get(k))

    def _absent(self, key: Hashable) -> str:
        if key in self.failed:
            return f"{key!r} has no result: {self.failed[key]}"
        some = ", ".join(repr(k) for k in list(self._index)[:5])
        return f"the fleet has no {key!r}; it has {len(self)} keys: {some}{', ...' if len(self) > 5 else ''}"

    @property
    def model(self) -> Model:
        """The model of all series."""
        return self._programs[0].model

    @property
    def by(self) -> tuple[str, ...]:
        return self.records.labels.by

    @property
    def dropped(self) -> dict[str, int]:
        return dict(sum((Counter(counts) for counts in self.records.dropped.values()), Counter()))

    def __contains__(self, key: Hashable) -> bool:
        return key in self._index

    def keys(self) -> KeysView[Hashable]:
        """Keys of the series that have a result."""
        return self._index.keys()

    def values(self) -> Iterator[Track]:
        """The results."""
        return (self._track(k) for k in self._index.values())

    def items(self) -> Iterator[tuple[Hashable, Track]]:
        """Keys and results."""
        return ((key, self._track(k)) for key, k in self._index.items())

    def runs(self) -> dict[Hashable, Track]:
        return dict(self.items())

    def __iter__(self) -> Iterator[Hashable]:
        return iter(self._index)

    def __len__(self) -> int:
        return len(self._index)

    def __repr__(self) -> str:
        samples = sum(int(self.records.length[k]) for k in self._index.values())
        return f"Fleet of {len(self)} series, {samples} samples: {self.model!r}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self._programs[0].names

    @property
    def nbytes(self) -> int:
        """Bytes of what was written for all series."""
        return sum(out.nbytes for out in {id(lane.out): lane.out for lane in self._lanes if lane}.values())


def run_fleet(
    programs: Sequence[Program],
    records: Records,
    keep: str = "std",
    failed: Mapping[Hashable, str] | None = None,
    before: Fleet | None = None,
) -> Fleet:
    """Run every series of ``records`` by its program and return the results; all have one bound model.

    ``failed`` gives the reasons why units did not become series. An interrupt (Ctrl-C) stops the fleet and returns what
    is finished, with a warning.
    """
    lanes: list[Lane | None] = [None] * len(programs)
    starts, records = _warm(programs, records, before)
    jobs = [job for group in _groups(programs) for job in _jobs(programs, records, group, keep)]
    for job in jobs:
        for lane, k in enumerate(job.series):
            for name, value in starts.get(int(k), {}).items():
                job.tile[name][0, ..., lane] = value
    jobs.sort(key=lambda job: -len(job.out))
    _run_jobs(jobs, records)
    for job in jobs:
        if job.done:
            for lane, k in enumerate(job.series[: job.live]):
                lanes[k] = Lane(job.out, job.tile, lane)
    absent = {records.keys[k]: "interrupted before it was run" for k, lane in enumerate(lanes) if lane is None}
    if absent:
        warnings.warn(
            f"interrupted: {len(programs) - len(absent)} of {len(programs)} series are finished; "
            "the others are listed in fleet.failed.",
            stacklevel=3,
        )
    return Fleet(programs, records, lanes, {**(failed or {}), **absent}, starts)


def _warm(programs: Sequence[Program], records: Records, before: Fleet | None) -> tuple[dict[int, State], Records]:
    """(fields that each series takes over, by its index; the records with the intervals since the earlier runs)."""
    if before is None:
        return {}, records
    starts: dict[int, State] = {}
    factors: dict[int, float] = {}
    for k, key in enumerate(records.keys):
        if key in before:
            run, first = before[key], int(records.first[k])
            (starts[k],) = carried(run, [programs[k]])
            if records.time is not None:
                factors[first] = first_interval(run, records.time[first], records.labels)
    return starts, replace(records, known=records.known.begun(factors))


class Job:
    """One tile and the series in its lanes; lanes beyond ``live`` repeat the last series and are ignored."""

    def __init__(self, run: Any, tile: Array, series: Array, live: int, out: Array) -> None:
        self.run = run
        self.tile = tile
        self.series = series
        self.live = live
        self.out = out
        self.done = False


def _groups(programs: Sequence[Program]) -> list[list[int]]:
    """Series whose trackers have the same steps and fields, so that they can share tiles."""
    groups: dict[Any, list[int]] = defaultdict(list)
    kinds: dict[Tracker, Any] = {}
    for k, program in enumerate(programs):
        if program.tracker not in kinds:
            kinds[program.tracker] = (program.steps, program.tracker.outputs, program.shapes)
        groups[kinds[program.tracker]].append(k)
    return list(groups.values())


def width_of(program: Program, count: int) -> int:
    """Lanes of the tiles for ``count`` series."""
    return 1 if count < FEWEST or program.model.n > LARGEST else program.tracker.width


def _jobs(programs: Sequence[Program], records: Records, group: Sequence[int], keep: str) -> Iterator[Job]:
    """Tiles for the series of one group, longest first."""
    program = programs[group[0]]
    L = width_of(program, len(group))
    order = np.array(group)[np.argsort(-records.length[group], kind="stable")]
    padded = np.concatenate([order, np.full(-len(order) % L, order[-1])]).reshape(-1, L)
    tiles = _tiles(programs, padded)
    longest = records.length[padded[:, 0]]
    ends = np.cumsum(longest)
    # one allocation for all tiles, so that it is large enough for huge pages
    out = program.written(tiles[:1], int(ends[-1]), keep)
    run = program.drivers(keep).run
    for k, series in enumerate(padded):
        live = min(L, len(order) - k * L)
        yield Job(run, tiles[k : k + 1], series, live, out[ends[k] - longest[k] : ends[k]])


def _tiles(programs: Sequence[Program], padded: Array) -> Array:
    """Tiles at their start, one record per row of ``padded``."""
    count, L = padded.shape
    some = {programs[k].tracker: programs[k] for k in padded.ravel()}
    first = programs[padded[0, 0]]
    tiles = repeat_tile(tile_of([first] * L), count)
    if len(some) > 1:
        starts = {tracker: tracker.state_for(first.model) for tracker in some}
        for name in starts[first.tracker]:
            values = np.array([starts[programs[k].tracker][name] for k in padded.ravel()])
            tiles[name][...] = np.moveaxis(values.reshape(count, L, *values.shape[1:]), 1, -1)
    return tiles


def _run_jobs(jobs: Sequence[Job], records: Records) -> None:
    """Run all jobs on a pool of threads and mark those that are done."""
    for job in {(job.run, job.tile.dtype, job.out.dtype): job for job in jobs}.values():
        _drive(job, records, 0)  # compiles, so that threads do not wait for each other
    total = sum(len(job.out) * job.live for job in jobs)
    with (
        Progress(console=Console(stderr=True), transient=True, disable=total <= SHOWN) as progress,
        ThreadPoolExecutor(cores()) as pool,
    ):
        task = progress.add_task("tracking", total=total)
        waiting = {pool.submit(_drive, job, records, len(job.out)): job for job in jobs}
        try:
            for future in as_completed(waiting):
                future.result()
                waiting[future].done = True
                progress.advance(task, len(waiting[future].out) * waiting[future].live)
        except KeyboardInterrupt:
            pool.shutdown(wait=True, cancel_futures=True)
            for future, job in waiting.items():
                job.done = not future.cancelled()


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _drive(job: Job, records: Records, stop: int) -> None:
    """Run one tile over its first ``stop`` samples, block by block."""
    L = len(job.series)
    first, length = records.first[job.series], records.length[job.series]
    columns = records.known.columns
    y, u, known = _block(L, records.u.shape[1], min(BLOCK, len(columns)), columns.shape[1])
    finals: dict[int, Array] = {}
    bounds = sorted({*range(0, stop, BLOCK), *(int(end) for end in length if end < stop), stop})
    for a, b in pairwise(bounds) if stop else [(0, 0)]:
        _gather(records.y, records.u, columns, first, length, a, b, y, u, known)
        factors = known if len(known) == 1 else known[: b - a]
        job.run(job.tile, y[: b - a], u[: b - a], factors, job.out[a:b])
        for lane in np.flatnonzero(length == b).tolist():
            finals[lane] = _words(job.tile, L)[:, lane].copy()
    for lane, words in finals.items():
        _words(job.tile, L)[:, lane] = words


def _block(L: int, m: int, factors: int, columns: int) -> tuple[Array, Array, Array]:
    """This thread's memory for a block in lane order; fresh memory for every tile would cost as much as the filter."""
    shapes = (BLOCK, L), (BLOCK, m, L), (factors, columns, L)
    if getattr(_thread, "shapes", None) != shapes:
        _thread.shapes, _thread.block = shapes, tuple(np.empty(shape) for shape in shapes)
    block: tuple[Array, Array, Array] = _thread.block
    return block


def _words(tile: Array, L: int) -> Array:
    """The fields of a tile as (words, L): one column is the whole state of one lane."""
    flat = tile.view(np.int64).reshape(-1)
    return flat[: len(flat) // L * L].reshape(-1, L)


@Driver
def _gather(
    y: Array, u: Array, known: Array, first: Array, length: Array, a: int, b: int,
    to_y: Array, to_u: Array, to_known: Array,
) -> None:  # fmt: skip
    """Copy samples a to b of every lane's series into lane order; a lane that has ended gets NaN and dt = 0.

    The copy goes sample by sample and not lane by lane, so that the block is written row after row (4 ns per series and
    step with four inputs; lane by lane it takes 12, because each store opens another cache line).
    """
    L, m = len(first), u.shape[1]
    changing = known.shape[0] > 1
    there, start = b <= length, np.where(b <= length, first + a, 0)
    for t in range(b - a):
        for l in range(L):
            to_y[t, l] = y[start[l] + t] if there[l] else np.nan
        for j in range(m):
            for l in range(L):
                to_u[t, j, l] = u[start[l] + t, j] if there[l] else np.nan
    for t in range(b - a if changing else 1):
        for j in range(known.shape[1]):
            for l in range(L):
                to_known[t, j, l] = known[(start[l] + t) * changing, j] if there[l] else 1.0 * (j > 0)

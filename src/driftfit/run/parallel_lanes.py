"""Lanes: many series, or many settings for one series, in parallel in the lanes of tiles, on all cores.

A tile holds up to thirty-two series of one model and one kind of tracker; the compiled step works on all its lanes at
once. Tiles are distributed over a pool of threads, which run in parallel because compiled code releases the GIL. Every
lane does the same arithmetic in the same order as its series would alone, so results agree bit for bit.

Several outputs of a series are lanes of one tile, because they read each other's past. Of G series with ny outputs
lane o G + g is output o of series g; lanes beyond ny G repeat others and are ignored.

Series are sorted by length, so that those of one tile end at about the same time. A lane whose series has ended
continues with dt = 0 and no output, which changes only the lags of its model; its state is copied when its series ends.

`advance` continues many series from their states, for a process that receives a few samples of each and must be fast:
results are columns in the order of the samples, and no `Track` is made. They are those of the records, bit for bit. Of
K series with ny outputs each, programs and states have K ny entries, those of a series one after the other.
"""

from __future__ import annotations

import os
import threading
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.record import Records
from driftfit.engine.kernel import Array, Driver
from driftfit.engine.tiles import repeat_tile
from driftfit.run.lanes import Lanes
from driftfit.run.layout import words_of
from driftfit.run.program import PROGRESS_SAMPLES, Program, State, progress, tile_of

BLOCK_SAMPLES = 256
"""Number of samples that are copied into lane order at a time: a block of a tile fits into the second-level cache."""

FEWEST_LANES = 10
"""Fewer series than this are run one by one: a tile of 32 lanes costs as much as about ten single lanes."""

BATCHES_PER_THREAD = TILES_PER_BATCH = 16
"""Batches that a thread runs at least, and tiles of a batch at most: handing over a tile costs 50 us, as much as a
quarter of its hundred samples."""


_thread = threading.local()


def run_lanes(
    programs: Sequence[Program], records: Records, keep: str, starts: Mapping[int, State], dtype: Any = np.float64
) -> Lanes:
    """Run every series by its programs, one for each of its outputs; all have one bound model.

    ``programs`` and the result have an entry for each output of each series, in that order; ``starts`` are the fields
    that some of them begin with. An interrupt (Ctrl-C) stops the run: lanes that are not finished have no result.
    """
    jobs = prepare(programs, records, keep, dtype)
    for job in jobs:
        for lane, k in enumerate(job.lanes.tolist()):
            for name, value in starts.get(k, {}).items():
                job.tile[name][0, ..., lane] = value
    run_jobs(jobs, records)
    return lanes_in(jobs, records)


def lanes_in(jobs: Sequence[Job], records: Records) -> Lanes:
    """The lanes of the jobs that are done, one for each output of each series."""
    tiles = [(job.out, job.tile, job.lanes[job.live], np.flatnonzero(job.live)) for job in jobs if job.done]
    return Lanes(tiles, np.repeat(records.length, records.ny))


def prepare(
    programs: Sequence[Program], records: Records, keep: str, dtype: Any = np.float64, collected: bool = False
) -> list[Job]:
    """Tiles at their start for all series, the longest first.

    With ``collected`` every sample is also stored as the tracker receives it.
    """
    groups = _groups(programs[:: records.ny])
    jobs = [job for group in groups for job in _jobs(programs, records, group, (keep, dtype, collected))]
    return sorted(jobs, key=lambda job: -len(job.out))


@dataclass(eq=False)
class Job:
    """One tile with the number of the program in each lane; lanes that are not ``live`` repeat others."""

    run: Any
    tile: Array
    lanes: Array
    live: Array
    out: Array
    done: bool = False


def _groups(programs: Sequence[Program]) -> list[list[int]]:
    """Series whose trackers have the same steps and fields, so that they can share tiles."""
    groups: dict[Any, list[int]] = defaultdict(list)
    kinds: dict[int, list[int]] = {}  # most series share one program, and its steps take 100 us to compare
    if len({id(program) for program in programs}) == 1:
        return [list(range(len(programs)))]
    for k, program in enumerate(programs):
        group = kinds.get(id(program))
        if group is None:
            group = kinds[id(program)] = groups[
                program.steps, program.tracker.outputs, program.shapes, program.gate and program
            ]
        group.append(k)
    return list(groups.values())


def width_of(program: Program, count: int, ny: int = 1) -> int:
    """Lanes of the tiles for ``count`` series with ny outputs."""
    wide = 1 if count * ny < FEWEST_LANES else program.width
    return ny if wide < 2 * ny else wide


def _jobs(
    programs: Sequence[Program], records: Records, group: Sequence[int], stored: tuple[str, Any, bool]
) -> Iterator[Job]:
    """Tiles for the series of one group, longest first; ``stored`` is what is kept, its type, and `collect`."""
    ny, program = records.ny, programs[group[0] * records.ny]
    L = width_of(program, len(group), ny)
    G = L // ny
    order = np.array(group)[np.argsort(-records.length[group], kind="stable")]
    padded = np.concatenate([order, np.full(-len(order) % G, order[-1])]).reshape(-1, G)
    place, output = np.arange(L) % G, np.minimum(np.arange(L) // G, ny - 1)
    lanes = padded[:, place] * ny + output
    tiles = _tiles(programs, lanes)
    longest = records.length[padded[:, 0]]
    ends = np.cumsum(longest)
    # one allocation for all tiles, so that it is large enough for huge pages
    run, out = program.loop(tiles[:1], int(ends[-1]), *stored)
    for k, some in enumerate(lanes):
        live = (np.arange(L) < ny * G) & (place < len(order) - k * G)
        yield Job(run, tiles[k : k + 1], some, live, out[ends[k] - longest[k] : ends[k]])


def _tiles(programs: Sequence[Program], lanes: Array) -> Array:
    """Tiles at their start, one record per row of ``lanes``."""
    count, L = lanes.shape
    first = [programs[k] for k in lanes[0]]
    one = all(program is first[0] for program in first)
    tiles = repeat_tile(first[0].lanes(L) if one else tile_of(first), count)
    if any(programs[k] is not first[lane] for row in lanes for lane, k in enumerate(row.tolist())):
        starts = {key: one.start for key, one in {id(one): one for one in programs}.items()}
        for name in first[0].start:
            values = np.array([starts[id(programs[k])][name] for k in lanes.ravel()])
            tiles[name][...] = np.moveaxis(values.reshape(count, L, *values.shape[1:]), 1, -1)
    return tiles


def run_jobs(jobs: Sequence[Job], records: Records, threads: int | None = None) -> None:
    """Run all jobs on a pool of threads, one for each core unless their number is given, and mark those that are done.

    On a single thread they run in the calling one.
    """
    if threads == 1:
        _drive_all(jobs, records)
        return
    for job in {(job.run, job.tile.dtype, job.out.dtype): job for job in jobs}.values():
        _drive(job, records, 0)  # compiles, so that threads do not wait for each other
    threads = threads or cores()
    most = min(TILES_PER_BATCH, max(1, len(jobs) // (BATCHES_PER_THREAD * threads)))
    batches = [jobs[k : k + most] for k in range(0, len(jobs), most)]
    total = sum(map(_samples, batches))
    what = f"tracking, results of {sum(job.out.nbytes for job in jobs) / 1e9:.1f} GB"
    with progress(what, total, total > PROGRESS_SAMPLES) as advance, ThreadPoolExecutor(threads) as pool:
        waiting = {pool.submit(_drive_all, batch, records): batch for batch in batches}
        try:
            for future in as_completed(waiting):
                future.result()
                advance(_samples(waiting[future]))
        except KeyboardInterrupt:
            pool.shutdown(wait=True, cancel_futures=True)


def _samples(jobs: Sequence[Job]) -> int:
    """The samples of all series."""
    return sum(len(job.out) * int(job.live.sum()) for job in jobs)


def _drive_all(jobs: Sequence[Job], records: Records) -> None:
    """Run tiles one after the other, and mark those that are done."""
    for job in jobs:
        _drive(job, records, len(job.out))
        job.done = True


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _drive(job: Job, records: Records, stop: int) -> None:
    """Run one tile over its first ``stop`` samples, block by block."""
    L, N = len(job.lanes), len(records.y)
    series, column = np.divmod(job.lanes, records.ny)
    first, length = records.first[series], records.length[series]
    columns = records.known.columns
    given, factors = records.y.reshape(N, -1), columns.reshape(*columns.shape[:2], -1)
    y, u, known = _block(L, records.u.shape[1], min(BLOCK_SAMPLES, len(columns)), columns.shape[1])
    finals: list[tuple[Array, Array]] = []
    bounds = sorted({*range(0, stop, BLOCK_SAMPLES), *(int(end) for end in length if end < stop), stop})
    for a, b in pairwise(bounds) if stop else [(0, 0)]:
        size = b - a
        start = np.where(b <= length, first + a, -1)
        _gather_signals(given, records.u, start, column, y[:size], u[:size])
        _gather_factors(factors, start, column, known if len(known) == 1 else known[:size])
        job.run(job.tile, y[:size], u[:size], known if len(known) == 1 else known[:size], job.out[a:b])
        if b < stop and (ended := np.flatnonzero(length == b)).size:
            finals.append((ended, words_of(job.tile)[:, ended]))
    for ended, words in finals:
        words_of(job.tile)[:, ended] = words


def _block(L: int, m: int, factors: int, columns: int) -> tuple[Array, Array, Array]:
    """This thread's memory for a block in lane order; fresh memory for every tile would cost as much as the filter."""
    shapes = (BLOCK_SAMPLES, L), (BLOCK_SAMPLES, m, L), (factors, columns, L)
    if getattr(_thread, "shapes", None) != shapes:
        _thread.shapes, _thread.block = shapes, tuple(np.empty(shape) for shape in shapes)
    block: tuple[Array, Array, Array] = _thread.block
    return block


@Driver
def _gather_signals(y: Array, u: Array, start: Array, column: Array, to_y: Array, to_u: Array) -> None:
    """Copy samples of every lane's series from ``start`` on into lane order; NaN for a lane that has ended (-1).

    The copy goes sample by sample and not lane by lane, so that the block is written row after row (4 ns per series and
    step with four inputs; lane by lane it takes 12, because each store opens another cache line).
    """
    L, m = len(start), u.shape[1]
    for t in range(len(to_y)):
        for l in range(L):
            to_y[t, l] = y[start[l] + t, column[l]] if start[l] >= 0 else np.nan
        for j in range(m):
            for l in range(L):
                to_u[t, j, l] = u[start[l] + t, j] if start[l] >= 0 else np.nan


@Driver
def _gather_factors(known: Array, start: Array, column: Array, to_known: Array) -> None:
    """The same for the known numbers of the samples (one row if they are equal for all); dt = 0 for a lane that has
    ended.

    ``known`` is (T, k, ny).
    """
    changing = known.shape[0] > 1
    for t in range(len(to_known)):
        for j in range(known.shape[1]):
            for l in range(len(start)):
                to_known[t, j, l] = known[(start[l] + t) * changing, j, column[l]] if start[l] >= 0 else 1.0 * (j > 0)


class Advanced(NamedTuple):
    """The results of a driver for all series of ``records``, and their final states."""

    programs: Sequence[Program]
    records: Records
    lanes: Lanes

    def column(self, name: str) -> Array:
        """A field of the driver's output at every sample: (N, ..), or (N, ny, ..) for several outputs."""
        shape, ny = self.lanes.tiles[0][0][name].shape[1:-1], self.records.ny
        into = np.empty((len(self.records.y), ny, int(np.prod(shape))))
        self.columns([name], into)
        return into.reshape(-1, *((ny,) if self.records.outputs else ()), *shape)

    def columns(self, names: Sequence[str], into: Array) -> None:
        """Write fields of the output at every sample next to each other ``into`` (N, k), or (N, ny, k) for several
        outputs.
        """
        into = into[:, None] if into.ndim == 2 else into
        for out, tile, lanes, places in self.lanes.tiles:
            series, output = np.divmod(lanes, self.records.ny)
            fields: Mapping[str, Any] = out.dtype.fields or {}
            parts, L = (fields[name][:2] for name in names), tile["theta"].shape[-1]
            begin = [np.arange(at, at + kind.itemsize, 8 * L) // 8 for kind, at in parts]
            words = out.view(np.float64).reshape(len(out), -1)
            first, length = self.records.first[series], self.records.length[series]
            _natural(words, np.concatenate(begin), places, first, length, output, into)

    def reasons(self) -> Array:
        """What the gate decided of every sample, (N,), of series with one output (`driftfit.readings.gate`)."""
        return self.column("reason").view(np.int64)

    def states(self) -> Array:
        """The words (K ny, W) after the last samples; of a layout with fewer words the first of them."""
        layouts = [self.programs[lanes[0]].layout for _, _, lanes, _ in self.lanes.tiles]
        found = np.zeros((len(self.programs), max(one.size for one in layouts)), np.int64)
        for (_, tile, lanes, places), layout in zip(self.lanes.tiles, layouts, strict=True):
            found[lanes, : layout.size] = layout.taken(tile)[places]
        return found


def advance(
    programs: Sequence[Program], records: Records, states: Array, begun: Array, threads: int | None = None,
    collected: bool = False,
) -> Advanced:  # fmt: skip
    """Run every series by its programs, from their states if they have ``begun``.

    ``states`` (K ny, W) are the words of the states (`Layout.unpack`), as `Advanced.states` returns them; a program
    that has not ``begun`` (K ny,) is at its start. With ``collected`` the fields of `collected_samples.COLLECTED` are
    kept too.
    """
    jobs = prepare(programs, records, "std", collected=collected)
    for job in jobs:
        lanes = np.flatnonzero(begun[job.lanes])
        if lanes.size:
            layout = programs[job.lanes[0]].layout
            layout.put(job.tile, lanes, states[job.lanes[lanes], : layout.size])
    run_jobs(jobs, records, threads)
    return Advanced(programs, records, lanes_in(jobs, records))


@Driver
def _natural(words: Array, begin: Array, lanes: Array, first: Array, length: Array, output: Array, into: Array) -> None:
    """Copy lanes of an output (T, words), whose fields ``begin`` (k,) at these words, to their rows of (N, ny, k)."""
    for j in range(len(lanes)):
        for t in range(length[j]):
            for i in range(len(begin)):
                into[first[j] + t, output[j], i] = words[t, begin[i] + lanes[j]]

"""Many series continued from their states, in the lanes of tiles; results as columns in the order of their samples.

This is what a process needs that receives a few samples of many series, with their states, and must be fast: no
`Track` is made for a series. The samples, results and states of a series are those of its record, bit for bit.

Of K series with ny outputs each, programs and states have K ny entries, those of a series one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from driftfit.data.record import Records
from driftfit.engine.kernel import Array, Driver
from driftfit.run.parallel_lanes import Job, lanes_in, prepare, run_jobs
from driftfit.run.program import Program
from driftfit.run.result import Lanes


class Advanced:
    """The results of a driver for all series of ``records``, and their final states."""

    def __init__(self, programs: Sequence[Program], records: Records, jobs: Sequence[Job]) -> None:
        self.programs, self.records, self.jobs = programs, records, jobs

    def column(self, name: str) -> Array:
        """A field of the driver's output at every sample: (N, ..), or (N, ny, ..) for several outputs."""
        shape, ny = self.jobs[0].out[name].shape[1:-1], self.records.ny
        into = np.empty((len(self.records.y), ny, int(np.prod(shape))))
        self.columns([name], into)
        return into.reshape(-1, *((ny,) if self.records.outputs else ()), *shape)

    def columns(self, names: Sequence[str], into: Array) -> None:
        """Write fields of the output at every sample next to each other ``into`` (N, k), or (N, ny, k) for several
        outputs.
        """
        into = into[:, None] if into.ndim == 2 else into
        for job in self.jobs:
            lanes, L = np.flatnonzero(job.live), len(job.lanes)
            series, output = np.divmod(job.lanes[lanes], self.records.ny)
            fields: Mapping[str, Any] = job.out.dtype.fields or {}
            places = (fields[name][:2] for name in names)
            begin = [np.arange(at, at + kind.itemsize, 8 * L) // 8 for kind, at in places]
            words = job.out.view(np.float64).reshape(len(job.out), -1)
            first, length = self.records.first[series], self.records.length[series]
            _natural(words, np.concatenate(begin), lanes, first, length, output, into)

    def reasons(self) -> Array:
        """What the gate decided of every sample, (N,), of series with one output (`driftfit.readings.gate`)."""
        into = np.zeros(len(self.records.y), int)
        for job in self.jobs:
            for lane in np.flatnonzero(job.live).tolist():
                k = job.lanes[lane]
                first, length = self.records.first[k], self.records.length[k]
                into[first : first + length] = job.out["reason"][:length, lane]
        return into

    @cached_property
    def lanes(self) -> Lanes:
        """The lane of each program."""
        return lanes_in(self.jobs, self.records)

    def states(self) -> Array:
        """The words (K ny, W) after the last samples; of a layout with fewer words the first of them."""
        layouts = [self.programs[job.lanes[0]].layout for job in self.jobs]
        found = np.zeros((len(self.programs), max(one.size for one in layouts)), np.int64)
        for job, layout in zip(self.jobs, layouts, strict=True):
            found[job.lanes[job.live], : layout.size] = layout.taken(job.tile)[job.live]
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
    return Advanced(programs, records, jobs)


@Driver
def _natural(words: Array, begin: Array, lanes: Array, first: Array, length: Array, output: Array, into: Array) -> None:
    """Copy lanes of an output (T, words), whose fields ``begin`` (k,) at these words, to their rows of (N, ny, k)."""
    for j in range(len(lanes)):
        for t in range(length[j]):
            for i in range(len(begin)):
                into[first[j] + t, output[j], i] = words[t, begin[i] + lanes[j]]

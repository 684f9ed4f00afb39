"""Lanes: the results of many series, settings or outputs side by side, and their files.

A lane is one column of what a driver wrote for a tile. One run is one lane; a fleet, a grid of settings and the outputs
of a record are many, in files too: those with equal fields are stored together.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from os import PathLike
from typing import Any, NamedTuple, Self

import numpy as np

from driftfit.data import storage
from driftfit.data.record import Known, Labels, Record, Records
from driftfit.engine.kernel import Array
from driftfit.engine.tiles import repeat_tile
from driftfit.models.base import Model
from driftfit.readings.gate import AT_START, SIGNAL, Gate
from driftfit.readings.left_out import LeftOut
from driftfit.run.gating import First, without_codes
from driftfit.run.program import Program, State, kept, lanes_of, programs_of, state_of, tile_of
from driftfit.trackers.base import Tracker


def names_of(records: Array) -> tuple[str, ...]:
    """Fields of an array of records."""
    return records.dtype.names or ()


class Lane(NamedTuple):
    """Where the result of one series is stored: the driver's output for its tile, the end state, the lane."""

    out: Array
    tile: Array
    lane: int = 0

    def written(self, name: str) -> Array:
        """A field of the output of the driver."""
        return np.asarray(self.out[name][..., self.lane])

    def alone(self, program: Program) -> Lane:
        """A copy in a separate tile, without the other series."""
        if self.tile["theta"].shape[-1] == 1:
            return self
        tile = program.tile(state_of(self.tile, self.lane))
        out = program.written(tile, len(self.out), *kept(self.out.dtype))
        for name in names_of(out):
            out[name][..., 0] = self.written(name)
        return Lane(out, tile)


class Lanes:
    """The results of many lanes: a `Lane` is made when it is asked for; a million of them would take a second.

    ``tiles`` are (output of the driver, end state, numbers of the lanes that have a result, their places in the tile),
    ``length`` the number of samples of each lane.
    """

    def __init__(self, tiles: Sequence[tuple[Array, Array, Array, Array]], length: Array) -> None:
        self.tiles, self.length = tiles, length
        self._tile, self._place = np.full(len(length), -1), np.zeros(len(length), int)
        for k, (_, _, lanes, places) in enumerate(tiles):
            self._tile[lanes], self._place[lanes] = k, places

    @classmethod
    def of(cls, lanes: Mapping[int, Lane], count: int) -> Self:
        """Lanes that exist, by their number among ``count``."""
        tiles = [(lane.out, lane.tile, np.array([j]), np.array([lane.lane])) for j, lane in lanes.items()]
        return cls(tiles, np.array([len(lanes[j].out) if j in lanes else 0 for j in range(count)], int))

    def part(self, numbers: Sequence[int]) -> Lanes:
        """Some lanes, in this order."""
        return Lanes.of({k: self[j] for k, j in enumerate(numbers)}, len(numbers))

    @property
    def done(self) -> Array:
        """Which lanes have a result."""
        return self._tile >= 0

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, j: int) -> Lane:
        k = self._tile.item(j)
        if k < 0:
            raise KeyError(j)
        out, tile, _, _ = self.tiles[k]
        return Lane(out[: self.length.item(j)], tile, self._place.item(j))

    def __iter__(self) -> Iterator[Lane]:
        """Those that have a result."""
        return map(self.__getitem__, np.flatnonzero(self.done).tolist())


def by_output(model: Model, trackers: Sequence[Tracker]) -> Any:
    """One tracker, or the tracker of each output by its name."""
    return trackers[0] if len(trackers) == 1 else dict(zip(model.outputs, trackers, strict=True))


def decided_record(
    programs: Sequence[Program], record: Record, starts: Mapping[int, State], written: Callable[[str], Array]
) -> tuple[Record, Sequence[State], int] | None:
    """(the record without the codes that a gate finds among its first samples, the fields with which its lanes then
    begin, the sample at which it finds them), given the programs of the lanes, the fields with which they began and
    what they wrote of every sample; None if it found none.
    """
    if programs[0].gate is None or AT_START not in written("reason") % SIGNAL:
        return None
    found: list[tuple[int, First]] = []
    tile = tile_of(programs, states := [starts.get(j, {}) for j in range(len(programs))])
    programs[0].drivers().run(tile, *lanes_of(record), programs[0].written(tile, len(record)), found_too=found)
    begun = [{**state, "gate_decided": np.array(1)} for state in states]
    return without_codes(record, *found[0]), begun, found[0][0]


class Results(NamedTuple):
    """What a file holds: a program, and perhaps a lane and a start, for each output of each series of ``records``."""

    programs: tuple[Program, ...]
    records: Records
    lanes: Lanes
    failed: Mapping[Hashable, str]
    starts: Mapping[int, State]


def write_results(path: str | PathLike[str], kind: str, results: Results) -> None:
    """Write results to one file without pickle, completely or not at all."""
    programs, records, lanes, failed, starts = results
    kinds = list(dict.fromkeys((one.tracker, one.gate) for one in programs))
    place = {one: k for k, one in enumerate(kinds)}
    groups = list(_groups(lanes))
    header: dict[str, Any] = {"kind": kind, "model": storage.describe(programs[0].whole), "groups": len(groups)}
    header |= {"trackers": [storage.describe(one) for one, _ in kinds], "labels": asdict(records.labels)}
    header |= {"gates": [None if gate is None else gate.settings() for _, gate in kinds]}
    header |= {"tracker": [place[one.tracker, one.gate] for one in programs], "inputs": programs[0].model.m}
    header |= {"keys": list(records.keys), "outputs": list(records.outputs), "left_out": list(records.left_out)}
    counts = {"failed": failed, "dropped": records.dropped, "missing": records.missing}
    header |= {name: list(found.items()) for name, found in counts.items()}
    arrays = {"y": records.y, "u": records.u, "known": records.known.columns}
    arrays |= {"first": records.first, "length": records.length}
    arrays |= {} if records.time is None else {"time": records.time}
    for k, left_out in enumerate(records.left_out.values()):
        arrays |= {f"left{k}_{name}": value for name, value in vars(left_out).items()}
    for j, start in starts.items():
        arrays |= {f"start{j}_{name}": value for name, value in start.items()}
    for g, some in enumerate(groups):
        states = [state_of(lanes[j].tile, lanes[j].lane) for j in some]
        arrays[f"lanes{g}"] = np.array(some)
        for name in names_of(lanes[some[0]].out):
            arrays[f"out{g}_{name}"] = np.concatenate([lanes[j].written(name) for j in some])
        for name in states[0]:
            arrays[f"state{g}_{name}"] = np.stack([state[name] for state in states])
    storage.write(path, header, arrays)


def _groups(lanes: Lanes) -> Iterable[list[int]]:
    """Lanes with a result, those with equal fields together."""
    groups: dict[Any, list[int]] = {}
    for j in np.flatnonzero(lanes.done).tolist():
        shapes = tuple((name, value.shape) for name, value in state_of(lanes[j].tile, lanes[j].lane).items())
        groups.setdefault((shapes, names_of(lanes[j].out)), []).append(j)
    return groups.values()


def read_results(path: str | PathLike[str], kind: str, classes: Iterable[Any] = ()) -> Results:
    """The results in a file that `write_results` wrote; ValueError where it holds something else."""
    header, arrays = storage.read(path, kind)
    with storage.reading(os.fspath(path)):
        return _results(path, header, arrays, tuple(classes))


def _results(
    path: str | PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, Array], classes: tuple[Any, ...]
) -> Results:
    model = storage.rebuild(header["model"], Model, classes)
    trackers = [storage.rebuild(one, Tracker, classes) for one in header["trackers"]]
    for g in range(header["groups"]):
        storage.check_size(path, model, trackers[0], arrays[f"out{g}_theta"].shape[-1])
    gates = [False if gate is None else Gate.from_settings(gate) for gate in header["gates"]]
    outputs, numbers = tuple(header["outputs"]), header["tracker"]
    ny = max(len(outputs), 1)
    series = [tuple(numbers[j : j + ny]) for j in range(0, len(numbers), ny)]
    own = {kinds: by_output(model, [trackers[k] for k in kinds]) for kinds in series}
    made = {kinds: programs_of(model, tracker, header["inputs"], gates[kinds[0]]) for kinds, tracker in own.items()}
    programs = tuple(program for kinds in series for program in made[kinds])
    failed, dropped, missing = (
        {_key(key): value for key, value in header[name]} for name in ("failed", "dropped", "missing")
    )
    decided = _numbered(arrays, "left")
    left_out = {_key(key): LeftOut(**decided[k]) for k, key in enumerate(header["left_out"])}
    records = Records(
        tuple(map(_key, header["keys"])), arrays["first"], arrays["length"], arrays["y"], arrays["u"],
        Known(arrays["known"]), arrays.get("time"), Labels(**header["labels"]), dropped, None, missing, outputs,
        left_out,
    )  # fmt: skip
    groups = _numbered(arrays, "out").items()
    found = {j: lane for g, out in groups for j, lane in _restored(path, arrays, (g, out), programs, records)}
    lanes = Lanes.of(found, len(records.keys) * records.ny)
    return Results(programs, records, lanes, failed, _numbered(arrays, "start"))


def _numbered(arrays: Mapping[str, Array], what: str) -> dict[int, dict[str, Array]]:
    """The arrays called ``what``, a number, "_" and a name, by number and name."""
    found: dict[int, dict[str, Array]] = {}
    for name, value in arrays.items():
        if name.startswith(what):
            number, _, field = name.removeprefix(what).partition("_")
            found.setdefault(int(number), {})[field] = value
    return found


def _key(value: Any) -> Any:
    """A key as JSON gives it: a tuple comes back as a list."""
    return tuple(value) if isinstance(value, list) else value


def _restored(
    path: str | PathLike[str],
    arrays: Mapping[str, Array],
    group: tuple[int, Mapping[str, Array]],
    programs: Sequence[Program],
    records: Records,
) -> Iterator[tuple[int, Lane]]:
    """The lanes of a group of a file, each with its number."""
    g, stored = group
    some = arrays[f"lanes{g}"].tolist()
    program, length = programs[some[0]], [int(records.length[j // records.ny]) for j in some]
    tiles = repeat_tile(program.tile(), len(some))
    into = {name: tiles[name][..., 0] for name in storage.fields(tiles)}
    storage.restore(path, program.tracker, arrays, f"state{g}_", into)
    keep, _ = kept(np.dtype([(name, float) for name in stored]))
    out = program.written(tiles[:1], sum(length), keep, stored["theta"].dtype)
    storage.restore(path, program.tracker, arrays, f"out{g}_", {name: out[name][..., 0] for name in names_of(out)})
    ends = np.cumsum(length).tolist()
    for k, j in enumerate(some):
        yield j, Lane(out[ends[k] - length[k] : ends[k]], tiles[k : k + 1])

"""Results by key. Series of a fleet, settings of a grid and outputs of a record are lanes with keys.

The common part of `driftfit.run.fleet.Fleet` and `driftfit.run.outputs.Outputs`: a mapping from key to `Track`, their
copies, and their files.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, KeysView, Mapping, Sequence
from dataclasses import asdict
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from driftfit.data import storage
from driftfit.data.record import Known, Labels, Records
from driftfit.engine.kernel import Array
from driftfit.engine.tiles import repeat_tile
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.run.columns import Plain
from driftfit.run.program import Program, State, kept, programs_of, state_of
from driftfit.run.result import Lane, Lanes, Track, names_of
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    import polars


class KeyedResults(Plain):
    """Results of many lanes, from key to `Track` like a dict; ``by`` names the parts of a key.

    ``programs``, ``lanes`` and ``starts`` have an entry for each output of each series of ``records``, in that order;
    without a series there are the programs of some tracker, so that parameters have names.
    """

    _kind: ClassVar[str]

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
        self._programs = tuple(programs)
        self._lanes = lanes
        self._starts = dict(starts)
        done = self._lanes.done.tolist()
        self._index = {key: j for j, key in enumerate(self._named()) if done[j]}

    def __reduce__(self) -> Any:
        """A copy does not contain other series of a tile."""
        alone = {j: self._lanes[j].alone(self._programs[j]) for j in self._index.values()}
        lanes = Lanes.of(alone, len(self._lanes))
        return type(self), (self._programs, self.records, lanes, self.failed, self._starts)

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
        return self._programs[0].whole

    @property
    def programs(self) -> tuple[Program, ...]:
        """The program of each lane; without a series, those of some tracker."""
        return self._programs

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

    def ends(self) -> Iterator[tuple[Program, dict[str, Array]]]:
        """The program of each lane, and its state after the last sample."""
        for j in self._index.values():
            lane = self._lanes[j]
            yield self._programs[j], state_of(lane.tile, lane.lane)

    def undetermined(self) -> Iterator[tuple[Program, dict[str, Array]]]:
        """The entries of `ends` whose record does not determine every parameter."""
        for _, tile, lanes, places in self._lanes.tiles:
            for k in np.flatnonzero(np.isinf(tile["var"][0]).any(axis=0)[places]).tolist():
                yield self._programs[lanes[k]], state_of(tile, places[k])

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
        records, programs = self.records, self._programs
        kinds = list(dict.fromkeys((one.tracker, one.gate) for one in programs))
        place = {one: k for k, one in enumerate(kinds)}
        header: dict[str, Any] = {"kind": self._kind, "model": storage.describe(programs[0].whole)}
        header |= {"trackers": [storage.describe(one) for one, _ in kinds], "labels": asdict(records.labels)}
        header |= {"gates": [None if gate is None else gate.settings() for _, gate in kinds]}
        header |= {"tracker": [place[one.tracker, one.gate] for one in programs], "inputs": programs[0].model.m}
        header |= {"keys": list(records.keys), "outputs": list(records.outputs)}
        counts = {"failed": self.failed, "dropped": records.dropped, "missing": records.missing}
        header |= {name: list(found.items()) for name, found in counts.items()}
        arrays = {"y": records.y, "u": records.u, "known": records.known.columns}
        arrays |= {"first": records.first, "length": records.length}
        arrays |= {} if records.time is None else {"time": records.time}
        for j, start in self._starts.items():
            arrays |= {f"start{j}_{name}": value for name, value in start.items()}
        groups = self._groups()
        for g, some in enumerate(groups):
            lanes = [self._lanes[j] for j in some]
            states = [state_of(lane.tile, lane.lane) for lane in lanes]
            arrays[f"lanes{g}"] = np.array(some)
            for name in names_of(lanes[0].out):
                arrays[f"out{g}_{name}"] = np.concatenate([lane.written(name) for lane in lanes])
            for name in states[0]:
                arrays[f"state{g}_{name}"] = np.stack([state[name] for state in states])
        storage.write(path, {**header, "groups": len(groups)}, arrays)

    def _groups(self) -> list[list[int]]:
        """Lanes with a result, those with equal fields together."""
        groups: dict[Any, list[int]] = {}
        for j in self._index.values():
            lane = self._lanes[j]
            shapes = tuple((name, value.shape) for name, value in state_of(lane.tile, lane.lane).items())
            groups.setdefault((shapes, names_of(lane.out)), []).append(j)
        return list(groups.values())

    @classmethod
    def load(cls, path: str | PathLike[str], classes: Iterable[Any] = ()) -> Self:
        """Read a file that `save` wrote; ``classes`` are classes and functions of your own that it needs."""
        header, arrays = storage.read(path, cls._kind)
        with storage.reading(os.fspath(path)):
            return cls._read(path, header, arrays, tuple(classes))

    @classmethod
    def _read(
        cls, path: str | PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, Array], classes: tuple[Any, ...]
    ) -> Self:
        model = storage.rebuild(header["model"], Model, classes)
        trackers = [storage.rebuild(one, Tracker, classes) for one in header["trackers"]]
        for g in range(header["groups"]):
            storage.check_size(path, model, trackers[0], arrays[f"out{g}_theta"].shape[-1])
        gates = [False if gate is None else Gate.from_settings(gate) for gate in header["gates"]]
        kinds = zip(trackers, gates, strict=True)
        made = [programs_of(model, tracker, header["inputs"], gate) for tracker, gate in kinds]
        outputs = tuple(header["outputs"])
        programs = [made[k][j % max(len(outputs), 1)] for j, k in enumerate(header["tracker"])]
        keys = tuple(map(_key, header["keys"]))
        failed, dropped, missing = (
            {_key(key): value for key, value in header[name]} for name in ("failed", "dropped", "missing")
        )
        records = Records(
            keys, arrays["first"], arrays["length"], arrays["y"], arrays["u"], Known(arrays["known"]),
            arrays.get("time"), Labels(**header["labels"]), dropped, None, missing, outputs,
        )  # fmt: skip
        found = {j: lane for g in range(header["groups"]) for j, lane in _restored(path, arrays, g, programs, records)}
        lanes = Lanes.of(found, len(records.keys) * records.ny)
        starts: dict[int, dict[str, Array]] = {}
        for name in arrays:
            if name.startswith("start"):
                lane_number, _, field = name.removeprefix("start").partition("_")
                starts.setdefault(int(lane_number), {})[field] = arrays[name]
        return cls(programs, records, lanes, failed, starts)


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


def _key(value: Any) -> Any:
    """A key as JSON gives it: a tuple comes back as a list."""
    return tuple(value) if isinstance(value, list) else value


def _restored(
    path: str | PathLike[str], arrays: Mapping[str, Array], g: int, programs: Sequence[Program], records: Records
) -> Iterator[tuple[int, Lane]]:
    """The lanes of group g of a file, each with its number."""
    some = arrays[f"lanes{g}"].tolist()
    program = programs[some[0]]
    length = [int(records.length[j // records.ny]) for j in some]
    tiles = repeat_tile(program.tile(), len(some))
    into = {name: tiles[name][..., 0] for name in storage.fields(tiles)}
    storage.restore(path, program.tracker, arrays, f"state{g}_", into)
    stored = [name.removeprefix(f"out{g}_") for name in arrays if name.startswith(f"out{g}_")]
    keep, _ = kept(np.dtype([(name, float) for name in stored]))
    out = program.written(tiles[:1], sum(length), keep, arrays[f"out{g}_theta"].dtype)
    storage.restore(path, program.tracker, arrays, f"out{g}_", {name: out[name][..., 0] for name in names_of(out)})
    ends = np.cumsum(length).tolist()
    for k, j in enumerate(some):
        yield j, Lane(out[ends[k] - length[k] : ends[k]], tiles[k : k + 1])

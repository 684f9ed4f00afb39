"""Results by key. Series of a fleet, settings of a grid and outputs of a record are lanes with keys.

The common part of `driftfit.run.fleet.Fleet` and `driftfit.run.fleet.Outputs`: a mapping from key to `Track`, their
copies, and their files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, KeysView, Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from driftfit.data.record import Labels, Records
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.lanes import Lanes, Results, read_results, write_results
from driftfit.run.program import Program, State, state_of
from driftfit.run.result import Plain, Track

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

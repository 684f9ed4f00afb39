"""Tiles: the records in which a driver keeps the state of a model and a tracker, with the lanes as their last axis.

Fields that every record has: ``phi`` (n,), the signals ``y``, ``u`` (m,), ``dt`` (nominal intervals since the last
sample; 0 means that nothing may happen), ``noise`` and ``drift`` (known factors of the noise variance and of the drift
at this sample, 1 unless given), ``valid`` (phi is complete), ``observed`` (y is there), ``ok`` (both), the results
``y_hat``, ``e``, ``h`` (the variance of the prediction without the noise), ``s``, ``var`` (n,), the noise variance
``r`` that the tracker assumes, and ``scale``, the estimate of the noise variance where P is relative to it (1
elsewhere); ``floor``, below which a gate holds that estimate; ``late``, whether a sample is to be taken in by another
form of the tracker; and ``used_noise``, which only the replay for a smoother writes. Models and trackers add their own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numba import types

from driftfit.engine.kernel import Array
from driftfit.engine.tracker_part import BOUNDARY

WIDTH = 32
"""Lanes of a fleet's tile. It must be a constant of the type: a run-time lane count is not vectorised."""

OPEN = ("report", "memory", "flat")
"""Fields at the end of a record whose lengths are no part of its type for compiled code, which is the same for all
lengths: it finds them by their addresses, one after the other from that of the first.
"""

_TILE_TYPES: dict[Any, types.Type] = {}
"""Record types by their fields, one for each kind of tile that was compiled."""


def _common(n: int) -> dict[str, Any]:
    """Fields that every record has besides u, with their values before the first sample."""
    zero = 0.0
    return {
        "phi": np.zeros(n), "y": zero, "dt": 1.0, "noise": 1.0, "drift": 1.0, "interval": 1.0,
        "valid": zero, "observed": zero, "ok": zero, "y_hat": zero, "e": zero, "h": zero, "s": zero,
        "var": np.zeros(n), "r": 1.0, "scale": 1.0, "floor": zero, "late": zero, "used_noise": 1.0,
    }  # fmt: skip


@lru_cache
def held_in(record: np.dtype[Any], own: tuple[str, ...] = ()) -> tuple[str, ...]:
    """The fields of a record that hold something: a tracker's ``own``, the model's, the common and the open ones."""
    first, second, *rest = _common(0)
    behind = [first, second, "u", *rest, *OPEN]
    names = [name for name in record.names or () if name not in (BOUNDARY, "padding")]
    return tuple(sorted(names, key=lambda name: 0 if name in own or name not in behind else 1 + behind.index(name)))


def make_tile(n: int, m: int, model: Mapping[str, Any], trackers: Sequence[Mapping[str, Any]]) -> Array:
    """A tile of ``len(trackers)`` lanes: an array of one record, its fields set to the given starts.

    ``model`` and each entry of ``trackers`` map field names to start values without the lane axis; the shapes of the
    values are the shapes of the fields. All trackers must have the same fields; what both give is that of the tracker.
    """
    L, given = len(trackers), {**_common(n), **model, "u": np.zeros(max(m, 1))}
    starts = {**trackers[0], **{name: value for name, value in given.items() if name not in trackers[0]}}
    arrays = {name: np.asarray(value) for name, value in starts.items()}
    fields = tuple(
        (name, np.int64 if one.dtype.kind in "iub" else np.float64, one.shape) for name, one in arrays.items()
    )
    tile = _aligned(_record(fields, frozenset(trackers[0].keys() | _common(n).keys()), L), 1)
    for name, one in arrays.items():
        values = [start[name] for start in trackers] if name in trackers[0] else []
        alike = len(set(map(id, values))) < 2
        tile[name][0] = one[..., None] if alike else np.moveaxis(np.array(values), 0, -1)
    if opened := [name for name in OPEN if name in arrays]:
        tile[BOUNDARY][0, 0] = tile[opened[0]].ctypes.data - tile[BOUNDARY].ctypes.data
    return tile


@lru_cache(maxsize=256)
def _record(given: tuple[Any, ...], own: frozenset[str], L: int) -> np.dtype[Any]:
    """The record of a tile of L lanes with these fields (name, kind, shape of one lane), of which trackers see their
    ``own``.
    """
    fields = [(name, kind, (*shape, L)) for name, kind, shape in given]
    opened = [field for name in OPEN for field in fields if field[0] == name]
    tracked = [field for field in fields if field not in opened and field[0] in own]
    others = [field for field in fields if field not in opened and field[0] not in own]
    fields = [*tracked, _padding(BOUNDARY, tracked, L), *others]
    return _one_of(_followed_by(np.dtype([*fields, _padding("padding", fields, L)], align=True), opened))


def _padding(name: str, fields: Sequence[Any], L: int) -> tuple[str, type, tuple[int, int]]:
    """A field of padding, after which others begin on a cache line, so that no load of a vector of lanes crosses two.

    It has as many rows for every L: a packed state of one lane is read into tiles of any width.
    """
    words = np.dtype(list(fields)).itemsize // (8 * L)
    return name, np.float64, (8 - words % 8, L)


@lru_cache(maxsize=256)
def _one_of(record: np.dtype[Any]) -> np.dtype[Any]:
    """The same object for all equal records: caches compare it by identity, and otherwise field by field for 3 us."""
    return record


def _followed_by(dtype: np.dtype[Any], fields: Sequence[Any]) -> np.dtype[Any]:
    """A record type with further fields of numbers behind it, in whole cache lines."""
    names, offsets, end = list(dtype.names or ()), [at for _, at, *_ in (dtype.fields or {}).values()], dtype.itemsize
    formats: list[Any] = [dtype[name] for name in names]
    for name, kind, shape in fields:
        names.append(name)
        formats.append((kind, shape))
        offsets.append(end)
        end += 8 * math.prod(shape)
    size = -(-end // 64) * 64
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size}, align=True)


@lru_cache(maxsize=256)
def kind_of(tile: np.dtype[Any]) -> tuple[int, int, bool]:
    """(number of inputs, number of lanes, whether it has open fields) of a record."""
    m, L = tile["u"].shape
    return m, L, OPEN[0] in (tile.fields or ())  # of the names all would be compared


def as_compiled(tile: Array) -> Array:
    """The tile as compiled code takes it: of its open fields (`OPEN`) only the beginning."""
    return np.ndarray(tile.shape, _beginning(tile.dtype), tile) if kind_of(tile.dtype)[2] else tile


@lru_cache(maxsize=256)
def _beginning(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The type of a record up to the first entry of its open fields."""
    fields: Mapping[str, Any] = dtype.fields or {}
    (first, at, *_), names = fields[OPEN[0]], [name for name in fields if name not in OPEN]
    beginning = np.dtype(
        {"names": names, "formats": [dtype[name] for name in names],
         "offsets": [fields[name][1] for name in names], "itemsize": at}, align=True,
    )  # fmt: skip
    return _followed_by(beginning, [(OPEN[0], first.base, (1, first.shape[-1]))])


def repeat_tile(tile: Array, count: int) -> Array:
    """``count`` copies of a tile, aligned like it: ``tiles[k : k + 1]`` is a tile."""
    tiles = _aligned(tile.dtype, count, np.empty)
    # as bytes: copying records field by field takes ten times as long
    tiles.view(np.uint8).reshape(count, -1)[...] = tile.view(np.uint8)
    return tiles


def _aligned(dtype: np.dtype[Any], count: int, make: Any = np.zeros) -> Array:
    """``count`` records, all zero unless ``make`` does not set them, the first at the start of a cache line."""
    raw = make(dtype.itemsize * count + 64, np.uint8)
    return np.ndarray(count, dtype, raw, -raw.ctypes.data % 64)


def output_type(tile: Array, outputs: Sequence[str] = (), keep: str = "std", dtype: Any = np.float64) -> np.dtype[Any]:
    """The record that is kept of one sample of a tile; in double precision, and not of theta alone, a driver writes it.

    P when ``keep`` is "cov"; the fields of the tile that ``outputs`` names; then theta, var, y_hat, e, s, ok; of
    "theta" that alone, and of "own" none of these. What is not common comes first: Numba takes a record that continues
    another one for the same type, with a warning.
    """
    return output_record(tile.dtype, tuple(outputs), keep, dtype)


@lru_cache(maxsize=256)
def output_record(
    tile: np.dtype[Any], outputs: tuple[str, ...], keep: str = "std", precision: Any = np.float64
) -> np.dtype[Any]:
    """The same, given the record of the tile."""
    dtype = np.dtype(precision)
    n, L = tile["theta"].shape
    common = {"theta": ("theta",), "own": ()}.get(keep, ("theta", "var", "y_hat", "e", "s", "ok"))
    names = common if keep == "theta" else (*outputs, *common)
    fields: list[Any] = [("P", dtype, (n, n, L))] if keep == "cov" else []
    for name in names:
        own = tile[name].base
        fields.append((name, dtype if own.kind == "f" else own, tile[name].shape))
    return _one_of(np.dtype(fields, align=True))


def tile_type(tile: Array) -> types.Type:
    """The compiler's type of a tile; finding it takes a millisecond, so it is kept for tiles of the same kind."""
    flags, dtype = tile.flags, tile.dtype
    key = (
        dtype,
        dtype.isalignedstruct,
        tile.ndim,
        flags.c_contiguous,
        flags.f_contiguous,
        flags.writeable,
        flags.aligned,
    )
    if key not in _TILE_TYPES:
        _TILE_TYPES[key] = numba.typeof(as_compiled(tile))
    return _TILE_TYPES[key]

"""The state of a lane as words of eight bytes, and packed: the same bytes on every machine, checked, without pickle.

All fields of a tile are numbers of eight bytes whose last axis is the lane, so that a tile of any number of lanes is a
matrix (words, lanes) with the same rows. The words of the fields that a tracker or its model only works in
(`driftfit.trackers.base.Tracker.scratch`) are left out.

A packed state is, with all numbers little-endian,

    bytes  0 .. 3     "DFst"
           4, 5       format, 2
           6, 7       1 if only the words that are not 0 are stored, after a bit for each word; otherwise 0
           8 .. 11    CRC-32 of all that follows
          12 .. 19    fingerprint of model, tracker and layout (`Layout.tag`)
          20 .. 23    number of words
          24 ..       the words, or bits and words

Packing and unpacking take a few microseconds for hundreds of words.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from math import prod
from struct import Struct
from typing import Any

import numpy as np

from driftfit.data import storage
from driftfit.engine.kernel import Array

MAGIC, FORMAT = b"DFst", 2
HEAD = Struct("<4sHHI8sI")
CRC_BEGIN = 12
"""The first byte that the CRC covers."""
TAG = slice(12, 20)
"""The fingerprint."""
SPARSE_WORDS = 512
"""From this number of words on, zeros are left out where that makes the bytes fewer."""
WORD = np.dtype("<i8")


def words_of(tile: Array) -> Array:
    """The fields of a tile as (words, lanes), a view: one column is the whole state of one lane."""
    L = tile["theta"].shape[-1]
    flat = tile.view(np.int64).reshape(-1)
    return flat[: len(flat) // L * L].reshape(-1, L)


class Layout:
    """The fields of a lane, those whose words a packed state holds, and whose state it is.

    ``names`` are the fields in the order of a packed state. ``owner`` describes model and tracker as plain data; with
    the fields it makes the fingerprint.
    """

    def __init__(
        self, record: np.dtype[Any], names: Sequence[str], scratch: Collection[str], owner: Mapping[str, Any]
    ) -> None:
        self.shapes: dict[str, tuple[str, tuple[int, ...]]] = {
            name: (record[name].base.kind, record[name].shape[:-1]) for name in names if name not in scratch
        }
        self.size = sum(prod(shape) for _, shape in self.shapes.values())
        """Words of a state, W."""
        self.owner = dict(owner)
        self._rows: dict[int, Array] = {}

    def rows(self, tile: Array) -> Array:
        """The rows (W,) of `words_of` that a packed state holds.

        They depend on the number of lanes, because what fills the cache line between fields does.
        """
        lanes = tile["theta"].shape[-1]
        if lanes not in self._rows:
            places: Mapping[str, Any] = tile.dtype.fields or {}
            starts = (places[name][1] // (8 * lanes) for name in self.shapes)
            counts = (prod(shape) for _, shape in self.shapes.values())
            self._rows[lanes] = np.concatenate([at + np.arange(n) for at, n in zip(starts, counts, strict=True)])
        return self._rows[lanes]

    @cached_property
    def text(self) -> str:
        """Names, kinds and shapes of the fields in order, as in "theta:f4 P:f4,4 rank:i"."""
        return " ".join(f"{name}:{kind}{','.join(map(str, shape))}" for name, (kind, shape) in self.shapes.items())

    @cached_property
    def tag(self) -> bytes:
        """Fingerprint of model, tracker and layout, 8 bytes."""
        plain = json.dumps([self.owner, self.text], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(plain.encode()).digest()[:8]

    def taken(self, tile: Array) -> Array:
        """The words (lanes, W) of the lanes of a tile."""
        return np.ascontiguousarray(words_of(tile)[self.rows(tile)].T)

    def put(self, tile: Array, lanes: Any, words: Array) -> None:
        """Set lanes of a tile to states, (W,) or (lanes, W)."""
        words_of(tile)[self.rows(tile)[:, None], lanes] = words.reshape(-1, self.size).T

    def field(self, words: Array, name: str) -> Array:
        """A field of states (.., W), as (.., k)."""
        at = 0
        for one, (kind, shape) in self.shapes.items():
            if one == name:
                found = np.ascontiguousarray(words[..., at : at + prod(shape)])
                return found if kind == "i" else found.view(np.float64)
            at += prod(shape)
        raise KeyError(name)

    def pack(self, words: Array) -> bytes:
        """A state (W,) as bytes."""
        return packed(self.tag, words)

    def unpack(self, data: bytes) -> Array:
        """The inverse of `pack`; ValueError for anything else."""
        return own_words(data, self.tag, self.size, self.owner)


def own_words(data: bytes, tag: bytes, size: int, owner: Any) -> Array:
    """The words of a packed state with this fingerprint and size; ValueError for anything else."""
    found, words = unpacked(data)
    if found != tag or len(words) != size:
        raise ValueError(
            "the bytes hold a state of another model, tracker, gate, setting or version: their fingerprint is "
            f"{found.hex()}, that of {owner} is {tag.hex()}. Use the model, tracker and gate that made them, "
            "carry the state over field by field with warm_start=, or run the record again."
        )
    return words


def packed(tag: bytes, words: Array) -> bytes:
    """Words (W,) as bytes, with a fingerprint."""
    body, sparse = words.astype(WORD, copy=False).tobytes(), 0
    if len(words) >= SPARSE_WORDS:
        there = words != 0
        shorter = np.packbits(there).tobytes() + words[there].astype(WORD, copy=False).tobytes()
        body, sparse = (shorter, 1) if len(shorter) < len(body) else (body, 0)
    head = HEAD.pack(MAGIC, FORMAT, sparse, 0, tag, len(words))
    check = zlib.crc32(body, zlib.crc32(head[CRC_BEGIN:]))
    return HEAD.pack(MAGIC, FORMAT, sparse, check, tag, len(words)) + body


def unpacked(data: bytes) -> tuple[bytes, Array]:
    """(fingerprint, words); ValueError for bytes that are damaged, of a newer format, or no packed state."""
    if len(data) < HEAD.size or data[:4] != MAGIC:
        raise ValueError(f"{len(data)} bytes that are not a packed state, which begins with {MAGIC!r}.")
    _, version, sparse, check, tag, count = HEAD.unpack_from(data)
    if version > FORMAT:
        raise ValueError(f"the state was packed by a newer driftfit (format {version}); this one reads {FORMAT}.")
    if version < FORMAT:
        raise ValueError(f"the state was packed by an older driftfit (format {version}), {storage.REMEDY}.")
    if zlib.crc32(memoryview(data)[CRC_BEGIN:]) != check or sparse > 1:
        raise ValueError("the packed state is damaged: its check sum does not fit its content.")
    if not sparse:
        return tag, np.frombuffer(data, WORD, count, HEAD.size).astype(np.int64, copy=False)
    bits = -(-count // 8)
    there = np.unpackbits(np.frombuffer(data, np.uint8, bits, HEAD.size), count=count).astype(bool)
    words = np.zeros(count, np.int64)
    words[there] = np.frombuffer(data, WORD, int(there.sum()), HEAD.size + bits)
    return tag, words


def tag_of(data: bytes) -> bytes:
    """The fingerprint in a packed state, which is not checked."""
    return data[TAG]

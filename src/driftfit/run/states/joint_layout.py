"""The programs of a series, one for each output, and their states as one: the words of the outputs one after the other.

A series with one output has the packed state of its program, bit for bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.program import Program, State, tile_of
from driftfit.run.states.layout import fields_of, packed, unpacked


class JointLayout:
    """The programs of a series; all of one model and one kind of tracker."""

    def __init__(self, programs: Sequence[Program]) -> None:
        self.programs = tuple(programs)

    def __repr__(self) -> str:
        return f"JointLayout({', '.join(map(repr, self.programs))})"

    @cached_property
    def size(self) -> int:
        """Words of a state, W."""
        return sum(one.layout.size for one in self.programs)

    @cached_property
    def tag(self) -> bytes:
        """Fingerprint of all programs, 8 bytes."""
        return self._tag([one.layout.tag for one in self.programs])

    def _tag(self, tags: Sequence[bytes]) -> bytes:
        return tags[0] if len(tags) == 1 else hashlib.sha256(b"".join(tags)).digest()[:8]

    @cached_property
    def text(self) -> str:
        """The fields of one program (`Layout.text`); all have the same."""
        return self.programs[0].layout.text

    @cached_property
    def start(self) -> bytes:
        """The packed state before the first sample."""
        return self.pack(self.taken(self.tile()))

    def tile(self, states: Sequence[State] = ()) -> Array:
        """A tile with a lane for each output, at its start or with the given fields."""
        return tile_of(self.programs, states)

    def taken(self, tile: Array) -> Array:
        """The words (W,) of the lanes of a tile."""
        words: Array = self.programs[0].layout.taken(tile)
        return words.reshape(-1)

    def filled(self, words: Array) -> Array:
        """A tile with a state (W,)."""
        tile = self.tile()
        self.programs[0].layout.put(tile, np.arange(len(self.programs)), words)
        return tile

    def field(self, words: Array, name: str) -> Array:
        """A field of numbers of a state (W,), as (ny, k)."""
        return self.programs[0].layout.field(words.reshape(len(self.programs), -1), name)

    def pack(self, words: Array) -> bytes:
        """A state (W,) as bytes."""
        return packed(self.tag, words)

    def unpack(self, data: bytes) -> Array:
        """The inverse of `pack`; ValueError for anything else."""
        if len(self.programs) == 1:
            return self.programs[0].layout.unpack(data)
        tag, words = unpacked(data)
        if tag != self.tag or len(words) != self.size:
            raise ValueError(
                f"the bytes hold a state of another model, tracker, gate, setting or version: their fingerprint is "
                f"{tag.hex()}, that of {self.programs} is {self.tag.hex()}."
            )
        return words

    def made_by(self, tag: bytes, text: str) -> bool:
        """Whether a state with this fingerprint belongs to these programs in a version with other fields
        (`Layout.text`).
        """
        return tag == self._tag([one.layout.tag_with(text) for one in self.programs])

    def matched(self, words: Array, text: str) -> Array:
        """The words (W,) of a state in a version with other fields; words that are absent have their values at the
        start.

        ValueError if a field has another shape.
        """
        tile = self.tile()
        for lane, one in enumerate(words.reshape(len(self.programs), -1)):
            for name, value in fields_of(text, one).items():
                if name not in self.programs[0].layout.shapes:
                    continue
                if value.shape != tile[name][0, ..., lane].shape:
                    raise ValueError(f"the state of that version does not fit this one: field {name!r}.")
                tile[name][0, ..., lane] = value
        return self.taken(tile)

"""What an exported tracker consists of: the translated steps, and the fields of the record that they need.

A field that no step writes keeps the value that it starts with. Where all its entries are equal, that value becomes a
constant of the text, and branches that it excludes are left out: a `Kalman` that is given ``p0`` does not contain the
exact diffuse start. To find these fields we assume that none is written, translate, give up the assumption for those
that are written after all, and repeat until there are none. What the caller may change remains a field: the known
factors of the next sample, and the settings of the tracker.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from driftfit.data.storage import fields
from driftfit.embedded.statements import translate
from driftfit.embedded.unit import Function, Unit
from driftfit.embedded.values import Value
from driftfit.engine.drivers import drivers
from driftfit.engine.kernel import Array
from driftfit.run.program import Program, State

FACTORS = ("interval", "noise", "drift")
"""Fields that describe the next sample."""

RESULTS = ("theta", "var")


@dataclass(frozen=True)
class Translation:
    """The functions in C, the one that takes a sample, and the record's fields that the structure has."""

    unit: Unit
    entry: Function
    names: tuple[str, ...]

    @property
    def start(self) -> Array:
        """The record before the first sample."""
        return self.unit.record

    def size(self, real: int) -> int:
        """Bytes of the structure when a real number has so many."""
        at, widest = 0, real
        for name in self.names:
            array = self.start[name][0]
            width = 8 if array.dtype.kind == "i" else real
            at += -at % width + width * array.size
            widest = max(widest, width)
        return at + -at % widest

    def bytes_of(self, state: State) -> bytes:
        """The structure of the double-precision build with this state.

        Raises
        ------
        ValueError
            If a field whose value is a constant in C has another value.
        """
        for name in sorted(self.unit.replaced):
            if not np.array_equal(state[name], self.start[name][0, ..., 0], equal_nan=True):
                raise ValueError(
                    f"to_struct: the field {name!r} is {state[name].tolist()} in this stream; the exported tracker "
                    f"has {self.start[name][0, ..., 0].tolist()} as a constant."
                )
        return b"".join(np.ascontiguousarray(state[name]).tobytes() for name in self.names)

    def read(self, state: State, data: bytes) -> None:
        """Write the structure's bytes into the fields of a record."""
        at = 0
        for name in self.names:
            values = np.frombuffer(data, state[name].dtype, state[name].size, at)
            state[name][...] = values.reshape(state[name].shape)
            at += values.nbytes


@lru_cache(maxsize=16)
def translation(program: Program) -> Translation:
    """Translate the steps of a model and a tracker."""
    tile = program.tile()
    steps = program.steps
    update = drivers(program.model.steps_for(steps.doubts), steps).update.function
    u = Value("array", "u", shape=(program.model.m,), strides=(1,))
    constant = frozenset(fields(tile)) - {*FACTORS, *RESULTS, *program.tracker.settings()}
    while True:
        unit = Unit(tile, constant)
        entry = translate(unit, update, [Value("tile"), Value("real", "y"), u])
        if not constant & unit.written:
            break
        constant -= unit.written
    text = "\n".join(function.text for function in unit.functions.values())
    read = {*re.findall(r"\bs->(\w+)", text), *FACTORS, *RESULTS}
    return Translation(unit, entry, tuple(name for name in fields(tile) if name in read))

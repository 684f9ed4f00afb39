"""The parts of an exported tracker: the translated steps, and the fields of the record that they need.

A field that no step writes keeps the value that it starts with. Where all its entries are equal, that value becomes a
constant of the text, and branches that it excludes are left out. A field to which steps assign only 0 and 1 becomes an
integer, because comparing numbers in double precision takes 50 cycles on a processor that does it in software. To find
these fields we assume that none is written, and that all contain 0 or 1, translate, give up the assumptions that turned
out wrong, and repeat until none does. Everything that the caller may change remains a field: the settings of the
tracker and, unless the samples come at a fixed rate, the known factors of the next sample.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.data.storage import fields
from driftfit.embedded.functions import translate
from driftfit.embedded.names import identifier
from driftfit.embedded.unit import Function, Unit
from driftfit.embedded.values import Value
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

    def type_of(self, name: str) -> str:
        """The type of a field's numbers in C."""
        if name in self.unit.flags:
            return "int"
        return "int64_t" if self.start[name].dtype.kind == "i" else "tracker_real"

    def layout(self, real: int) -> np.dtype[Any]:
        """The structure as the C compiler lays it out, when a real number has so many bytes."""
        types = {"int": "i4", "int64_t": "i8", "tracker_real": f"f{real}"}
        return np.dtype([(name, types[self.type_of(name)], self.start.dtype[name].shape[:-1]) for name in self.names],
                        align=True)  # fmt: skip

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
        structure = np.zeros(1, self.layout(8))
        for name in self.names:
            structure[name][0] = state[name]
        return structure.tobytes()

    def read(self, state: State, data: bytes) -> None:
        """Write the structure's bytes into the fields of a record."""
        structure = np.frombuffer(data, self.layout(8))
        for name in self.names:
            state[name][...] = structure[name][0]


@lru_cache(maxsize=16)
def translation(program: Program, fixed_rate: bool = False) -> Translation:
    """Translate the steps of a model and a tracker."""
    tile = program.tile()
    update = program.drivers().update.function
    u = Value("array", "u", shape=(program.model.m,), strides=(1,))
    factors = () if fixed_rate else FACTORS
    constant = frozenset(fields(tile)) - {*factors, *RESULTS, *program.tracker.settings()}
    flags = frozenset(name for name in constant if _may_be_flag(tile[name][0]))
    while True:
        unit = Unit(tile, constant, flags)
        entry = translate(unit, update, [Value("tile"), Value("real", "y"), u])
        if not (constant & unit.written or flags & unit.beyond):
            break
        constant, flags = constant - unit.written, flags - unit.beyond
    text = "\n".join(function.text for function in unit.functions.values())
    read = {*re.findall(r"\bs->(\w+)", text), *factors, *RESULTS}
    names = [name for name in fields(tile) if identifier(name) in read]
    return Translation(unit, entry, tuple(sorted(names, key=lambda name: name in flags)))  # no gaps: integers last


def _may_be_flag(start: Array) -> bool:
    """Whether a field is one floating-point number that starts as 0 or 1."""
    return start.size == 1 and start.dtype.kind == "f" and start.item() in (0.0, 1.0) and not np.signbit(start.item())

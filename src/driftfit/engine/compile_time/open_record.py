"""Records of one lane whose sizes are known at run time only, so that code for them is compiled once for all sizes.

A record of lanes has its shapes in its type, and what is compiled for n parameters is of no use for n + 1. For steps
that run seldom the speed of that is not worth the time of compiling. They see an `OpenRecord`: the address of a record
and of a table of its sizes, which the driver holds as a constant. For each field that they name the table has the
distance from the beginning of the record, and the lengths of its axes but for that of lanes, which is 1. Records that
have these fields are of one type, whatever else they hold.

The tables of banks (`driftfit.bank.table`) are not of this kind: their arrays lie in several memories, whose
places are known when a bank runs, and their numbers in the table itself. An open record is made where code is compiled.

Private parts: `AttributeTemplate`, `infer_getattr`, `make_array` and `populate_array`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, lower_getattr_generic, models, register_model
from numba.np.arrayobj import populate_array

__all__ = [
    "WORD",
    "AttributeTemplate",
    "OpenRecord",
    "array_from",
    "beginning",
    "cgutils",
    "entry_of",
    "ir",
    "lengths",
    "opened",
    "tell_fields_apart",
]

WORD = ir.IntType(64)
"""An entry of the table."""


class OpenRecord(types.Type):
    """A record of one lane, of which some fields, their types and numbers of axes are known."""

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self.arrays, self.places, place = {}, {}, 0
        for name, field in fields.items():
            self.arrays[name] = types.Array(field.type.dtype, field.type.ndim, "C")
            self.places[name] = place
            place += field.type.ndim
        super().__init__(f"OpenRecord({', '.join(f'{name}: {array}' for name, array in self.arrays.items())})")

    @property
    def mangling_args(self) -> tuple[str, tuple[int]]:
        """The name of the type in symbols: as for records, not the long one."""
        return type(self).__name__, (self._code,)

    def typeof(self, name: str) -> Any:
        """The type of a field."""
        return self.arrays[name]


@infer_getattr
class _Fields(AttributeTemplate):
    """A field of an open record is an array."""

    key = OpenRecord

    def generic_resolve(self, record: OpenRecord, name: str) -> Any:
        return record.arrays[name]


@register_model(OpenRecord)
class _Pair(models.StructModel):
    """An address and a table."""

    def __init__(self, manager: Any, kind: Any) -> None:
        pointers = [("record", types.CPointer(types.uint8)), ("table", types.CPointer(types.int64))]
        super().__init__(manager, kind, pointers)


def opened(context: Any, builder: Any, fields: Mapping[str, Any], address: Any) -> Any:
    """The record of lanes at an address, as an `OpenRecord` of some of its fields, while code is built."""
    numbers = [n for field in fields.values() for n in (field.offset, *field.type.shape[:-1])]
    table = ir.Constant(ir.ArrayType(WORD, len(numbers)), numbers)
    made = cgutils.create_struct_proxy(OpenRecord(fields))(context, builder)
    made.record = builder.bitcast(address, made.record.type)
    made.table = builder.bitcast(cgutils.global_constant(builder, "sizes", table), made.table.type)
    return made._getvalue()


def entry_of(builder: Any, table: Any, place: int) -> Any:
    """An entry of a table, which is the same whenever it is read."""
    loaded = builder.load(builder.gep(table, [WORD(place)]))
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


def entry(builder: Any, record: Any, place: int) -> Any:
    """An entry of the table of a record."""
    return entry_of(builder, builder.extract_value(record, 1), place)


def beginning(context: Any, builder: Any, record: Any, kind: OpenRecord, name: str) -> Any:
    """The address of the first entry of a field."""
    place = builder.gep(builder.extract_value(record, 0), [entry(builder, record, kind.places[name])])
    return builder.bitcast(place, context.get_data_type(kind.typeof(name).dtype).as_pointer())


def lengths(context: Any, builder: Any, record: Any, kind: OpenRecord, name: str) -> list[Any]:
    """The lengths of the axes of a field."""
    first, axes = kind.places[name] + 1, kind.typeof(name).ndim - 1
    return [*(entry(builder, record, first + k) for k in range(axes)), WORD(1)]


def array_from(context: Any, builder: Any, array: Any, data: Any, shape: Sequence[Any]) -> Any:
    """The C array of a type and shape whose first entry is at ``data``, while code is built."""
    made = context.make_array(array)(context, builder)
    strides = [context.get_constant(types.intp, context.get_abi_sizeof(data.type.pointee))]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    populate_array(made, data=data, shape=list(shape), strides=strides, itemsize=strides[-1], meminfo=None)
    return made._getvalue()


@lower_getattr_generic(OpenRecord)
def _read(context: Any, builder: Any, kind: OpenRecord, record: Any, name: str) -> Any:
    data = beginning(context, builder, record, kind, name)
    return array_from(context, builder, kind.arrays[name], data, lengths(context, builder, record, kind, name))


def tell_fields_apart(builder: Any, name: str, access: Any) -> None:
    """Mark a read or a write of a field: no other field is in the same place, which follows from offsets if they are
    constants. Without it loops over several fields are not made of SIMD instructions.
    """
    note = builder.module.add_metadata
    field = note([name, note(["open record"]), WORD(0)])
    access.set_metadata("tbaa", note([field, field, WORD(0)]))

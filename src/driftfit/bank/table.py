"""A table: dozens of arrays and numbers behind one address, as the one argument of the parts of a compiled routine.

    at = table_at(TableType({"leaves": (0, MATRIX, 2), "n": (1, NUMBER, 2), ..}, {"clock": (3, types.int64, 0), ..}))

A row of a table is that of a field: an offset in bytes, rows, columns; the first column of a number holds the number.
The offsets of arrays count from the address in the row of their base. In compiled code ``t = at(address)`` gives the
table, ``t.leaves`` an array, and ``t.clock += 1`` counts in a variable, which is an
entry of an array of variables. Rows do not change while compiled code runs, so the compiler reads each once.

Passing the arrays themselves costs the compiler most of its time: each one is nine values, of every call on the way.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from numba import types
from numba.extending import infer_getattr, lower_getattr_generic, lower_setattr_generic, models, register_model

from driftfit.engine.numba_internals import WORD, AttributeTemplate, array_at, entry_of, named_intrinsic

MATRIX, VECTOR, COUNTS, NUMBER = "matrix", "vector", "counts", "number"
"""Kinds of fields: floats (rows, columns), floats (columns,), whole numbers (columns,), one whole number."""
_KINDS = {
    MATRIX: types.Array(types.float64, 2, "C"), VECTOR: types.Array(types.float64, 1, "C"),
    COUNTS: types.Array(types.int64, 1, "C"), NUMBER: types.int64,
}  # fmt: skip


class TableType(types.Type):
    """A table, as the compiler sees it: (row, kind, row of the base) of each field; (row of the base, type, place) of
    each variable.
    """

    def __init__(self, rows: Mapping[str, Any], variables: Mapping[str, Any]) -> None:
        self.rows, self.variables = dict(rows), dict(variables)
        text = f"{self.rows}{self.variables}"  # which is 4 kB of every symbol
        digest = hashlib.sha256(text.encode()).hexdigest()
        super().__init__(name=f"driftfit.Table({digest[:16]})")


@register_model(TableType)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, WORD.as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = TableType

    def generic_resolve(self, table: TableType, name: str) -> Any:
        if name in table.variables:
            return table.variables[name][1]
        return _KINDS[table.rows[name][1]] if name in table.rows else None


def _variable(context: Any, builder: Any, table: TableType, value: Any, name: str) -> Any:
    """The pointer to a variable."""
    row, kind, place = table.variables[name]
    address = builder.add(entry_of(builder, value, 3 * row), WORD(8 * place))
    return builder.inttoptr(address, context.get_data_type(kind).as_pointer())


@lower_getattr_generic(TableType)
def _read(context: Any, builder: Any, table: TableType, value: Any, name: str) -> Any:
    if name in table.variables:
        return builder.load(_variable(context, builder, table, value, name))
    row, kind, base = table.rows[name]

    def entry(row: int, column: int) -> Any:
        return entry_of(builder, value, 3 * row + column)

    if kind == NUMBER:
        return entry(row, 0)
    shape = [entry(row, 1), entry(row, 2)][-_KINDS[kind].ndim :]
    return array_at(context, builder, _KINDS[kind], builder.add(entry(base, 0), entry(row, 0)), shape)


@lower_setattr_generic(TableType)
def _write(context: Any, builder: Any, signature: Any, given: Any, name: str) -> None:
    builder.store(given[1], _variable(context, builder, signature.args[0], given[0], name))


def table_at(kind: TableType) -> Any:
    """The intrinsic that returns the table at an address."""

    def typed(context: Any, address: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            return builder.inttoptr(given[0], WORD.as_pointer())

        return kind(types.intp), build

    return named_intrinsic(kind.name, typed)

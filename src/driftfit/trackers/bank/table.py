"""A table: dozens of arrays and numbers behind one address, as the one argument of the parts of a compiled routine.

    TABLE = Table("bank", {"leaves": MATRIX, "group": COUNTS, "n": NUMBER, ..}, bases=("memory", "report"))

Row k of a table is that of the k-th field: an offset in bytes, rows, columns; the first column of a number holds the
number. The offsets of arrays count from the address in the row of their base. In compiled code
``t = TABLE.at(address)``
gives the table and ``t.leaves`` an array. Rows do not change while compiled code runs, so the compiler reads each once.

Passing the arrays themselves costs the compiler most of its time: each one is nine values, of every call on the way.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from numba import types
from numba.extending import infer_getattr, lower_getattr_generic, models, register_model

from driftfit.engine.numba_internals import WORD, AttributeTemplate, array_at, entry_of, named_intrinsic

MATRIX, VECTOR, COUNTS, NUMBER = "matrix", "vector", "counts", "number"
"""Kinds of fields: floats (rows, columns), floats (columns,), whole numbers (columns,), one whole number."""
_KINDS = {
    MATRIX: types.Array(types.float64, 2, "C"), VECTOR: types.Array(types.float64, 1, "C"),
    COUNTS: types.Array(types.int64, 1, "C"), NUMBER: types.int64,
}  # fmt: skip


class TableType(types.Type):
    """A table, as the compiler sees it."""

    def __init__(self, name: str, rows: Mapping[str, tuple[int, str, int]]) -> None:
        self.rows = dict(rows)
        digest = hashlib.sha256(str(self.rows).encode()).hexdigest()  # the rows themselves are 4 kB of every symbol
        super().__init__(name=f"driftfit.Table({name}, {digest[:16]})")


@register_model(TableType)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, WORD.as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = TableType

    def generic_resolve(self, table: TableType, name: str) -> Any:
        return _KINDS[table.rows[name][1]] if name in table.rows else None


@lower_getattr_generic(TableType)
def _read(context: Any, builder: Any, table: TableType, value: Any, name: str) -> Any:
    row, kind, base = table.rows[name]

    def entry(row: int, column: int) -> Any:
        return entry_of(builder, value, 3 * row + column)

    if kind == NUMBER:
        return entry(row, 0)
    shape = [entry(row, 1), entry(row, 2)][-_KINDS[kind].ndim :]
    return array_at(context, builder, _KINDS[kind], builder.add(entry(base, 0), entry(row, 0)), shape)


class Table:
    """The fields of a table: their kinds and rows, and the intrinsic that returns a table at an address.

    ``based`` maps fields to their base if it is not the first one.
    """

    def __init__(self, name: str, fields: Mapping[str, str], bases: tuple[str, ...], based: Mapping[str, str]) -> None:
        places = (*fields, *bases)
        self.row = {field: row for row, field in enumerate(places)}
        """Rows by the names of fields and bases."""
        rows = {field: (self.row[field], kind, self.row[based.get(field, bases[0])]) for field, kind in fields.items()}
        kind = TableType(name, rows)

        def typed(context: Any, address: Any) -> Any:
            def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
                return builder.inttoptr(given[0], WORD.as_pointer())

            return kind(types.intp), build

        self.at = named_intrinsic(kind.name, typed)

"""A table: dozens of arrays and numbers behind one address, as the one argument of the parts of a compiled routine.

    TABLE = Table("bank", {"leaves": MATRIX, "group": COUNTS, "n": NUMBER, ..}, bases=("memory", "report"), ..)

Row k of a table is that of the k-th field: an offset in bytes, rows, columns; the first column of a number holds the
number. The offsets of arrays count from the address in the row of their base. In compiled code
``t = TABLE.at(address)`` gives the table, ``t.leaves`` an array, and ``t.clock += 1`` counts in a variable, which is an
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
    """A table, as the compiler sees it."""

    def __init__(self, name: str, rows: Mapping[str, Any], variables: Mapping[str, Any]) -> None:
        self.rows, self.variables = dict(rows), dict(variables)
        text = f"{self.rows}{self.variables}"  # which is 4 kB of every symbol
        digest = hashlib.sha256(text.encode()).hexdigest()
        super().__init__(name=f"driftfit.Table({name}, {digest[:16]})")


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


class Table:
    """The fields of a table: their kinds and rows, and the intrinsic that returns a table at an address.

    ``based`` maps fields to their base if it is not the first one; ``variables`` maps bases to the names of the
    variables that lie there, whole numbers or not.
    """

    def __init__(
        self,
        name: str,
        fields: Mapping[str, str],
        bases: tuple[str, ...],
        based: Mapping[str, str],
        variables: Mapping[str, tuple[Any, tuple[str, ...]]],
    ) -> None:
        places = (*fields, *bases)
        self.row = {field: row for row, field in enumerate(places)}
        """Rows by the names of fields and bases."""
        rows = {field: (self.row[field], kind, self.row[based.get(field, bases[0])]) for field, kind in fields.items()}
        entries = {
            one: (self.row[base], kind, place)
            for base, (kind, names) in variables.items()
            for place, one in enumerate(names)
        }
        kind = TableType(name, rows, entries)

        def typed(context: Any, address: Any) -> Any:
            def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
                return builder.inttoptr(given[0], WORD.as_pointer())

            return kind(types.intp), build

        self.at = named_intrinsic(kind.name, typed)

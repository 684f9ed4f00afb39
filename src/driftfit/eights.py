"""Eight numbers at once, for machines whose rows are short.

A compiler that vectorises a loop of unknown length puts checks before it and a remainder after it, which cost more than
the loop where rows have a dozen entries. A loop over eights has neither:

    for l in range(0, count, 8):
        store(a, i, l, minus(load(b, j, l), times(load(c, k, l), load(d, m, l))))

Rows must have room up to the next multiple of eight, and something finite there. Each operation is rounded by itself,
as those of single numbers. Indices count from the front and are not checked.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.datamodel import models, register_default
from numba.extending import intrinsic

WIDTH = 8
_EIGHT = ir.VectorType(ir.DoubleType(), WIDTH)


class Eight(types.Type):
    """Eight floats, as the compiler sees them."""

    def __init__(self) -> None:
        super().__init__(name="driftfit.Eight")


@register_default(Eight)
class _Vector(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _EIGHT)


eight = Eight()


def _named(name: str, build: Any) -> Any:
    """An operation with a name of its own: Numba would number it anew in every process, and find no caller on disk."""
    operation = intrinsic(build)
    operation.identity = f"eights.{name}"
    operation._set_uuid(operation.identity)
    return operation


def _place(context: Any, builder: Any, kind: Any, array: Any, row: Any, column: Any) -> Any:
    """The address of entry [row, column]."""
    inside = context.make_array(kind)(context, builder, array)
    columns = builder.extract_value(inside.shape, 1)
    first = builder.gep(inside.data, [builder.add(builder.mul(row, columns), column)])
    return builder.bitcast(first, _EIGHT.as_pointer())


def _load(context: Any, array: Any, row: Any, column: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.load(_place(context, builder, signature.args[0], *given), align=8)

    return eight(array, types.intp, types.intp), build


def _store(context: Any, array: Any, row: Any, column: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        builder.store(given[3], _place(context, builder, signature.args[0], *given[:3]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, eight), build


def _fill(context: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        one = builder.insert_element(ir.Constant(_EIGHT, ir.Undefined), given[0], ir.Constant(ir.IntType(32), 0))
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return builder.shuffle_vector(one, one, everywhere)

    return eight(types.float64), build


def _two(operation: str) -> Any:
    def typed(context: Any, a: Any, b: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            return getattr(builder, operation)(*given)

        return eight(eight, eight), build

    return typed


def _reaches(context: Any, a: Any, b: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        one, zero = (ir.Constant(_EIGHT, [x] * WIDTH) for x in (1.0, 0.0))
        return builder.select(builder.fcmp_ordered(">=", *given), one, zero)

    return eight(eight, eight), build


def _sum(context: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        parts = [builder.extract_element(given[0], ir.Constant(ir.IntType(32), k)) for k in range(WIDTH)]
        while len(parts) > 1:
            half = len(parts) // 2
            parts = [builder.fadd(parts[k], parts[k + half]) for k in range(half)]
        return parts[0]

    return types.float64(eight), build


load = _named("load", _load)
"""Entries [row, column] to [row, column + 7] of a matrix."""
store = _named("store", _store)
"""The same, written."""
fill = _named("fill", _fill)
"""One number, eight times."""
plus, minus, times, over = (
    _named(name, _two(operation))
    for name, operation in (("plus", "fadd"), ("minus", "fsub"), ("times", "fmul"), ("over", "fdiv"))
)
reaches = _named("reaches", _reaches)
"""1 where the first is at least the second, 0 elsewhere."""
sum_of = _named("sum_of", _sum)
"""The sum of the eight, in pairs."""

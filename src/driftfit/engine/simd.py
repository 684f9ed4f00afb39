"""SIMD vectors of eight numbers, or two, for compiled routines that work on short rows.

A compiler that vectorises a loop of unknown length puts checks before it and a remainder after it, which cost more than
the loop where rows have a dozen entries. A loop over vectors has neither:

    for l in range(0, count, 8):
        store(a, i, l, minus(load(b, j, l), times(load(c, k, l), load(d, m, l))))

Rows must have room up to the next multiple of eight, and something finite there. Each operation is rounded by itself,
as those of single numbers. Indices count from the front and are not checked.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import models, register_model

from driftfit.engine.kernel import ARTANH, EXP, LOG2, LOG2_HIGH, LOG2_LOW, ROUND, kernel
from driftfit.engine.numba_internals import ir, named_intrinsic

WIDTH = 8
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_VECTOR8, _WHOLE = ir.VectorType(ir.DoubleType(), WIDTH), ir.VectorType(_I64, WIDTH)
_VECTOR2 = ir.VectorType(ir.DoubleType(), 2)


class Vector8(types.Type):
    """A vector of eight floats, as the compiler sees it."""

    def __init__(self) -> None:
        super().__init__(name="driftfit.Vector8")


class Vector2(types.Type):
    """A vector of two floats: two chains of operations that are the same, with arrays whose last axis is the chain."""

    def __init__(self) -> None:
        super().__init__(name="driftfit.Vector2")


@register_model(Vector8)
class _Model8(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR8)


@register_model(Vector2)
class _Model2(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR2)


vector8, vector2 = Vector8(), Vector2()


def _named(name: str, build: Any) -> Any:
    """An operation that Numba compiles under the same name in every process."""
    return named_intrinsic(f"simd.{name}", build)


def _place(context: Any, builder: Any, kind: Any, array: Any, row: Any, column: Any) -> Any:
    """The address of entry [row, column]."""
    inside = context.make_array(kind)(context, builder, array)
    columns = builder.extract_value(inside.shape, 1)
    first = builder.gep(inside.data, [builder.add(builder.mul(row, columns), column)])
    return builder.bitcast(first, _VECTOR8.as_pointer())


def _load(context: Any, array: Any, row: Any, column: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.load(_place(context, builder, signature.args[0], *given), align=8)

    return vector8(array, types.intp, types.intp), build


def _store(context: Any, array: Any, row: Any, column: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        builder.store(given[3], _place(context, builder, signature.args[0], *given[:3]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, vector8), build


def _fill(context: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _spread(builder, given[0], _VECTOR8)

    return vector8(types.float64), build


def _pair_place(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    """The address of pair ``at`` of an array, counted over all its axes but the last."""
    inside = context.make_array(kind)(context, builder, array)
    first = builder.gep(inside.data, [builder.shl(at, ir.Constant(_I64, 1))])
    return builder.bitcast(first, _VECTOR2.as_pointer())


def _pair(context: Any, array: Any, at: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.load(_pair_place(context, builder, signature.args[0], *given), align=8)

    return vector2(array, types.intp), build


def _put_pair(context: Any, array: Any, at: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        builder.store(given[2], _pair_place(context, builder, signature.args[0], *given[:2]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector2), build


def _assembled(builder: Any, entries: Any, kind: Any) -> Any:
    made = ir.Constant(kind, ir.Undefined)
    for k, entry in enumerate(entries):
        made = builder.insert_element(made, entry, ir.Constant(_I32, k))
    return made


def _two_of(context: Any, first: Any, second: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _assembled(builder, given, _VECTOR2)

    return vector2(types.float64, types.float64), build


def _one_of(context: Any, vector: Any, k: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.extract_element(given[0], builder.trunc(given[1], ir.IntType(32)))

    return types.float64(vector, types.intp), build


def _gather(context: Any, array: Any, row: Any, order: Any, k: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        where = context.make_array(signature.args[2])(context, builder, given[2])
        indices = builder.bitcast(builder.gep(where.data, [given[3]]), _WHOLE.as_pointer())
        first = _place(context, builder, signature.args[0], given[0], given[1], ir.Constant(_I64, 0))
        start = _spread(builder, builder.ptrtoint(first, _I64), _WHOLE)
        bytes_ = builder.shl(builder.load(indices, align=8), ir.Constant(_WHOLE, [3] * WIDTH))
        kind = ir.VectorType(ir.DoubleType().as_pointer(), WIDTH)
        name, mask = "llvm.masked.gather.v8f64.v8p0", ir.Constant(ir.VectorType(ir.IntType(1), WIDTH), [1] * WIDTH)
        given_by = ir.FunctionType(_VECTOR8, [kind, ir.IntType(32), mask.type, _VECTOR8])
        gather = builder.module.globals.get(name) or ir.Function(builder.module, given_by, name)
        places = builder.inttoptr(builder.add(start, bytes_), kind)
        return builder.call(gather, [places, ir.Constant(ir.IntType(32), 8), mask, ir.Constant(_VECTOR8, ir.Undefined)])

    return vector8(array, types.intp, order, types.intp), build


def _spread(builder: Any, value: Any, kind: Any) -> Any:
    """A vector with one number in all places."""
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    everywhere = ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
    return builder.shuffle_vector(one, one, everywhere)


def _compare(sign: str) -> Any:
    def typed(context: Any, array: Any, at: Any, value: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            inside = context.make_array(signature.args[0])(context, builder, given[0])
            first = builder.bitcast(builder.gep(inside.data, [given[1]]), _WHOLE.as_pointer())
            other = _spread(builder, given[2], _WHOLE)
            return _one_where(builder, builder.icmp_signed(sign, builder.load(first, align=8), other))

        return vector8(array, types.intp, types.intp), build

    return typed


def _one_where(builder: Any, true: Any) -> Any:
    one, zero = (ir.Constant(_VECTOR8, [x] * WIDTH) for x in (1.0, 0.0))
    return builder.select(true, one, zero)


def _pick(sign: str) -> Any:
    def typed(context: Any, a: Any, b: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            return builder.select(builder.fcmp_ordered(sign, *given), *given)

        return a(a, a), build

    return typed


def _only(context: Any, a: Any, b: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        zero = ir.Constant(given[0].type, [0.0] * given[0].type.count)
        return builder.select(builder.fcmp_ordered(">", given[1], zero), given[0], zero)

    return a(a, a), build


def _power_of_two(context: Any, a: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        whole = builder.add(builder.fptosi(given[0], _WHOLE), ir.Constant(_WHOLE, [1023] * WIDTH))
        return builder.bitcast(builder.shl(whole, ir.Constant(_WHOLE, [52] * WIDTH)), _VECTOR8)

    return vector8(vector8), build


def _exponent_of(context: Any, a: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        shifted = builder.ashr(builder.bitcast(given[0], _WHOLE), ir.Constant(_WHOLE, [52] * WIDTH))
        return builder.sitofp(builder.sub(shifted, ir.Constant(_WHOLE, [1023] * WIDTH)), _VECTOR8)

    return vector8(vector8), build


def _mantissa_of(context: Any, a: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        digits = builder.and_(builder.bitcast(given[0], _WHOLE), ir.Constant(_WHOLE, [0xFFFFFFFFFFFFF] * WIDTH))
        return builder.bitcast(builder.or_(digits, ir.Constant(_WHOLE, [0x3FF0000000000000] * WIDTH)), _VECTOR8)

    return vector8(vector8), build


def _two(operation: str) -> Any:
    def typed(context: Any, a: Any, b: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            return getattr(builder, operation)(*given)

        return a(a, a), build

    return typed


def _root(context: Any, a: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        name = "llvm.sqrt.v8f64"
        kind = ir.FunctionType(_VECTOR8, [_VECTOR8])
        return builder.call(builder.module.globals.get(name) or ir.Function(builder.module, kind, name), given)

    return vector8(vector8), build


def _reaches(context: Any, a: Any, b: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _one_where(builder, builder.fcmp_ordered(">=", *given))

    return vector8(vector8, vector8), build


def _sum(context: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        parts = [builder.extract_element(given[0], ir.Constant(ir.IntType(32), k)) for k in range(WIDTH)]
        while len(parts) > 1:
            half = len(parts) // 2
            parts = [builder.fadd(parts[k], parts[k + half]) for k in range(half)]
        return parts[0]

    return types.float64(vector8), build


def _sums(context: Any, array: Any, row: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        rows = [builder.add(given[1], ir.Constant(_I64, k)) for k in range(WIDTH)]
        zero = ir.Constant(_I64, 0)
        places = [_place(context, builder, signature.args[0], given[0], row, zero) for row in rows]
        parts = [builder.load(place, align=8) for place in places]
        for step in (1, 2, 4):  # entries, then pairs, then fours: sums of two rows go into one vector
            even = [
                k // (2 * step) * 2 * step + k % step + (WIDTH if k % (2 * step) >= step else 0) for k in range(WIDTH)
            ]
            first, second = (
                ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [k + more for k in even]) for more in (0, step)
            )
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [
                builder.fadd(builder.shuffle_vector(a, b, first), builder.shuffle_vector(a, b, second))
                for a, b in pairs
            ]
        return parts[0]

    return vector8(array, types.intp), build


load = _named("load", _load)
"""Entries [row, column] to [row, column + 7] of a matrix."""
store = _named("store", _store)
"""Write a vector there."""
fill = _named("fill", _fill)
"""A vector of one number, eight times."""
plus, minus, times, over = (
    _named(name, _two(operation))
    for name, operation in (("plus", "fadd"), ("minus", "fsub"), ("times", "fmul"), ("over", "fdiv"))
)
root = _named("root", _root)
"""Square roots of the entries."""
reaches = _named("reaches", _reaches)
"""1 where the first is at least the second, 0 elsewhere."""
equal, below = _named("equal", _compare("==")), _named("below", _compare("<"))
"""1 where entries [at] to [at + 7] of whole numbers are a value, or below it, 0 elsewhere."""
gathered = _named("gathered", _gather)
"""Entries [row, order[k]] to [row, order[k + 7]] of a matrix."""
pair, put_pair = _named("pair", _pair), _named("put_pair", _put_pair)
"""Pair ``at`` of an array whose last axis is 2, counted over its other axes; and write it there."""
two, entry = _named("two", _two_of), _named("entry", _one_of)
"""A pair of two numbers; and entry k of a pair."""
sum_of = _named("sum_of", _sum)
"""The sum of the eight entries, added in pairs."""
lower, higher = (_named(name, _pick(sign)) for name, sign in (("lower", "<"), ("higher", ">")))
"""The smaller, or the larger, of two entries; the second where one is not a number."""
only = _named("only", _only)
"""The first where the second is positive, 0 elsewhere."""
_power, _exponent, _mantissa = (_named(f.__name__, f) for f in (_power_of_two, _exponent_of, _mantissa_of))
row_sums = _named("row_sums", _sums)
"""Of the first eight entries of each of the rows row to row + 7: less than a third of the work of eight `sum_of`."""


@kernel
def _line(x: Any, first: int, c: Any) -> Any:
    return plus(fill(c[first]), times(fill(c[first + 1]), x))


@kernel
def _cubic(x: Any, x2: Any, first: int, c: Any) -> Any:
    return plus(_line(x, first, c), times(_line(x, first + 2, c), x2))


@kernel
def exp_of(x: Any) -> Any:
    """e^x of each entry, with the bits of `kernel.exp`."""
    x = lower(fill(709.0), higher(fill(-708.0), x))
    k = minus(plus(times(x, fill(1.0 / LOG2)), fill(ROUND)), fill(ROUND))
    r = minus(minus(x, times(k, fill(LOG2_HIGH))), times(k, fill(LOG2_LOW)))
    r2 = times(r, r)
    low = _cubic(r, r2, 4, EXP)
    high = plus(_cubic(r, r2, 8, EXP), times(_line(r, 12, EXP), times(r2, r2)))
    tail = plus(low, times(high, times(r2, r2)))
    total = plus(times(r2, _line(r, 2, EXP)), times(times(r2, r2), tail))
    return times(plus(fill(1.0), plus(r, total)), _power(k))


@kernel
def log_of(x: Any) -> Any:
    """Natural logarithms of positive normal entries, with the bits of `kernel.log`."""
    k, m = _exponent(x), _mantissa(x)
    up = minus(fill(1.0), reaches(fill(1.4142135623730951), m))
    m = minus(m, times(times(fill(0.5), up), m))
    k = plus(k, up)
    f = over(minus(m, fill(1.0)), plus(m, fill(1.0)))
    s = times(f, f)
    s2 = times(s, s)
    tail = plus(_cubic(s, s2, 4, ARTANH), times(_cubic(s, s2, 8, ARTANH), times(s2, s2)))
    total = plus(times(s2, _line(s, 2, ARTANH)), times(times(s2, s2), tail))
    total = plus(fill(1.0), plus(times(s, fill(ARTANH[1])), total))
    return plus(times(k, fill(LOG2_HIGH)), plus(times(times(fill(2.0), f), total), times(k, fill(LOG2_LOW))))

"""SIMD vectors of eight numbers, or two, for compiled routines that work on short rows.

A compiler that vectorises a loop of unknown length puts checks before it and a remainder after it, which cost more than
the loop where rows have a dozen entries. A loop over vectors has neither:

    for l in range(0, count, 8):
        store(a, i, l, minus(load(b, j, l), times(load(c, k, l), load(d, m, l))))

Rows must have room up to the next multiple of eight, and something finite there. Each operation is rounded by itself,
as those of single numbers. Indices count from the front and are not checked.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import Parameter, Signature
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
SAME = None
"""The type of an argument, or of the result, that is that of what is given, or of the first argument."""


def _operation(name: str, result: Any, kinds: tuple[Any, ...], build: Callable[..., Any]) -> Any:
    """An operation that Numba compiles under the same name in every process; ``build(builder, *given)`` writes it."""

    def typed(context: Any, *given: Any) -> Any:
        taken = [own if kind is SAME else kind for kind, own in zip(kinds, given, strict=True)]

        def write(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            opened = [
                context.make_array(kind)(context, builder, value) if isinstance(kind, types.Array) else value
                for kind, value in zip(taken, values, strict=True)
            ]
            made = build(builder, *opened)
            return context.get_dummy_value() if result is types.void else made

        return (taken[0] if result is SAME else result)(*taken), write

    positions = [Parameter(f"given{k}", Parameter.POSITIONAL_ONLY) for k in range(1 + len(kinds))]
    typed.__signature__ = Signature(positions)  # type: ignore[attr-defined]  # Numba wants one without a star
    return named_intrinsic(f"simd.{name}", typed)


def _place(builder: Any, array: Any, row: Any, column: Any) -> Any:
    """The address of the vector that begins at entry [row, column]."""
    columns = builder.extract_value(array.shape, 1)
    first = builder.gep(array.data, [builder.add(builder.mul(row, columns), column)])
    return builder.bitcast(first, _VECTOR8.as_pointer())


def _pair_place(builder: Any, array: Any, at: Any) -> Any:
    """The address of pair ``at`` of an array, counted over all its axes but the last."""
    return builder.bitcast(builder.gep(array.data, [builder.shl(at, _I64(1))]), _VECTOR2.as_pointer())


def _load(builder: Any, place: Any) -> Any:
    return builder.load(place, align=8)


def _wholes(builder: Any, array: Any, at: Any) -> Any:
    """Entries [at] to [at + 7] of whole numbers."""
    return _load(builder, builder.bitcast(builder.gep(array.data, [at]), _WHOLE.as_pointer()))


def _two_of(builder: Any, first: Any, second: Any) -> Any:
    made = builder.insert_element(ir.Constant(_VECTOR2, ir.Undefined), first, _I32(0))
    return builder.insert_element(made, second, _I32(1))


def _all(kind: Any, number: Any) -> Any:
    """The constant vector of one number."""
    return ir.Constant(kind, [number] * kind.count)


def _spread(builder: Any, value: Any, kind: Any) -> Any:
    """A vector with one number in all places."""
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, _I32(0))
    return builder.shuffle_vector(one, one, _all(ir.VectorType(_I32, kind.count), 0))


def _called(builder: Any, name: str, kinds: list[Any], *given: Any) -> Any:
    """What an instruction of LLVM with a name makes of vectors."""
    kind = ir.FunctionType(_VECTOR8, kinds)
    return builder.call(builder.module.globals.get(name) or ir.Function(builder.module, kind, name), given)


def _gather(builder: Any, array: Any, row: Any, order: Any, k: Any) -> Any:
    start = _spread(builder, builder.ptrtoint(_place(builder, array, row, _I64(0)), _I64), _WHOLE)
    bytes_ = builder.shl(_wholes(builder, order, k), _all(_WHOLE, 3))
    kind, mask = ir.VectorType(ir.DoubleType().as_pointer(), WIDTH), _all(ir.VectorType(ir.IntType(1), WIDTH), 1)
    places, none = builder.inttoptr(builder.add(start, bytes_), kind), ir.Constant(_VECTOR8, ir.Undefined)
    kinds = [kind, _I32, mask.type, _VECTOR8]
    return _called(builder, "llvm.masked.gather.v8f64.v8p0", kinds, places, _I32(8), mask, none)


def _one_where(builder: Any, true: Any) -> Any:
    return builder.select(true, _all(_VECTOR8, 1.0), _all(_VECTOR8, 0.0))


def _compare(sign: str) -> Callable[..., Any]:
    def build(builder: Any, array: Any, at: Any, value: Any) -> Any:
        given = _wholes(builder, array, at), _spread(builder, value, _WHOLE)
        return _one_where(builder, builder.icmp_signed(sign, *given))

    return build


def _pick(sign: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.select(builder.fcmp_ordered(sign, a, b), a, b)


def _only(builder: Any, a: Any, b: Any) -> Any:
    zero = _all(a.type, 0.0)
    return builder.select(builder.fcmp_ordered(">", b, zero), a, zero)


def _power_of_two(builder: Any, a: Any) -> Any:
    whole = builder.add(builder.fptosi(a, _WHOLE), _all(_WHOLE, 1023))
    return builder.bitcast(builder.shl(whole, _all(_WHOLE, 52)), _VECTOR8)


def _exponent_of(builder: Any, a: Any) -> Any:
    shifted = builder.ashr(builder.bitcast(a, _WHOLE), _all(_WHOLE, 52))
    return builder.sitofp(builder.sub(shifted, _all(_WHOLE, 1023)), _VECTOR8)


def _mantissa_of(builder: Any, a: Any) -> Any:
    digits = builder.and_(builder.bitcast(a, _WHOLE), _all(_WHOLE, 0xFFFFFFFFFFFFF))
    return builder.bitcast(builder.or_(digits, _all(_WHOLE, 0x3FF0000000000000)), _VECTOR8)


def _sum(builder: Any, value: Any) -> Any:
    parts = [builder.extract_element(value, _I32(k)) for k in range(WIDTH)]
    while len(parts) > 1:
        half = len(parts) // 2
        parts = [builder.fadd(parts[k], parts[k + half]) for k in range(half)]
    return parts[0]


def _sums(builder: Any, array: Any, row: Any) -> Any:
    rows = [builder.add(row, _I64(k)) for k in range(WIDTH)]
    parts = [_load(builder, _place(builder, array, one, _I64(0))) for one in rows]
    for step in (1, 2, 4):  # entries, then pairs, then fours: sums of two rows go into one vector
        even = [k // (2 * step) * 2 * step + k % step + (WIDTH if k % (2 * step) >= step else 0) for k in range(WIDTH)]
        first, second = (ir.Constant(ir.VectorType(_I32, WIDTH), [k + more for k in even]) for more in (0, step))
        pairs = zip(parts[::2], parts[1::2], strict=True)
        parts = [
            builder.fadd(builder.shuffle_vector(a, b, first), builder.shuffle_vector(a, b, second)) for a, b in pairs
        ]
    return parts[0]


PLACE, ONE, TWO = (SAME, types.intp, types.intp), (vector8,), (SAME, SAME)
load = _operation("load", vector8, PLACE, lambda builder, *at: _load(builder, _place(builder, *at)))
"""Entries [row, column] to [row, column + 7] of a matrix."""
store = _operation(
    "store", types.void, (*PLACE, vector8), lambda builder, *at: builder.store(at[3], _place(builder, *at[:3]), align=8)
)
"""Write a vector there."""
fill = _operation("fill", vector8, (types.float64,), lambda builder, value: _spread(builder, value, _VECTOR8))
"""A vector of one number, eight times."""
plus = _operation("plus", SAME, TWO, lambda builder, a, b: builder.fadd(a, b))
minus = _operation("minus", SAME, TWO, lambda builder, a, b: builder.fsub(a, b))
times = _operation("times", SAME, TWO, lambda builder, a, b: builder.fmul(a, b))
over = _operation("over", SAME, TWO, lambda builder, a, b: builder.fdiv(a, b))
root = _operation("root", vector8, ONE, lambda builder, a: _called(builder, "llvm.sqrt.v8f64", [_VECTOR8], a))
"""Square roots of the entries."""
reaches = _operation(
    "reaches", vector8, (vector8, vector8), lambda builder, a, b: _one_where(builder, builder.fcmp_ordered(">=", a, b))
)
"""1 where the first is at least the second, 0 elsewhere."""
equal, below = (_operation(name, vector8, PLACE, _compare(sign)) for name, sign in (("equal", "=="), ("below", "<")))
"""1 where entries [at] to [at + 7] of whole numbers are a value, or below it, 0 elsewhere."""
gathered = _operation("gathered", vector8, (SAME, types.intp, SAME, types.intp), _gather)
"""Entries [row, order[k]] to [row, order[k + 7]] of a matrix."""
pair = _operation("pair", vector2, (SAME, types.intp), lambda builder, *at: _load(builder, _pair_place(builder, *at)))
"""Pair ``at`` of an array whose last axis is 2, counted over its other axes."""
put_pair = _operation(
    "put_pair", types.void, (SAME, types.intp, vector2),
    lambda builder, array, at, value: builder.store(value, _pair_place(builder, array, at), align=8),
)  # fmt: skip
"""Write it there."""
two = _operation("two", vector2, (types.float64, types.float64), _two_of)
"""A pair of two numbers."""
entry = _operation(
    "entry", types.float64, (SAME, types.intp), lambda builder, a, k: builder.extract_element(a, builder.trunc(k, _I32))
)
"""Entry k of a pair."""
sum_of = _operation("sum_of", types.float64, ONE, _sum)
"""The sum of the eight entries, added in pairs."""
lower, higher = (_operation(name, SAME, TWO, _pick(sign)) for name, sign in (("lower", "<"), ("higher", ">")))
"""The smaller, or the larger, of two entries; the second where one is not a number."""
only = _operation("only", SAME, TWO, _only)
"""The first where the second is positive, 0 elsewhere."""
_power, _exponent, _mantissa = (
    _operation(f.__name__, vector8, ONE, f) for f in (_power_of_two, _exponent_of, _mantissa_of)
)
row_sums = _operation("row_sums", vector8, (SAME, types.intp), _sums)
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

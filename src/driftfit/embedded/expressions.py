"""Expressions of steps in C: names, numbers, array elements, arithmetic, and calls."""

from __future__ import annotations

import ast
import builtins
import math
import operator
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from driftfit.embedded.values import (
    RANK,
    TranslationError,
    Unit,
    Value,
    assigned,
    begin_of,
    joined,
    lifted,
    narrow,
    number,
    plain,
    strides_of,
    view,
)
from driftfit.engine import kernel
from driftfit.engine.tracker_part import tracker_part, whole_record

ARITHMETIC = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "/", ast.Mod: "%"}
BITS = {ast.BitAnd: "&", ast.BitOr: "|"}
PYTHON = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow, ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_, ast.BitXor: operator.xor, ast.LShift: operator.lshift, ast.RShift: operator.rshift,
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq,
    ast.NotEq: operator.ne, ast.Is: operator.is_, ast.IsNot: operator.is_not,
}  # fmt: skip
"""What is folded where both values are known."""
COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


class Expressions:
    """The part of the translator that turns expressions into values; statements build on it."""

    stored: Counter[str]
    ops: list[Counter[str]]
    locals: dict[str, Value]

    def __init__(self, unit: Unit, source: Any) -> None:
        self.unit, self.source = unit, source
        names, cells = source.__code__.co_freevars, source.__closure__ or ()
        self.closure = {name: cell.cell_contents for name, cell in zip(names, cells, strict=True)}
        self.lazy = 0

    @contextmanager
    def lazily(self) -> Iterator[None]:
        """In this context an expression may not be moved before its statement, since it may not be evaluated at all."""
        self.lazy += 1
        yield
        self.lazy -= 1

    def refuse(self, node: ast.AST) -> Any:
        raise TranslationError(f"{self.source.__qualname__}: no translation of `{ast.unparse(node)}`.")

    def value(self, node: ast.expr, statement: bool = False) -> Value:
        if isinstance(node, ast.Call):
            return self.call(node, statement)
        handler = getattr(self, f"of_{type(node).__name__.lower()}", None)
        made: Value = handler(node) if handler else self.refuse(node)
        return made

    def of_constant(self, node: ast.Constant) -> Value:
        return number(node.value) if isinstance(node.value, bool | int | float) else self.refuse(node)

    def of_name(self, node: ast.Name) -> Value:
        if node.id in self.locals:
            return self.locals[node.id]
        for names in (self.closure, self.source.__globals__, vars(builtins)):
            if node.id in names:
                return lifted(names[node.id])
        return self.refuse(node)  # type: ignore[no-any-return]

    def of_tuple(self, node: ast.Tuple) -> Value:
        return Value("items", constant=[self.value(one) for one in node.elts])

    def of_attribute(self, node: ast.Attribute) -> Value:
        if node.attr == "data" and isinstance(node.value, ast.Attribute) and node.value.attr == "ctypes":
            return Value("address", begin_of(self.value(node.value.value)))
        if node.attr == "shape":
            return Value("items", constant=[number(size) for size in self.owner(node.value)[0].shape])
        owner = self.value(node.value)
        if owner.kind == "record":
            for one in (self.unit.written, self.unit.beyond):  # perhaps, by whoever receives the array
                one.add(node.attr)
            return self.unit.field(node.attr)
        if owner.kind == "table" and hasattr(owner.constant, node.attr):  # a named tuple
            return lifted(getattr(owner.constant, node.attr))
        if owner.kind == "python" and owner.constant in (np, math):
            return lifted(getattr(owner.constant, node.attr))
        return self.refuse(node)  # type: ignore[no-any-return]

    def owner(self, node: ast.expr) -> tuple[Value, str]:
        """The owner of a subscript or of ``.shape``, and the name of the field if it is one."""
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            record = self.value(node.value)
            if record.kind == "record":
                return self.unit.field(node.attr), node.attr
        return self.value(node), ""

    def of_subscript(self, node: ast.Subscript) -> Value:
        owner, name = self.owner(node.value)
        parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if owner.kind == "tile":
            return Value("record")
        if owner.kind == "items":
            item: Value = owner.constant[int(self.value(parts[-1]).constant)]
            return item
        if owner.kind == "table":
            return self._entry(owner, [self.value(one) for one in parts])
        if owner.kind != "array":
            return self.refuse(node)  # type: ignore[no-any-return]
        parts += [ast.Slice()] * (len(owner.shape) - len(parts))
        self.ops[-1]["load"] += 1
        index = [
            self._part(one, size) if isinstance(one, ast.Slice) else self.value(one)
            for one, size in zip(parts, owner.shape, strict=True)
        ]
        if not name:
            return view(owner, index)
        part = any(isinstance(one, range) for one in index)
        if isinstance(node.ctx, ast.Store) or part:
            self.unit.written.add(name)
        if part:
            self.unit.beyond.add(name)
        start = None if part else self.unit.start_of(name)
        return view(owner, index) if start is None else number(start)

    def _part(self, node: ast.Slice, size: int) -> range:
        """The part of an axis that a slice selects."""
        bounds = (node.lower, node.upper)
        ends = [None if one is None else self.value(one).constant for one in bounds]
        unknown = any(one is not None and end is None for one, end in zip(bounds, ends, strict=True))
        if node.step is not None or unknown:
            self.refuse(node)
        return range(size)[slice(*ends)]

    def _entry(self, table: Value, index: list[Value]) -> Value:
        """An entry of a table; a constant if its index is known."""
        if all(one.known for one in index):
            inner = table.constant
            for one in index:
                inner = inner[one.constant]
            return lifted(inner)
        name, kind = self.unit.table(table.constant)
        strides = strides_of(np.shape(table.constant))
        at = " + ".join(f"({one.text} * {stride})" for one, stride in zip(index, strides, strict=True))
        most = int(np.max(table.constant)) if kind == "int" else None
        return Value(kind, f"{name}[{at}]", most=most)

    # arithmetic

    def of_unaryop(self, node: ast.UnaryOp) -> Value:
        value = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            return number(not value.constant) if value.known else Value("bool", f"(!{value.text})")
        if isinstance(node.op, ast.USub):
            value = plain(value)
            return number(-value.constant) if value.known else Value(value.kind, f"(-{value.text})")
        return self.refuse(node)  # type: ignore[no-any-return]

    def of_binop(self, node: ast.BinOp) -> Value:
        return self.binary(node.op, self.value(node.left), self.value(node.right))

    def binary(self, operation: ast.operator, one: Value, other: Value) -> Value:
        """One operation on two numbers."""
        one, other = plain(one), plain(other)
        kind = joined(one.kind, other.kind) if {one.kind, other.kind} <= {*RANK} else one.kind
        if one.known and other.known and kind in RANK:
            return number(_folded(operation, one.constant, other.constant))
        if one.kind == "address":  # in bytes
            moved = str(other.constant // 8) if other.known else f"{other.text} / 8"
            return one if other.constant == 0 else Value("address", f"({one.text} + {moved})")
        if isinstance(operation, ast.Pow):
            if other.constant != 2:
                raise TranslationError(f"{self.source.__name__}: powers other than squares have no translation.")
            self.ops[-1]["multiply"] += 1
            return Value(one.kind, f"real_square({one.text})" if one.kind == "real" else f"({one.text} * {one.text})")
        if isinstance(operation, ast.LShift):
            return Value("long", f"((int64_t)((uint64_t){one.text} << {other.text}))")
        if isinstance(operation, ast.RShift):
            return Value("long", f"({one.text} >> {other.text})")
        if type(operation) in BITS and kind == "bool" and (one.known or other.known):
            fixed, rest = (one, other) if one.known else (other, one)
            return rest if fixed.constant == isinstance(operation, ast.BitAnd) else fixed
        if type(operation) in BITS:
            return Value(kind, f"({one.text} {BITS[type(operation)]} {other.text})")
        sign = ARITHMETIC[type(operation)]
        if kind == "real" and sign in "*/" and 1.0 in (other.constant, one.constant if sign == "*" else None):
            kept = other if one.constant == 1.0 and sign == "*" else one  # a factor of one changes no bit
            return kept if kept.kind == "real" else Value("real", _real(kept))
        if kind != "real":
            kind = "real" if isinstance(operation, ast.Div) else joined(kind, "int")
            if isinstance(operation, ast.Div):
                return Value("real", f"((real){one.text} / (real){other.text})")
            return Value(kind, f"({one.text} {sign} {other.text})", most=_most(sign, one, other))
        self.ops[-1][{"+": "add", "-": "add", "*": "multiply", "/": "divide"}[sign]] += 1
        return Value("real", f"({_real(one)} {sign} {_real(other)})")

    def of_compare(self, node: ast.Compare) -> Value:
        values = [self.value(one) for one in (node.left, *node.comparators)]
        if len(values) == 2 and values[0].kind == "flag" and values[1].known:
            return _of_flag(values[0], [PYTHON[type(node.ops[0])](one, values[1].constant) for one in (0.0, 1.0)])
        pairs = [(type(kind), *pair) for kind, pair in zip(node.ops, pairwise(values), strict=True)]
        if all(one.known for one in values):
            return number(all(PYTHON[kind](one.constant, other.constant) for kind, one, other in pairs))
        tests = [f"{one.text} {COMPARISONS[kind]} {other.text}" for kind, one, other in pairs]
        self.ops[-1]["compare"] += len(tests)
        text = f"({tests[0]})" if len(tests) == 1 else "(" + " && ".join(f"({test})" for test in tests) + ")"
        return Value("bool", text)

    def of_boolop(self, node: ast.BoolOp) -> Value:
        both = isinstance(node.op, ast.And)
        values = [self.value(node.values[0])]
        with self.lazily():
            values += [self.value(one) for one in node.values[1:]]
        if any(one.known and bool(one.constant) != both for one in values):
            return number(not both)
        open_ones = [one for one in values if not one.known]
        if not open_ones:
            return number(both)
        return Value("bool", "(" + (" && " if both else " || ").join(one.text for one in open_ones) + ")")

    def of_ifexp(self, node: ast.IfExp) -> Value:
        test = self.value(node.test)
        if test.known:
            return self.value(node.body if test.constant else node.orelse)
        with self.lazily():
            one, other = self.value(node.body), self.value(node.orelse)
        kind = joined(narrow(one), narrow(other))
        if kind == "flag" and one.known and other.known and one.constant != other.constant:
            return replace(_of_flag(test, [bool(other.constant), bool(one.constant)]), kind="flag")
        return Value(kind, f"({test.text} ? {assigned(one, kind)} : {assigned(other, kind)})")

    # calls

    def called(self, source: Any, arguments: list[Value], statement: bool) -> Value:
        raise NotImplementedError

    def call(self, node: ast.Call, statement: bool) -> Value:
        """A call of another step, or of one of the functions that every step may use."""
        if isinstance(node.func, ast.Attribute) and node.func.attr == "view":
            inner, to = self.value(node.func.value), self.value(node.args[0]).constant
            text, kind = ("from_bits", "real") if to is np.float64 else ("bits_of", "long")
            return Value(kind, f"{text}({inner.text})")
        function = self.value(node.func).constant
        arguments = [plain(self.value(one)) for one in node.args]
        if function in (tracker_part, whole_record):
            return arguments[0]  # in C there is one record
        if function is kernel.packed or (function is kernel.wholes and arguments[0].kind == "items"):
            return arguments[0]  # C passes addresses one by one
        if function in (kernel.floats, kernel.wholes, kernel.cubes):
            # only the first extent may be unknown
            extents = [self.unit.largest if one.constant is None else int(one.constant) for one in arguments[1:]]
            return Value("array", arguments[0].text, shape=tuple(extents), strides=strides_of(tuple(extents)))
        if hasattr(function, "py_func"):
            before = self.ops[-1].copy()
            made = self.called(function.py_func, arguments, statement)
            if self.unit.ordinary and function.short and not isinstance(function, kernel.Machine):
                self.ops[-1] = before  # it seldom runs
            return made
        return self._builtin(node, function, arguments)

    def _builtin(self, node: ast.Call, function: Any, arguments: list[Value]) -> Value:
        if function in (min, max):
            made = arguments[0]
            for one in arguments[1:]:
                made = self._extreme(function, made, one)
            return made
        (one,) = arguments
        if function is len:
            return number(len(one.constant) if one.kind == "table" else one.shape[0])
        if one.known and one.kind in RANK:
            return number(function(one.constant))
        if function is abs:
            self.ops[-1]["add"] += 1
            return Value(one.kind, f"{'R_ABS' if one.kind == 'real' else 'whole_abs'}({one.text})")
        if function in (np.sqrt, math.sqrt):
            self.ops[-1]["square root"] += 1
            return Value("real", f"R_SQRT({one.text})")
        if function in (np.cos, np.sin, np.ceil):
            self.ops[-1]["compare" if function is np.ceil else "sine"] += 1
            return Value("real", f"R({function.__name__}({one.text}))")
        if function in (np.int64, int):
            return Value("long", f"((int64_t){one.text})")
        if function in (np.float64, float):
            return Value("real", f"((real){one.text})")
        if function is bool:
            return Value("bool", f"({one.text} != 0)")
        return self.refuse(node)  # type: ignore[no-any-return]

    def _extreme(self, function: Any, one: Value, other: Value) -> Value:
        """Python's rule: return the second only if it is beyond the first, which decides NaN and signed zeros."""
        if one.known and other.known:
            return number(function(one.constant, other.constant))
        kind = joined(one.kind, other.kind)
        bounds = [value.most for value in (one, other)]
        known = [bound for bound in bounds if bound is not None]
        most = min(known) if function is min and known else max(known) if len(known) == 2 else None
        self.ops[-1]["compare"] += 1
        prefix = "real_" if kind == "real" else "whole_"
        return Value(kind, f"{prefix}{function.__name__}imum({one.text}, {other.text})", most=most)


def _real(value: Value) -> str:
    return value.text if value.kind == "real" or value.known else f"(real){value.text}"


def _most(sign: str, one: Value, other: Value) -> int | None:
    """An upper bound of a sum or product of nonnegative integers."""
    if one.most is None:
        return None
    if sign == "-":
        return one.most - int(other.constant) if other.known else one.most
    if sign == "/":
        return one.most // int(other.constant) if other.known else one.most
    if other.most is None:
        return None
    return one.most + other.most if sign == "+" else one.most * other.most if sign == "*" else None


def _folded(operation: ast.operator, one: Any, other: Any) -> Any:
    if isinstance(one, float) or isinstance(operation, ast.Div):  # dividing by zero is no error in a step
        one, other = np.float64(one), np.float64(other)
    with np.errstate(all="ignore"):
        return PYTHON[type(operation)](one, other)


def _of_flag(flag: Value, truths: list[bool]) -> Value:
    """The truth value that is the first where a flag is 0, and the second where it is 1."""
    if truths[0] == truths[1]:
        return number(truths[0])
    return Value("bool", flag.text if truths[1] else f"(!{flag.text})")

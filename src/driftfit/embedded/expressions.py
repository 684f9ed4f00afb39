"""Expressions of steps in C: names, numbers, array elements and arithmetic."""

from __future__ import annotations

import ast
import builtins
import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from driftfit.embedded.unit import TranslationError, Unit
from driftfit.embedded.values import RANK, Value, assigned, begin_of, joined, lifted, narrow, number, plain, view

ARITHMETIC = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "/", ast.Mod: "%"}
BITS = {ast.BitAnd: "&", ast.BitOr: "|"}
COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


class Expressions:
    """The part of the translator that turns expressions into values; calls and statements build on it."""

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

    def call(self, node: ast.Call, statement: bool) -> Value:
        raise NotImplementedError

    def refuse(self, node: ast.AST) -> Any:
        raise TranslationError(f"{self.source.__qualname__}: no translation of `{ast.unparse(node)}`.")

    def value(self, node: ast.expr, statement: bool = False) -> Value:
        """Translate an expression."""
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
            array = self.value(node.value.value)
            return Value("address", begin_of(array))
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
            return Value("record", "s")
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
        if isinstance(node.ctx, ast.Store) or any(isinstance(one, range) for one in index):
            self.unit.written.add(name)
        if any(isinstance(one, range) for one in index):
            self.unit.beyond.add(name)
        start = self.unit.start_of(name)
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
        strides = [int(np.prod(np.shape(table.constant)[axis + 1 :])) for axis in range(len(index))]
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
        one = self.value(node.left)
        return self.binary(node.op, one, self.value(node.right))

    def binary(self, operator: ast.operator, one: Value, other: Value) -> Value:
        """One operation on two numbers."""
        one, other = plain(one), plain(other)
        kind = joined(one.kind, other.kind) if {one.kind, other.kind} <= RANK.keys() else one.kind
        if one.known and other.known and kind in RANK:
            return number(_folded(operator, one.constant, other.constant))
        if one.kind == "address":  # in bytes
            moved = str(other.constant // 8) if other.known else f"{other.text} / 8"
            return one if other.constant == 0 else Value("address", f"({one.text} + {moved})")
        if isinstance(operator, ast.Pow):
            return self._square(one, other)
        if isinstance(operator, ast.LShift | ast.RShift):
            return _shifted(operator, one, other)
        if type(operator) in BITS and kind == "bool" and (one.known or other.known):
            fixed, rest = (one, other) if one.known else (other, one)
            return rest if fixed.constant == isinstance(operator, ast.BitAnd) else fixed
        if type(operator) in BITS:
            return Value(kind, f"({one.text} {BITS[type(operator)]} {other.text})")
        sign = ARITHMETIC[type(operator)]
        if kind == "real" and sign in "*/" and 1.0 in (other.constant, one.constant if sign == "*" else None):
            kept = other if one.constant == 1.0 and sign == "*" else one  # a factor of one changes no bit
            return kept if kept.kind == "real" else Value("real", _real(kept))
        if kind != "real":
            kind = "real" if isinstance(operator, ast.Div) else joined(kind, "int")
            if isinstance(operator, ast.Div):
                return Value("real", f"((real){one.text} / (real){other.text})")
            return Value(kind, f"({one.text} {sign} {other.text})", most=_most(sign, one, other))
        self.ops[-1][{"+": "add", "-": "add", "*": "multiply", "/": "divide"}[sign]] += 1
        return Value("real", f"({_real(one)} {sign} {_real(other)})")

    def _square(self, one: Value, other: Value) -> Value:
        if other.constant != 2:
            raise TranslationError(f"{self.source.__name__}: powers other than squares have no translation.")
        self.ops[-1]["multiply"] += 1
        return Value(one.kind, f"real_square({one.text})" if one.kind == "real" else f"({one.text} * {one.text})")

    def of_compare(self, node: ast.Compare) -> Value:
        values = [self.value(one) for one in (node.left, *node.comparators)]
        if len(values) == 2 and values[0].kind == "flag" and values[1].known:
            return _of_flag(values[0], [_compared(node.ops[0], one, values[1].constant) for one in (0.0, 1.0)])
        if all(one.known for one in values):
            truths = [
                _compared(operator, one.constant, other.constant)
                for operator, one, other in zip(node.ops, values, values[1:], strict=False)
            ]
            return number(all(truths))
        tests = [
            f"{one.text} {COMPARISONS[type(operator)]} {other.text}"
            for operator, one, other in zip(node.ops, values, values[1:], strict=False)
        ]
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


def _shifted(operator: ast.operator, one: Value, other: Value) -> Value:
    if isinstance(operator, ast.LShift):
        return Value("long", f"((int64_t)((uint64_t){one.text} << {other.text}))")
    return Value("long", f"({one.text} >> {other.text})")


def _folded(operator: ast.operator, one: Any, other: Any) -> Any:
    node = ast.fix_missing_locations(
        ast.Expression(ast.BinOp(ast.Name("a", ast.Load()), operator, ast.Name("b", ast.Load())))
    )
    if isinstance(one, float) or isinstance(operator, ast.Div):  # dividing by zero is no error in a step
        one, other = np.float64(one), np.float64(other)
    with np.errstate(all="ignore"):
        return eval(compile(node, "constant", "eval"), {"a": one, "b": other})


def _of_flag(flag: Value, truths: list[bool]) -> Value:
    """The truth value that is the first where a flag is 0, and the second where it is 1."""
    if truths[0] == truths[1]:
        return number(truths[0])
    return Value("bool", flag.text if truths[1] else f"(!{flag.text})")


def _compared(operator: ast.cmpop, one: Any, other: Any) -> bool:
    node = ast.Expression(ast.Compare(ast.Name("a", ast.Load()), [operator], [ast.Name("b", ast.Load())]))
    return bool(eval(compile(ast.fix_missing_locations(node), "constant", "eval"), {"a": one, "b": other}))

"""Plain Python functions as formulas: `Equation` and `StateSpace` take them in the place of text.

    def flow(u, theta):
        drop = max(u.p1 - u.p2, 0.0)
        return theta.k * np.sqrt(drop) - theta.c

    Equation(flow)      is      Equation("flow = theta.k * sqrt(max(p1 - p2, 0.0)) - theta.c")

The source of the function is read, and never run. Assignments are put where their names are used, ``if`` becomes ``A if
CONDITION else B``, loops over ``range`` of known length are unrolled, and other plain functions that it calls are read
too; numbers that it finds outside are taken as they are then. What remains is a formula, so that such a model has exact
derivatives by dual numbers, is compiled, saved, sent and exported as any other.

Arguments are known by their names: theta, u (inputs), y (past outputs), x (states before; in the output, those of the
sample), dt, and t, the time since the first sample in nominal samples. Their parts are ``theta.k``, ``theta["k"]`` or
``k, c = theta``, and ``u.p1[-2]`` is p1 two samples before. An argument that is used itself, as ``u`` or ``u[-1]``,
is a signal of that name; ``x[0]`` is the state x0.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

DEPTH = 10
"""Functions within functions, at most."""
TURNS = 1000
"""Turns of a loop, at most."""
CLOCK = "clock"
"""The name of t in a formula."""
ARGUMENTS = ("x", "u", "theta", "y", "t", "dt")

NAMED: dict[Any, str] = {
    abs: "abs", np.abs: "abs", np.fabs: "abs", math.fabs: "abs", max: "max", min: "min", np.maximum: "max",
    np.minimum: "min", **{getattr(one, name): name for one in (np, math) for name in
                          ("cos", "exp", "log", "sin", "sqrt", "tanh")},
}  # fmt: skip
"""Functions that formulas have."""

BY_FORMULA: dict[Any, str] = {
    np.square: "lambda x: x * x", np.tan: "lambda x: sin(x) / cos(x)", math.tan: "lambda x: sin(x) / cos(x)",
    np.log10: "lambda x: log(x) / 2.302585092994046", math.log10: "lambda x: log(x) / 2.302585092994046",
    np.sinh: "lambda x: 0.5 * (exp(x) - exp(-x))", math.sinh: "lambda x: 0.5 * (exp(x) - exp(-x))",
    np.cosh: "lambda x: 0.5 * (exp(x) + exp(-x))", math.cosh: "lambda x: 0.5 * (exp(x) + exp(-x))",
    np.hypot: "lambda x, y: sqrt(x * x + y * y)", math.hypot: "lambda x, y: sqrt(x * x + y * y)",
    np.power: "lambda x, p: x ** p", math.pow: "lambda x, p: x ** p", pow: "lambda x, p: x ** p",
    np.clip: "lambda x, low, high: min(max(x, low), high)", float: "lambda x: x",
}  # fmt: skip
"""Functions that are written with those."""


FUNCTIONS = {name: one for one, name in NAMED.items()}


class _Set(NamedTuple):
    """An assignment of a loop."""

    target: ast.expr
    value: Any


class _Argument:
    """An argument of the function: its parts by name or number."""

    def __init__(self, role: str, name: str) -> None:
        self.role, self.name = role, name

    def part(self, name: str) -> ast.expr:
        """A parameter, a state, or an input."""
        if self.role == "theta":
            return ast.Attribute(ast.Name("theta"), name)
        return _lagged(name, 1) if self.role == "before" else ast.Name(name)

    @property
    def whole(self) -> ast.expr:
        """The signal that the argument itself is."""
        if self.role in ("theta", "y"):
            example = f"{self.name}[-1]" if self.role == "y" else f"{self.name}.k"
            raise _refused(f"{self.name} itself is no number; use its parts, as {example}")
        return self.part(CLOCK if self.name == "t" else self.name)


def _lagged(name: str, lag: int) -> ast.expr:
    return ast.Subscript(ast.Name(name), ast.UnaryOp(ast.USub(), ast.Constant(lag)))


def _refused(what: str) -> ValueError:
    return ValueError(f"function: {what}.")


def equation_text(function: Callable[..., Any]) -> str:
    """``output = expression`` of a function that returns the output; its name is that of the output."""
    return f"{_name(function)} = {_written(_value(function, 'now', _name(function)))}"


def system_text(functions: Sequence[Callable[..., Any]]) -> str:
    """The lines of a system from a function that returns the states by name, and one that returns the output."""
    if len(functions) != 2:
        raise _refused(f"give two, [states, output]; got {len(functions)}")
    states, output = functions
    found = _value(states, "before", _name(output))
    if not isinstance(found, dict):
        raise _refused(f"{_name(states)} must return the states by name, as {{'x': x.x + dt * u}}")
    return "\n".join([*(f"{name} = {_written(value)}" for name, value in found.items()), equation_text(output)])


def _name(function: Callable[..., Any]) -> str:
    name = getattr(function, "__name__", "")
    if not name.isidentifier():
        raise _refused(f"{function!r} has no name of its own; write it with def")
    return name


def _written(value: Any) -> str:
    return ast.unparse(ast.fix_missing_locations(_number(value)))


def _number(value: Any) -> ast.expr:
    """A value as an expression."""
    if isinstance(value, _Argument):
        return value.whole
    if isinstance(value, ast.expr):
        return value
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise _refused(f"{value!r} is no number")
    return ast.Constant(value if isinstance(value, int) else float(value))


def _value(function: Callable[..., Any], states: str, output: str) -> Any:
    """What a function returns, for arguments that are known by their names."""
    names = list(inspect.signature(function).parameters)
    if unknown := [name for name in names if name not in ARGUMENTS]:
        raise _refused(f"{_name(function)} takes {', '.join(unknown)}; arguments are {', '.join(ARGUMENTS)}")
    roles = {"x": states, "theta": "theta", "y": "y"}
    given = {name: _Argument(roles.get(name, "now"), output if name == "y" else name) for name in names}
    return _Reader(function).result(given)


class _Reader:
    """Reads the source of one function."""

    def __init__(self, function: Any, depth: int = 0) -> None:
        self.function, self.depth = getattr(function, "py_func", function), depth
        if depth > DEPTH or not isinstance(self.function, FunctionType):
            raise _refused(f"{function!r} cannot be read; call functions of numpy, of math, or plain ones")
        try:
            source = textwrap.dedent(inspect.getsource(self.function))
            tree = ast.parse(source).body[0]
        except (OSError, SyntaxError, IndentationError) as error:
            raise _refused(f"the source of {_name(self.function)} was not found: {error}") from None
        if not isinstance(tree, ast.FunctionDef):
            raise _refused("a lambda cannot be read; write it with def")
        self.body = tree.body
        found = inspect.getclosurevars(self.function)
        self.outside = {**vars(builtins), **found.globals, **found.nonlocals}

    def result(self, given: Mapping[str, Any]) -> Any:
        found = self.run(self.body, dict(given))
        if found is None:
            raise _refused(f"{self.function.__name__} has a branch that returns nothing")
        return found

    def run(self, body: Sequence[Any], names: dict[str, Any]) -> Any:
        """What is returned from these statements; None if nothing is."""
        for i, one in enumerate(body):
            match one:
                case ast.Return(value=ast.expr() as value):
                    return self.of(value, names)
                case ast.Expr(value=ast.Constant()) | ast.Pass():
                    continue
                case ast.Assign(targets=[target], value=value):
                    self.assign(target, self.of(value, names), names)
                case ast.AnnAssign(target=target, value=ast.expr() as value):
                    self.assign(target, self.of(value, names), names)
                case ast.AugAssign(target=ast.Name(id=name), op=op, value=value):
                    names[name] = ast.BinOp(_number(names[name]), op, _number(self.of(value, names)))
                case ast.If(test=test, body=first, orelse=second):
                    rest = body[i + 1 :]
                    taken = [self.run([*part, *rest], dict(names)) for part in (first, second)]
                    if taken[0] is None or taken[1] is None:
                        return None
                    return self.chosen(test, taken[0], taken[1], names)
                case ast.For(target=target, body=inner, orelse=[]):
                    turns = self.of(one.iter, names)
                    if not isinstance(turns, tuple) or len(turns) > TURNS:
                        raise _refused(f"'for {ast.unparse(target)} in {ast.unparse(one.iter)}' has no known length")
                    unrolled: list[Any] = [part for turn in turns for part in (_Set(target, turn), *inner)]
                    return self.run([*unrolled, *body[i + 1 :]], names)
                case _Set():
                    self.assign(one.target, one.value, names)
                case _:
                    raise _refused(f"'{ast.unparse(one).splitlines()[0]}' is not understood")
        return None

    def assign(self, target: ast.expr, value: Any, names: dict[str, Any]) -> None:
        match target:
            case ast.Name(id=name):
                names[name] = value
            case ast.Tuple(elts=parts) | ast.List(elts=parts) if all(isinstance(part, ast.Name) for part in parts):
                called = [part.id for part in parts]  # type: ignore[attr-defined]
                if isinstance(value, _Argument):
                    names.update({name: value.part(name) for name in called})
                elif isinstance(value, tuple) and len(value) == len(called):
                    names.update(zip(called, value, strict=True))
                else:
                    raise _refused(f"'{ast.unparse(target)}' cannot be unpacked")
            case _:
                raise _refused(f"'{ast.unparse(target)} = ..' is not understood")

    def of(self, node: ast.expr, names: Mapping[str, Any]) -> Any:
        """A value: an expression, an argument, a number, a tuple or a mapping of these."""
        match node:
            case ast.Constant(value=value):
                return value
            case ast.Name(id=name):
                return self.found(name, names)
            case ast.Attribute(value=inner, attr=name):
                owner = self.of(inner, names)
                return owner.part(name) if isinstance(owner, _Argument) else _member(owner, name)
            case ast.Subscript(value=inner, slice=index):
                return _entry(self.of(inner, names), self.of(index, names))
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=inner):
                value = self.of(inner, names)
                if isinstance(value, int | float):
                    return -value if isinstance(node.op, ast.USub) else value
                return ast.UnaryOp(node.op, _number(value))
            case ast.BinOp(left=left, op=op, right=right):
                return _combined(self.of(left, names), op, self.of(right, names))
            case ast.IfExp(test=test, body=first, orelse=second):
                return self.chosen(test, self.of(first, names), self.of(second, names), names)
            case ast.Tuple(elts=parts) | ast.List(elts=parts):
                return tuple(self.of(part, names) for part in parts)
            case ast.Dict(keys=keys, values=values) if all(isinstance(key, ast.Constant) for key in keys):
                of_keys = [ast.literal_eval(key) for key in keys if key is not None]
                return {key: self.of(one, names) for key, one in zip(of_keys, values, strict=True)}
            case ast.Call():
                return self.call(node, names)
        raise _refused(f"'{ast.unparse(node)}' is not understood")

    def found(self, name: str, names: Mapping[str, Any]) -> Any:
        if name in names:
            return names[name]
        if name in self.outside:
            return self.outside[name]
        raise _refused(f"{name} is not known where {self.function.__name__} uses it")

    def call(self, node: ast.Call, names: Mapping[str, Any]) -> Any:
        function = self.of(node.func, names)
        if function is np.where and len(node.args) == 3:
            return self.chosen(node.args[0], self.of(node.args[1], names), self.of(node.args[2], names), names)
        given = [self.of(one, names) for one in node.args]
        by_name = {one.arg: self.of(one.value, names) for one in node.keywords if one.arg}
        if function is dict and not given:
            return by_name
        if function is range and all(isinstance(one, int) for one in given):
            return tuple(range(*given))
        try:
            name, formula = NAMED.get(function), BY_FORMULA.get(function)
        except TypeError:
            name = formula = None
        if name is not None and given and not by_name:
            found = _number(given[0])
            for other in given[1:]:
                found = ast.Call(ast.Name(name), [found, _number(other)], [])
            return found if len(given) > 1 else ast.Call(ast.Name(name), [found], [])
        if formula is not None and not by_name:
            return self.substituted(formula, given, node)
        reader = _Reader(function, self.depth + 1)
        bound = inspect.signature(reader.function).bind(*given, **by_name)
        bound.apply_defaults()
        return reader.result(bound.arguments)

    def substituted(self, formula: str, given: Sequence[Any], node: ast.Call) -> Any:
        """A function that is written with others."""
        made = ast.parse(formula, mode="eval").body
        assert isinstance(made, ast.Lambda)
        called = [one.arg for one in made.args.args]
        if len(called) != len(given):
            raise _refused(f"'{ast.unparse(node)}' must have {len(called)} arguments")
        return self.of(made.body, {**FUNCTIONS, **dict(zip(called, given, strict=True))})

    def chosen(self, test: ast.expr, one: Any, other: Any, names: Mapping[str, Any]) -> Any:
        """``one`` where the test holds."""
        match test:
            case ast.BoolOp(op=op, values=[first, *rest]):
                more = ast.BoolOp(op, rest) if len(rest) > 1 else rest[0]
                if isinstance(op, ast.And):
                    return self.chosen(first, self.chosen(more, one, other, names), other, names)
                return self.chosen(first, one, self.chosen(more, one, other, names), names)
            case ast.UnaryOp(op=ast.Not(), operand=inner):
                return self.chosen(inner, other, one, names)
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                sides = [_number(self.of(side, names)) for side in (left, right)]
                return _selected(ast.Compare(sides[0], [op], [sides[1]]), one, other)
            case ast.Compare(left=left, ops=[op, *ops], comparators=[right, *others]):
                pair = ast.Compare(left, [op], [right])
                return self.chosen(ast.BoolOp(ast.And(), [pair, ast.Compare(right, ops, others)]), one, other, names)
        raise _refused(f"'{ast.unparse(test)}' is no comparison")


def _member(owner: Any, name: str) -> Any:
    if not isinstance(owner, ModuleType) or not hasattr(owner, name):
        raise _refused(f"'.{name}' of {owner!r} is not understood")
    return getattr(owner, name)


def _entry(value: Any, index: Any) -> Any:
    """A part of an argument by name or number, a lag of a signal, or an entry of a tuple or mapping."""
    if isinstance(value, tuple | dict):
        return value[index]
    lag = isinstance(index, int) and index < 0
    if isinstance(value, _Argument) and value.role == "y" and lag:
        return _lagged(value.name, -index)
    if isinstance(value, _Argument) and not lag:
        return value.part(index if isinstance(index, str) else f"{value.name}{index}")
    signal = value.whole if isinstance(value, _Argument) else value
    if isinstance(signal, ast.Name) and lag:
        return _lagged(signal.id, -index)
    raise _refused(f"an index {index!r} is not understood")


def _combined(left: Any, op: ast.operator, right: Any) -> Any:
    """An operation; of two numbers, its result."""
    if isinstance(left, int | float) and isinstance(right, int | float):
        expression = ast.Expression(ast.BinOp(ast.Constant(left), op, ast.Constant(right)))
        return eval(compile(ast.fix_missing_locations(expression), "<constant>", "eval"), {})
    return ast.BinOp(_number(left), op, _number(right))


def _selected(test: ast.Compare, one: Any, other: Any) -> Any:
    """``one`` where a comparison holds; of tuples and mappings entry by entry."""
    if isinstance(test.left, ast.Constant) and isinstance(test.comparators[0], ast.Constant):
        expression = ast.fix_missing_locations(ast.Expression(test))
        return one if eval(compile(expression, "<constant>", "eval"), {}) else other
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return {key: _selected(test, one[key], other[key]) for key in one}
    if isinstance(one, tuple) and isinstance(other, tuple) and len(one) == len(other):
        return tuple(_selected(test, a, b) for a, b in zip(one, other, strict=True))
    return ast.IfExp(test, _number(one), _number(other))

"""Formulas as text: their parts, and code for the value and its derivatives, compiled or for NumPy.

The text is read as a syntax tree, of which only arithmetic, comparisons, a conditional expression, names, lags and the
functions of `FUNCTIONS` are accepted. The tree is translated into code with one operation per line, each followed by
its derivatives with respect to the parameters on which it depends (forward differentiation).
"""

from __future__ import annotations

import ast
import linecache
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import State, exp, kernel, log
from driftfit.engine.settings import numbers

FORMULA_LENGTH = 20000
"""Characters of a formula."""
LAG_LIMIT = 10_000
"""Samples: so many of each signal are a part of the state."""
FUNCTIONS = {
    "abs": 1, "cos": 1, "exp": 1, "log": 1, "max": 2, "min": 2, "sin": 1, "sqrt": 1, "tanh": 1,
}  # fmt: skip
"""Functions by name, with the number of their arguments."""
OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


@dataclass(frozen=True)
class Formula:
    """The parts of ``output = expression``."""

    text: str
    output: str
    tree: ast.expr = field(compare=False)
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    lags: tuple[tuple[str, int], ...]
    """Signals with their lags, in samples."""

    @property
    def reach(self) -> int:
        """The longest lag."""
        return max((lag for _, lag in self.lags), default=0)

    def lags_of(self, signal: str) -> tuple[int, ...]:
        """The lags of a signal that the expression uses."""
        return tuple(lag for name, lag in self.lags if name == signal)


@lru_cache(maxsize=256)
def parse(text: str, known: bool = False) -> Formula:
    """The parts of a formula; ValueError names the part that is not understood.

    A formula without parameters is an error unless it may be ``known``.
    """
    if not isinstance(text, str) or len(text) > FORMULA_LENGTH:
        raise ValueError(
            f"Equation: give a text of at most {FORMULA_LENGTH} characters, as 'y = theta.k * sqrt(u) - theta.c'."
        )
    left, equals, right = text.partition("=")
    output = left.strip()
    try:
        tree = ast.parse(right.strip(), mode="eval").body if equals else None
    except (SyntaxError, RecursionError, MemoryError):
        tree = None
    if tree is None or not output.isidentifier() or output in (*FUNCTIONS, "theta", "pi"):
        raise ValueError(f"Equation: {text!r} is not an equation such as 'y = theta.k * sqrt(p1 - p2) - theta.c'.")
    parameters: dict[str, None] = {}
    lags: dict[tuple[str, int], None] = {}
    try:
        _check(tree, parameters, lags)
    except RecursionError:
        raise ValueError("Equation: the formula has too many operations within each other; shorten it.") from None
    if (output, 0) in lags:
        raise ValueError(f"Equation: {output} on the right must have a lag, as {output}[-1].")
    if not parameters and not known:
        raise ValueError(f"Equation: {text!r} has no parameter; write the unknown numbers as theta.NAME.")
    inputs = dict.fromkeys(name for name, _ in lags if name != output)
    return Formula(text, output, tree, tuple(parameters), tuple(inputs), tuple(lags))


def _check(node: ast.expr, parameters: dict[str, None], lags: dict[tuple[str, int], None]) -> None:
    """Collect parameters and lags; ValueError for anything that is not allowed."""
    match node:
        case ast.Constant(value=int() | float() as size) if type(size) is not bool and size < LARGEST:
            return
        case ast.Attribute(value=ast.Name(id="theta")):
            parameters[node.attr] = None
            return
        case ast.Name() if node.id not in (*FUNCTIONS, "theta"):
            if node.id != "pi":
                lags[node.id, 0] = None
            return
        case ast.Subscript(
            value=ast.Name(id=name), slice=ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int(lag)))
        ) if type(lag) is not bool and lag <= LAG_LIMIT:
            lags[name, lag] = None
            return
        case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
            within = [node.operand]
        case ast.BinOp() if type(node.op) in OPERATORS:
            within = [node.left, node.right]
        case ast.IfExp():
            within = [node.test, node.body, node.orelse]
        case ast.Compare() if len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS:
            within = [node.left, *node.comparators]
        case ast.Call(func=ast.Name(id=name), keywords=[]) if FUNCTIONS.get(name) == len(node.args):
            within = list(node.args)
        case _:
            raise ValueError(
                f"Equation: {ast.unparse(node)!r} is not understood. Use theta.NAME for parameters, NAME and NAME[-1] "
                f"for signals, back to [-{LAG_LIMIT}], numbers below {LARGEST:g}, + - * / **, comparisons, "
                f"'A if B else C', pi and {', '.join(FUNCTIONS)}."
            )
    for one in within:
        _check(one, parameters, lags)


class Writer:
    """Lines of code for a tree, and the names of their results: value, and derivatives by parameter."""

    def __init__(self, formula: Formula, inputs: tuple[str, ...], differentiates: bool = True) -> None:
        self.formula, self.inputs, self.differentiates = formula, inputs, differentiates
        self.parameters = formula.parameters
        self.lines: list[str] = []

    def let(self, code: str) -> str:
        name = f"x{len(self.lines)}"
        self.lines.append(f"{name} = {code}")
        return name

    def write(self, node: ast.expr) -> tuple[str, dict[int, str]]:
        match node:
            case ast.Constant():
                return repr(float(node.value)), {}  # type: ignore[arg-type]
            case ast.Attribute():
                i = self.parameters.index(node.attr)
                return self.let(f"s.point[{i}, l]"), {i: "1.0"} if self.differentiates else {}
            case ast.Name():
                return (repr(float(np.pi)), {}) if node.id == "pi" else self.signal(node.id, 0)
            case ast.Subscript(value=ast.Name(id=name), slice=ast.UnaryOp(operand=ast.Constant(value=int(lag)))):
                return self.signal(name, lag)
            case ast.UnaryOp():
                x, dx = self.write(node.operand)
                return (self._scaled("-1.0", x, dx)) if isinstance(node.op, ast.USub) else (x, dx)
            case ast.BinOp():
                return self._binary(node)
            case ast.IfExp():
                test, _ = self.write(node.test)
                return self._chosen(test, self.write(node.body), self.write(node.orelse))
            case ast.Compare():
                (a, _), (b, _) = self.write(node.left), self.write(node.comparators[0])
                return self.let(f"{a} {COMPARISONS[type(node.ops[0])]} {b}"), {}
            case ast.Call():
                return self._call(node.func.id, [self.write(one) for one in node.args])  # type: ignore[attr-defined]
        raise AssertionError(node)

    def signal(self, name: str, lag: int) -> tuple[str, dict[int, str]]:
        if name == self.formula.output:
            return self.let(f"s.y_lag[0, {lag}, l]"), {}
        return self.let(f"s.u_lag[{self.inputs.index(name)}, {lag}, l]"), {}

    def _scaled(self, factor: str, x: str, dx: dict[int, str]) -> tuple[str, dict[int, str]]:
        return self.let(f"{factor} * {x}"), {i: self.let(f"{factor} * {d}") for i, d in dx.items()}

    def _chosen(self, test: str, one: Any, other: Any) -> tuple[str, dict[int, str]]:
        """``one`` where the test holds."""
        (a, da), (b, db) = one, other
        both = sorted({*da, *db})
        value = self.let(f"chosen({test}, {a}, {b})")
        return value, {i: self.let(f"chosen({test}, {da.get(i, '0.0')}, {db.get(i, '0.0')})") for i in both}

    def _sum(self, *terms: tuple[str, dict[int, str]]) -> dict[int, str]:
        """The derivatives sum_k factor_k d_k of a function with these partial derivatives."""
        found: dict[int, list[str]] = {}
        for factor, dx in terms:
            for i, d in dx.items():
                found.setdefault(i, []).append(f"{factor} * {d}")
        return {i: self.let(" + ".join(parts)) for i, parts in sorted(found.items())}

    def _binary(self, node: ast.BinOp) -> tuple[str, dict[int, str]]:
        (a, da), (b, db) = self.write(node.left), self.write(node.right)
        match node.op:
            case ast.Add():
                return self.let(f"{a} + {b}"), self._sum(("1.0", da), ("1.0", db))
            case ast.Sub():
                return self.let(f"{a} - {b}"), self._sum(("1.0", da), ("-1.0", db))
            case ast.Mult():
                return self.let(f"{a} * {b}"), self._sum((b, da), (a, db))
            case ast.Div():
                value = self.let(f"{a} / {b}")
                return value, self._sum((f"(1.0 / {b})", da), (f"(-{value} / {b})", db))
        return self._power(node, (a, da), (b, db))

    def _power(self, node: ast.BinOp, base: Any, power: Any) -> tuple[str, dict[int, str]]:
        (a, da), (b, db) = base, power
        try:
            p = ast.literal_eval(node.right)
        except ValueError:
            p = None
        if isinstance(p, int) and abs(p) <= 32:  # exact, also for negative bases
            value = self.let(_product(a, abs(p)) if p >= 0 else f"1.0 / ({_product(a, -p)})")
            less = _product(a, p - 1) if p >= 1 else f"(1.0 / ({_product(a, 1 - p)}))"
            return value, self._sum((f"{float(p)!r} * ({less})", da))
        logarithm = self.let(f"chosen({a} > 0.0, log({a}), np.nan)")
        value = self.let(f"exp({b} * {logarithm})")
        return value, self._sum((f"({b} * {value} / {a})", da), (f"({value} * {logarithm})", db))

    def _call(self, name: str, given: list[Any]) -> tuple[str, dict[int, str]]:
        (a, da) = given[0]
        match name:
            case "max" | "min":
                return self._chosen(self.let(f"{a} {'>' if name == 'max' else '<'} {given[1][0]}"), *given)
            case "abs":
                return self.let(f"abs({a})"), self._sum((f"chosen({a} >= 0.0, 1.0, -1.0)", da))
            case "sqrt":
                value = self.let(f"np.sqrt({a})")
                return value, self._sum((f"(0.5 / {value})", da))
            case "exp":
                value = self.let(f"exp({a})")
                return value, self._sum((value, da))
            case "log":
                return self.let(f"chosen({a} > 0.0, log({a}), np.nan)"), self._sum((f"(1.0 / {a})", da))
            case "tanh":
                value = self.let(f"1.0 - 2.0 / (exp(2.0 * {a}) + 1.0)")
                return value, self._sum((f"(1.0 - {value} * {value})", da))
        value = self.let(f"np.{name}({a})")
        return value, self._sum((f"np.cos({a})" if name == "sin" else f"(-np.sin({a}))", da))


def _product(x: str, times: int) -> str:
    return " * ".join([x] * times) if times else "1.0"


def start_values(model: str, given: Any, names: Sequence[str]) -> Any:
    """``start`` of a model of equations: one number for all, or (name, number) pairs from a mapping or such pairs.

    Raises
    ------
    ValueError
        If it names something that the equations do not have, or holds something that is not a number.
    """
    pairs = isinstance(given, Sequence) and all(isinstance(one, Sequence) and len(one) == 2 for one in given)
    if isinstance(given, str) or not (pairs or isinstance(given, Mapping)):
        return numbers(model, "start", given, ndim=0)
    found = dict(given)
    if unknown := sorted(set(found) - set(names)):
        raise ValueError(f"{model}: start names {', '.join(unknown)}; there are {', '.join(names)}.")
    return tuple((name, numbers(model, "start", value, ndim=0)) for name, value in found.items())


def complete_with(known: Any, lines: Sequence[Formula], inputs: tuple[str, ...], output: str) -> Any:
    """``complete(s, l)``: whether the lags of the output and the inputs that the lines use are known; tanh, min or a
    condition has a value without them. ``known(s, j, lag, l)`` says it of an input.
    """
    lags = {pair for line in lines for pair in line.lags}
    used = sorted((inputs.index(name), lag) for name, lag in lags if name in inputs)
    own = tuple(sorted(lag for name, lag in lags if name == output))
    of_input, with_lag, at = tuple(j for j, _ in used) or (0,), tuple(lag for _, lag in used) or (0,), own or (0,)
    count, owned = len(used), len(own)

    @kernel
    def complete(s: State, l: int) -> bool:
        found = True
        for k in range(count):
            found = found & known(s, of_input[k], with_lag[k], l)
        for k in range(owned):
            found = found & (abs(s.y_lag[0, at[k], l]) < LARGEST)
        return found

    return complete


@lru_cache(maxsize=256)
def compiled(text: str, inputs: tuple[str, ...]) -> Callable[..., Any]:
    """The kernel that writes s.value and s.phi at s.point, from s.y_lag and s.u_lag (a row for each input)."""
    formula = parse(text)
    writer = Writer(formula, inputs)
    value, derivatives = writer.write(formula.tree)
    lines = [*writer.lines, f"s.value[l] = {value}"]
    lines += [f"s.phi[{i}, l] = {derivatives.get(i, '0.0')}" for i in range(len(formula.parameters))]
    return written("evaluate", lines)


@kernel
def chosen(test: bool, one: float, other: float) -> float:
    """``one`` where the test holds."""
    return one if test else other


COMPILED = {"exp": exp, "log": log, "chosen": chosen}
IN_NUMPY = {"exp": np.exp, "log": np.log, "chosen": np.where}


def written(name: str, lines: Sequence[str]) -> Callable[..., Any]:
    """The kernel ``name(s, l)`` of these lines, which hold nothing but arithmetic.

    Its source is known to `inspect`, from which exported trackers are translated.
    """
    made: Callable[..., Any] = kernel(_made(name, lines, COMPILED))
    return made


@lru_cache(maxsize=256)
def in_numpy(text: str, inputs: tuple[str, ...]) -> Callable[..., Any]:
    """``value(s, l)`` for a whole array of lanes l; NaN where a signal is."""
    formula = parse(text)
    writer = Writer(formula, inputs, differentiates=False)
    value, _ = writer.write(formula.tree)
    signals = " + ".join(["0.0", *(writer.signal(*one)[0] for one in formula.lags)])
    lines = [*writer.lines, f"return chosen(np.isnan({signals}), np.nan, {value})"]
    made: Callable[..., Any] = _made("value", lines, IN_NUMPY)
    return made


def _made(name: str, lines: Sequence[str], known: Mapping[str, Any]) -> Any:
    code = f"def {name}(s, l):\n" + "\n".join(f"    {line}" for line in lines) + "\n"
    place = f"<{name} {sha256(code.encode()).hexdigest()[:16]}>"
    linecache.cache[place] = len(code), None, code.splitlines(True), place
    names: dict[str, Any] = {"np": np, "__name__": __name__, **known}
    exec(compile(code, place, "exec"), names)
    return names[name]

"""Translate steps to C: the Python source of a compiled function, and of all that it calls, for the shapes of a record.

The translator walks the syntax tree of each function with the kinds of its arguments (`driftfit.embedded.values`).
Known integers, tables and functions become constants of the text, branches that a constant excludes are left out, and a
function is written once for each set of shapes with which it is called. A step may use everything that
`driftfit.engine.kernel` allows, so a new tracker needs nothing here. Floating-point expressions keep their order, so
the double-precision build gives the same bits as the compiled steps if the C compiler neither contracts nor reorders
them.

The number of operations is counted along the way: loops at their longest, and the more expensive of two branches.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import textwrap
from collections import Counter
from typing import Any

from driftfit.embedded.expressions import Expressions
from driftfit.embedded.values import (
    RANK,
    TYPES,
    Function,
    TranslationError,
    Unit,
    Value,
    assigned,
    bare,
    begin_of,
    comment,
    identifier,
    joined,
    lifted,
    narrow,
    plain,
    renamed,
)


class Statements(Expressions):
    """The part of the translator that turns statements into lines."""

    given: dict[str, Value]
    kinds: dict[str, str]
    returns: tuple[str, ...]
    lines: list[str]
    temporaries: int

    def line(self, text: str) -> None:
        self.lines.append(f"{'    ' * len(self.ops)}{text}")

    def block(self, body: list[ast.stmt]) -> bool:
        """Translate statements; returns whether statements after them are unreachable."""
        for statement in body:
            handler = getattr(self, f"on_{type(statement).__name__.lower()}", None)
            if handler is None:
                raise TranslationError(f"{self.source.__name__}: no translation of {type(statement).__name__}.")
            if handler(statement):
                return True
        return False

    def nested(self, body: list[ast.stmt]) -> tuple[Counter[str], bool]:
        """A nested block; returns its operations, and whether it always returns."""
        self.ops.append(Counter())
        ended = self.block(body)
        return self.ops.pop(), ended

    def on_expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call):
            value = self.value(node.value, statement=True)
            if value.text:
                self.line(f"{value.text};")

    def on_pass(self, node: ast.Pass) -> None:
        """Nothing."""

    def on_break(self, node: ast.Break | ast.Continue) -> bool:
        self.line(f"{ast.unparse(node)};")
        return True

    on_continue = on_break

    def on_annassign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.assign(node.target, self.value(node.value))

    def on_assign(self, node: ast.Assign) -> None:
        value = self.value(node.value)
        for target in node.targets:
            self.assign(target, value)

    def assign(self, target: ast.expr, value: Value) -> None:
        if isinstance(target, ast.Tuple):
            items = value.constant if value.kind == "items" else [lifted(one) for one in value.constant]
            several = len(items) > 1 and not all(one.known for one in items)
            parts = [self.held(one) if several else one for one in items]
            for one, part in zip(target.elts, parts, strict=True):
                self.assign(one, part)
        elif isinstance(target, ast.Name):
            self.assign_name(target.id, value)
        else:
            self.store(target, value)

    def store(self, target: ast.expr, value: Value) -> None:
        """Assign a number to an element of an array."""
        place = self.value(target)
        if place.kind == "flag" and narrow(value) not in ("bool", "flag"):
            assert isinstance(target, ast.Subscript)
            self.unit.beyond.add(self.owner(target.value)[1])
        self.line(f"{place.text} = {assigned(value, place.kind)};")
        self.ops[-1]["store"] += 1

    def held(self, value: Value) -> Value:
        """Store a value in a separate variable, so that a later assignment does not change it."""
        if value.known or value.kind not in RANK:
            return value
        name = self.temporary(value.kind)
        self.line(f"{name} = {value.text};")
        return Value(value.kind, name, most=value.most)

    def assign_name(self, name: str, value: Value) -> None:
        fixed = self.stored[name] == 1 and name not in self.given
        if value.kind not in RANK or (fixed and value.known):
            self.locals[name] = value
            return
        self.kinds[name] = joined(narrow(value), self.kinds.get(name, "bool"))
        most = value.most if fixed else None
        whole = value.known and self.kinds[name] != "real"
        self.locals[name] = value if whole else Value(self.kinds[name], identifier(name), most=most)
        if value.text != identifier(name):
            self.line(f"{identifier(name)} = {assigned(value, self.kinds[name])};")

    def forget(self, node: ast.stmt) -> None:
        """The values of variables that a statement with branches or turns may have changed are not known after it."""
        for name in {one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)}:
            if name in self.kinds and name in self.locals and self.locals[name].known:
                self.locals[name] = Value(self.kinds[name], identifier(name))

    def on_augassign(self, node: ast.AugAssign) -> None:
        target = self.value(node.target)
        self.assign(node.target, self.binary(node.op, target, self.value(node.value)))

    def on_if(self, node: ast.If) -> bool:
        test = self.value(node.test)
        if test.known:
            return self.block(node.body if test.constant else node.orelse)
        self.line(f"if ({bare(test.text)}) {{")
        one, ended = self.nested(node.body)
        self.forget(node)
        other, other_ended = Counter[str](), False
        if node.orelse:
            self.line("} else {")
            other, other_ended = self.nested(node.orelse)
            self.forget(node)
        self.line("}")
        self.ops[-1] += one if one.total() >= other.total() else other
        return ended and other_ended

    def on_for(self, node: ast.For) -> None:
        if not (isinstance(node.iter, ast.Call) and isinstance(node.target, ast.Name)):
            raise TranslationError(f"{self.source.__name__}: loops run over range() only.")
        bounds = [self.value(one) for one in node.iter.args]
        start, stop = (lifted(0), bounds[0]) if len(bounds) == 1 else (bounds[0], bounds[1])
        step = int(bounds[2].constant) if len(bounds) == 3 else 1
        fixed = range(start.constant, stop.constant, step) if start.known and stop.known else None
        left = any(isinstance(one, ast.Break | ast.Continue) for one in ast.walk(node))
        if fixed is not None and len(fixed) <= (0 if left else 1):
            for turn in fixed:
                self.locals[node.target.id] = lifted(turn)
                self.block(node.body)
            return
        name = identifier(node.target.id)
        high, low = (stop, start) if step > 0 else (start, stop)
        top = high.most if high.most is not None else self.unit.largest  # the largest extent, if it is not known
        turns = max(0, top - (low.constant if low.known else 0))
        turns = -(-turns // abs(step))
        sign = "<" if step > 0 else ">"
        move = f"{name}++" if step == 1 else f"{name}--" if step == -1 else f"{name} += {step}"
        bound = f"(int)({stop.text})" if stop.kind == "long" else stop.text
        self.forget(node)
        self.locals[node.target.id] = Value("int", name, most=top - 1 if step > 0 else top)
        self.line(f"for (int {name} = {start.text}; {name} {sign} {bound}; {move}) {{")
        ops, _ = self.nested(node.body)
        self.forget(node)
        self.line("}")
        self.ops[-1] += Counter({kind: count * turns for kind, count in ops.items()})

    def on_while(self, node: ast.While) -> None:
        self.forget(node)
        with self.lazily():
            test = self.value(node.test)
        self.line(f"while ({bare(test.text)}) {{")
        ops, _ = self.nested(node.body)
        self.forget(node)
        self.line("}")
        turns = self.unit.largest
        self.ops[-1] += Counter({kind: count * turns for kind, count in ops.items()})

    def on_return(self, node: ast.Return) -> bool:
        if node.value is None:
            self.line("return;")
            return True
        value = self.value(node.value)
        items = [plain(one) for one in (value.constant if value.kind == "items" else [value])]
        kinds = tuple(one.kind for one in items)
        self.returns = tuple(map(joined, kinds, self.returns)) if self.returns else kinds
        if len(items) == 1:
            self.line(f"return {bare(items[0].text)};")
        else:
            for i, one in enumerate(items):
                self.line(f"*out{i} = {one.text};")
            self.line("return;")
        return True

    def temporary(self, kind: str) -> str:
        self.temporaries += 1
        name = f"t{self.temporaries}"
        self.kinds[name] = joined(kind, self.kinds.get(name, "bool"))
        return name


def translate(unit: Unit, source: Any, arguments: list[Value]) -> Function:
    """The C function of a Python function for these arguments; it is translated on the first call."""
    captured = tuple(id(cell.cell_contents) for cell in source.__closure__ or ())
    key = (source.__code__, captured, tuple(one.key() for one in arguments))
    if key not in unit.functions:
        unit.names[source.__name__] += 1
        count = unit.names[source.__name__]
        name = identifier(f"{source.__name__.lstrip('_')}{'' if count == 1 else f'_{count}'}")
        unit.functions[key] = Body(unit, source, arguments).function(f"{name}_" if hasattr(math, name) else name)
    return unit.functions[key]


class Body(Statements):
    """One function during its translation."""

    def __init__(self, unit: Unit, source: Any, arguments: list[Value]) -> None:
        tree = ast.parse(textwrap.dedent(inspect.getsource(source))).body[0]
        if not isinstance(tree, ast.FunctionDef):
            raise TranslationError(f"{source.__name__} is not a function of its own.")
        super().__init__(unit, source)
        self.tree = tree
        self.parameters: list[str] = []
        self.kinds: dict[str, str] = {}
        self.returns: tuple[str, ...] = ()
        stores = (node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
        self.stored = Counter(stores)
        self.given = self._parameters(arguments)

    def _parameters(self, arguments: list[Value]) -> dict[str, Value]:
        """The arguments by name; those with known values do not appear in the signature."""
        named = {}
        for argument, one in zip(self.tree.args.args, arguments, strict=True):
            name = identifier(argument.arg)
            if one.kind in ("record", "tile"):
                state = ["tracker_state *s", "scratch_fields *scratch"]
                self.parameters += [text for text in state if text not in self.parameters]  # that of a gate is the same
                named[argument.arg] = one
            elif one.kind in ("array", "address"):  # an address is one of real numbers
                constant = "const " if one.kind == "array" and one.text == "u" else ""
                self.parameters.append(f"{constant}{TYPES[one.element]} *{name}")
                named[argument.arg] = renamed(one, name)
            elif one.kind == "items":
                own = [renamed(item, f"{name}{k}") for k, item in enumerate(one.constant)]
                self.parameters += [f"real *{item.text}" for item in own]
                named[argument.arg] = Value("items", constant=own)
            elif one.known and one.kind != "real":
                named[argument.arg] = one
            elif one.kind in RANK:
                self.parameters.append(f"{TYPES[one.kind]} {name}")
                named[argument.arg] = Value(one.kind, name, most=one.most)
                if argument.arg in self.stored:  # a parameter that is modified
                    self.kinds[argument.arg] = one.kind
            else:
                raise TranslationError(f"{self.source.__name__}: an argument of kind {one.kind}.")
        return named

    def function(self, name: str) -> Function:
        """Translate repeatedly until the kinds of variables and of the returned value are stable."""
        while True:
            before = dict(self.kinds), self.returns
            self.locals, self.ops, self.temporaries = dict(self.given), [Counter()], 0
            self.lines: list[str] = []
            self.block(self.tree.body)
            if before == (self.kinds, self.returns):
                return self._written(name)

    def _written(self, name: str) -> Function:
        outs = [f"{TYPES[kind]} *out{i}" for i, kind in enumerate(self.returns)] if len(self.returns) > 1 else []
        result = TYPES[self.returns[0]] if len(self.returns) == 1 else "void"
        signature = f"static {result} {name}({', '.join([*self.parameters, *outs]) or 'void'})"
        taken = {parameter.split("*")[-1].split()[-1] for parameter in self.parameters}
        own = {identifier(one): kind for one, kind in self.kinds.items() if identifier(one) not in taken}
        for one in [one for one in own if not self._reads(one)]:  # constants went to the places that would read it
            self.lines = [line for line in self.lines if not re.fullmatch(rf"\s*{one} = -?\d+;", line)]
            if not any(re.search(rf"\b{one}\b", line) for line in self.lines):
                del own[one]
        declared = [f"    {TYPES[kind]} {one};" for one, kind in own.items()]
        unread = [f"    (void){one};" for one in [*sorted(taken), *own] if not self._reads(one)]
        summary = (ast.get_docstring(self.tree) or "").split("\n")[0]
        about = [f"/* {comment(summary)} */"] if summary else []
        text = "\n".join([*about, f"{signature} {{", *declared, *unread, *self.lines, "}"])
        if ".view(" in ast.unparse(self.tree):
            text = self._of_doubles(name, text)
        return Function(name, self.returns, text, self.ops[0])

    def _of_doubles(self, name: str, text: str) -> str:
        """A function that works on the bits of doubles; single precision uses that of the C library, for speed."""
        if self.source.__name__ not in ("exp", "log"):
            raise TranslationError(f"{self.source.__qualname__}: only exp and log may work on the bits of numbers.")
        text = re.sub(r"\breal\b", "double", re.sub(r"\bR\(", "(", text))
        short = f"static real {name}(real x) {{ return {self.source.__name__}f(x); }}"
        return f"#ifdef TRACKER_SINGLE\n{short}\n#else\n{text}\n#endif"

    def _reads(self, name: str) -> bool:
        """Whether a variable is used anywhere except on the left of an assignment."""
        return any(re.search(rf"\b{name}\b", re.sub(rf"^\s*{name} = ", "", line)) for line in self.lines)

    def called(self, source: Any, arguments: list[Value], statement: bool) -> Value:
        """A call; its result is stored in a variable before the statement that uses it."""
        function = translate(self.unit, source, arguments)
        self.ops[-1] += function.operations
        passed = [text for one in arguments if (text := as_argument(one))]
        passed = [text for k, text in enumerate(passed) if text != RECORD or k == passed.index(RECORD)]
        if len(function.returns) > 1:
            names = [self.temporary(kind) for kind in function.returns]
            self.line(f"{function.name}({', '.join([*passed, *(f'&{name}' for name in names)])});")
            pairs = zip(function.returns, names, strict=True)
            return Value("items", constant=[Value(kind, name) for kind, name in pairs])
        text = f"{function.name}({', '.join(passed)})"
        if not function.returns:
            return Value("nothing", text)
        if self.lazy or statement:
            return Value(function.returns[0], text)
        return self.held(Value(function.returns[0], text))


RECORD = "s, scratch"


def as_argument(value: Value) -> str:
    """The expression passed for an argument; nothing if its value is known."""
    if value.kind in ("record", "tile"):
        return RECORD
    if value.kind in ("array", "address"):
        return begin_of(value)
    if value.kind == "items":
        return ", ".join(begin_of(item) for item in value.constant)
    return "" if value.known and value.kind != "real" else value.text

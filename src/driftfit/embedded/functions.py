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

from driftfit.embedded.names import comment, identifier
from driftfit.embedded.statements import Statements
from driftfit.embedded.unit import TYPES, Function, TranslationError, Unit
from driftfit.embedded.values import RANK, Value, begin_of, renamed


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
                self.parameters.append("tracker_state *s")
                named[argument.arg] = Value("record", "s") if one.kind == "record" else one
            elif one.kind == "array":
                constant = "const " if one.text == "u" else ""
                self.parameters.append(f"{constant}{TYPES[one.element]} *{name}")
                named[argument.arg] = renamed(one, name)
            elif one.kind == "address":
                self.parameters.append(f"real *{name}")
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
        passed = [text for one in arguments if (text := _passed(one))]
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


def _passed(value: Value) -> str:
    """The expression passed for an argument; nothing if its value is known."""
    if value.kind in ("record", "tile"):
        return "s"
    if value.kind in ("array", "address"):
        return begin_of(value)
    if value.kind == "items":
        return ", ".join(begin_of(item) for item in value.constant)
    return "" if value.known and value.kind != "real" else value.text

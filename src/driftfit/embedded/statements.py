"""Statements of steps in C: assignments, branches, loops and returns."""

from __future__ import annotations

import ast
from collections import Counter

from driftfit.embedded.expressions import Expressions
from driftfit.embedded.values import (
    RANK,
    TranslationError,
    Value,
    assigned,
    bare,
    identifier,
    joined,
    lifted,
    narrow,
    plain,
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

    def on_break(self, node: ast.Break) -> bool:
        self.line("break;")
        return True

    def on_continue(self, node: ast.Continue) -> bool:
        self.line("continue;")
        return True

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
        top = self.largest(high)
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

    def largest(self, value: Value) -> int:
        """Upper bound of a loop, or the largest extent of the record if it is not known."""
        return value.most if value.most is not None else self.unit.largest

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

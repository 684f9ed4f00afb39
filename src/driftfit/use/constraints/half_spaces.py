"""Constraints as text: "b1 >= 0", "0 <= a1 + a2 <= 1", "b1 + b2 == 1"; each is low <= g' theta <= high."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array


class HalfSpace(NamedTuple):
    """low <= g' theta <= high; equal limits are a plane."""

    text: str
    g: Array
    low: float
    high: float


class _Linear(NamedTuple):
    """g' theta + c."""

    g: Array
    c: float

    def scaled(self, factor: float) -> _Linear:
        return _Linear(self.g * factor, self.c * factor)

    def plus(self, other: _Linear) -> _Linear:
        return _Linear(self.g + other.g, self.c + other.c)

    @property
    def constant(self) -> bool:
        return not self.g.any()


def half_space(text: str, names: Sequence[str]) -> HalfSpace:
    """The constraint that a text describes; ValueError for one that is not linear, or cannot be met."""
    places = {f"_p{i}_": i for i in range(len(names))}
    code = text
    for i in sorted(range(len(names)), key=lambda i: -len(names[i])):  # a name may contain another, or brackets
        code = re.sub(rf"(?<![\w\]]){re.escape(names[i])}(?![\w\[])", f"_p{i}_", code)
    try:
        tree = ast.parse(code.strip(), mode="eval").body
    except SyntaxError:
        tree = None
    if not isinstance(tree, ast.Compare):
        raise ValueError(f'constrain: {text!r} is no constraint such as "b1 >= 0" or "b1 + b2 == 1".')
    sides = [_linear(side, places, names, text) for side in (tree.left, *tree.comparators)]
    g, low, high = None, -np.inf, np.inf
    for (a, b), sign in zip(pairwise(sides), tree.ops, strict=True):
        if isinstance(sign, ast.Gt | ast.GtE):
            a, b = b, a
        elif not isinstance(sign, ast.Lt | ast.LtE | ast.Eq):
            raise ValueError(f"constrain: {text!r} must compare by <=, >= or ==.")
        rest = b.plus(a.scaled(-1.0))  # rest >= 0
        direction = rest.g if g is None or np.array_equal(rest.g, g) else -rest.g
        if rest.constant or (g is not None and not np.array_equal(direction, g)):
            raise ValueError(f"constrain: {text!r} must be limits of one sum of parameters ({', '.join(names)}).")
        g = direction
        limit, above = (-rest.c, True) if np.array_equal(rest.g, g) else (rest.c, False)
        if above or isinstance(sign, ast.Eq):
            low = max(low, limit)
        if not above or isinstance(sign, ast.Eq):
            high = min(high, limit)
    if g is None or not low <= high:
        raise ValueError(f"constrain: no parameters satisfy {text!r}.")
    return HalfSpace(text, g, low, high)


def _linear(node: ast.expr, places: dict[str, int], names: Sequence[str], text: str) -> _Linear:
    n = len(names)

    def at(one: ast.expr) -> _Linear:
        return _linear(one, places, names, text)

    match node:
        case ast.Constant(value=(int() | float()) as value):
            return _Linear(np.zeros(n), float(value))
        case ast.Name(id=name) if name in places:
            return _Linear(np.eye(n)[places[name]], 0.0)
        case ast.UnaryOp(op=ast.USub()):
            return at(node.operand).scaled(-1.0)
        case ast.BinOp(op=ast.Add()):
            return at(node.left).plus(at(node.right))
        case ast.BinOp(op=ast.Sub()):
            return at(node.left).plus(at(node.right).scaled(-1.0))
        case ast.BinOp(op=ast.Mult()) if at(node.left).constant:
            return at(node.right).scaled(at(node.left).c)
        case ast.BinOp(op=ast.Mult() | ast.Div()) if at(node.right).constant:
            factor = at(node.right).c
            return at(node.left).scaled(factor if isinstance(node.op, ast.Mult) else 1.0 / factor)
    raise ValueError(
        f"constrain: {text!r} is not linear in the parameters {', '.join(names)}; use sums, differences, and products "
        "with numbers."
    )

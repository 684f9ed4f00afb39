"""Calls in C: other steps, and the few functions that every step may use."""

from __future__ import annotations

import ast
import math
from typing import Any

import numpy as np

from driftfit.embedded.expressions import Expressions
from driftfit.embedded.values import RANK, Value, joined, number, plain, view
from driftfit.engine import kernel, simd
from driftfit.engine.tracker_part import tracker_part, whole_record

FOUR = {simd.fill_four: "four_of", simd.load_four: "four_at", simd.plus: "four_plus", simd.times: "four_times"}


class Calls(Expressions):
    """The part of the translator that turns calls into values."""

    def called(self, source: Any, arguments: list[Value], statement: bool) -> Value:
        raise NotImplementedError

    def call(self, node: ast.Call, statement: bool) -> Value:
        """A call of another step, or of one of the functions that every step may use."""
        if isinstance(node.func, ast.Attribute) and node.func.attr == "view":
            return self._reinterpreted(node)
        function = self.value(node.func).constant
        arguments = [plain(self.value(one)) for one in node.args]
        if function in (tracker_part, whole_record):
            return arguments[0]  # in C there is one record
        if function is kernel.packed or (function is kernel.wholes and arguments[0].kind == "items"):
            return arguments[0]  # C passes addresses one by one
        if function in (kernel.floats, kernel.wholes, kernel.cubes):
            return self._at_address(arguments)
        if function in (simd.in_blocks, simd.in_fours):
            return number(False)
        if function in FOUR or function is simd.reached:
            return self._of_four(function, arguments)
        if hasattr(function, "py_func"):
            return self.called(function.py_func, arguments, statement)
        return self._builtin(node, function, arguments)

    def _at_address(self, arguments: list[Value]) -> Value:
        """An array with these extents; only the first of them may be unknown."""
        extents = [self.unit.largest if one.constant is None else int(one.constant) for one in arguments[1:]]
        strides = [int(np.prod(extents[axis + 1 :])) for axis in range(len(extents))]
        return Value("array", arguments[0].text, shape=tuple(extents), strides=tuple(strides))

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
            return (
                Value("real", f"R_ABS({one.text})") if one.kind == "real" else Value(one.kind, f"whole_abs({one.text})")
            )
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

    def _reinterpreted(self, node: ast.Call) -> Value:
        """Reinterpret the bits of a number as another type."""
        assert isinstance(node.func, ast.Attribute)
        inner, to = self.value(node.func.value), self.value(node.args[0]).constant
        return (
            Value("real", f"from_bits({inner.text})") if to is np.float64 else Value("long", f"bits_of({inner.text})")
        )

    def _of_four(self, function: Any, arguments: list[Value]) -> Value:
        """Four numbers at once are a structure of four."""
        self.ops[-1]["multiply" if function is simd.times else "add"] += 4
        if function is simd.reached:
            one, other = arguments
            return Value("long", f"four_reached({one.text}, {other.text})", most=4)
        if function is simd.load_four:
            array, row, _ = arguments
            return Value("four", f"four_at({view(array, [row, range(4)]).text})")
        return Value("four", f"{FOUR[function]}({', '.join(one.text for one in arguments)})")

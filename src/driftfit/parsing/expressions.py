"""Models and trackers written as in Python: ``ARX(2, [2, 2], intercept=True)``, ``Kalman(q=1e-4, r=0.1)``.

The text is parsed into a syntax tree of calls and literals and never evaluated: only classes of the library may be
called, with numbers, texts, None, lists, tuples, mappings or such calls as arguments.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from typing import Any, TypeVar

import driftfit
from driftfit.engine.settings import Settings, near

Kind = TypeVar("Kind", bound=Settings)

LONGEST = 2000
"""Characters of an expression."""
CONSTRUCTORS = {("Sensor", "nominal")}
"""Named constructors that may be called."""


def read(text: str, kind: type[Kind], main: Mapping[str, type[Any]]) -> Kind:
    """The model or tracker that a text describes; ``main`` are the models or trackers that may be at its beginning.

    ValueError with the reason if it is wrong.
    """
    found = _call(text, main)
    if not isinstance(found, kind):
        what = kind.__name__.lower()
        raise ValueError(f"{text!r} is a {type(found).__name__}, not a {what}; {near('', main)}")
    return found


def _call(text: str, main: Mapping[str, type[Any]]) -> Any:
    if len(text) > LONGEST:
        raise ValueError(f"the expression has {len(text)} characters; at most {LONGEST} are read.")
    try:
        return _value(ast.parse(text.strip(), mode="eval").body, {**_known(), **main})
    except (SyntaxError, RecursionError, MemoryError):
        raise ValueError(f"{text!r} is not an expression such as ARX(2, 2) or Kalman(q=1e-4, r=0.1).") from None


def _known() -> dict[str, Any]:
    """Settings that the library exports, by name."""
    exported = {name: getattr(driftfit, name) for name in driftfit.__all__}
    return {name: kind for name, kind in exported.items() if isinstance(kind, type) and issubclass(kind, Settings)}


def _value(node: ast.expr, known: dict[str, Any]) -> Any:
    """A literal, or a call of a known name with such values."""
    if isinstance(node, ast.Call):
        given = {one.arg: _value(one.value, known) for one in node.keywords if one.arg is not None}
        if len(given) < len(node.keywords) or any(isinstance(one, ast.Starred) for one in node.args):
            raise ValueError("* and ** are not allowed in an expression; name each setting.")
        make = _constructor(node.func, known)
        try:
            return make(*(_value(one, known) for one in node.args), **given)
        except TypeError as error:
            raise ValueError(f"{ast.unparse(node)}: {str(error).replace('.__init__()', '')}.") from None
    if isinstance(node, ast.List | ast.Tuple):
        found = [_value(one, known) for one in node.elts]
        return found if isinstance(node, ast.List) else tuple(found)
    if isinstance(node, ast.Dict) and None not in node.keys:
        keys = [_value(one, known) for one in node.keys if one is not None]
        return dict(zip(keys, (_value(one, known) for one in node.values), strict=True))
    try:
        return ast.literal_eval(node)
    except ValueError:
        raise ValueError(
            f"{ast.unparse(node)!r} is not a number, a text, a list or a setting of the library; expressions are read "
            "as literals and never evaluated."
        ) from None


def _constructor(node: ast.expr, known: dict[str, Any]) -> Any:
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        if (node.value.id, node.attr) in CONSTRUCTORS and node.value.id in known:
            return getattr(known[node.value.id], node.attr)
    elif isinstance(node, ast.Name):
        if node.id in known:
            return known[node.id]
        raise ValueError(f"there is no {node.id!r}; {near(node.id, known)}")
    raise ValueError(f"{ast.unparse(node)!r} cannot be called here; name a model, a tracker or one of their settings.")

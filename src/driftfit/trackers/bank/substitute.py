"""Recompile functions with some of the functions that they call replaced by others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import CellType, FunctionType
from typing import Any

from driftfit.engine.identity import used_globals
from driftfit.engine.kernel import Machine, machine


def substituted(functions: Sequence[Any], others: Mapping[Any, Any]) -> tuple[Any, ...]:
    """Compiled functions, recompiled with some of the functions that they call replaced.

    ``others`` maps each function to its replacement, which also applies to indirect calls. So the second form of a
    compiled routine is the first with some parts replaced, and is compiled only if it is needed.

    Raises
    ------
    ValueError
        If nothing calls a function that is to be replaced.
    """
    found = {id(old): (old, new, new is old) for old, new in others.items()}
    made = tuple(_replaced(function, found) for function in functions)
    unused = [old.__name__ for old, new, asked in (found[id(old)] for old in others) if not asked]
    if unused:
        raise ValueError(f"substituted: nothing calls {', '.join(unused)}.")
    return made


def _replaced(value: Any, found: dict[int, tuple[Any, Any, bool]]) -> Any:
    if id(value) not in found:
        found[id(value)] = value, _rebuilt(value, found), True
    old, new, _ = found[id(value)]
    found[id(value)] = old, new, True
    return new


def _rebuilt(value: Any, found: dict[int, tuple[Any, Any, bool]]) -> Any:
    """The function itself where nothing that it calls is replaced."""
    inner = value.dispatcher if isinstance(value, Machine) else value
    if not hasattr(inner, "py_func"):
        return value
    source = inner.py_func
    used = used_globals(source)
    new = {name: _replaced(one, found) for name, one in used.items()}
    held = [cell.cell_contents for cell in source.__closure__ or ()]
    hold = [_replaced(one, found) for one in held]
    if all(new[name] is one for name, one in used.items()) and all(a is b for a, b in zip(held, hold, strict=True)):
        return value
    names, closure = source.__globals__ | new, tuple(CellType(one) for one in hold) or None
    made = FunctionType(source.__code__, names, source.__name__, source.__defaults__, closure)
    return machine(made, value.short) if isinstance(value, Machine) else inner.again(made)

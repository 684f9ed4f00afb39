"""Names for functions that change when their code, or anything that they use, changes."""

from __future__ import annotations

import builtins
import dis
import hashlib
import math
from types import CodeType, FunctionType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

LOAD_GLOBAL = dis.opmap["LOAD_GLOBAL"]
_NAMES: WeakKeyDictionary[FunctionType, frozenset[str]] = WeakKeyDictionary()


def identity(function: FunctionType) -> str:
    """A name for a function that changes when its code, or anything that it uses, changes.

    Numba's cache looks at the time stamp of the one file that holds the driver; steps live in other files. Giving every
    step an identity made of its code and the identities of what it refers to lets drivers that are closures over steps
    be found on disk by a second process, and recompiles them when a step was edited. The identity is that of the
    compiled code, not of its text: the file may have been edited since it was imported, and at a prompt there is none.
    """
    used = used_values(function)
    used |= {"defaults": (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).items())}
    parts = [function.__module__, function.__qualname__, _code(function.__code__)]
    parts += [f"{name}={_identity_of(value, function, name)}" for name, value in sorted(used.items())]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def used_values(function: FunctionType) -> dict[str, Any]:
    """The globals and the variables of enclosing functions that a function reads."""
    closed = zip(function.__code__.co_freevars, (c.cell_contents for c in function.__closure__ or ()), strict=True)
    return used_globals(function) | dict(closed)


def names_in(function: FunctionType) -> frozenset[str]:
    """Names of all attributes, fields of records among them, in a function and the compiled functions that it uses."""
    if function not in _NAMES:
        inner = (getattr(value, "py_func", None) for value in used_values(function).values())
        _NAMES[function] = frozenset(function.__code__.co_names).union(*(names_in(f) for f in inner if f is not None))
    return _NAMES[function]


def used_globals(function: FunctionType) -> dict[str, Any]:
    """The globals that a function reads; TypeError if one is not yet defined, because its edits would go unnoticed."""
    names = _globals(function.__code__)
    later = sorted(names - function.__globals__.keys() - vars(builtins).keys())
    if later:
        raise TypeError(
            f"the kernel {function.__qualname__} uses {', '.join(later)}, which is not defined above it; put what a "
            "compiled function uses before it in the file."
        )
    return {name: function.__globals__[name] for name in names & function.__globals__.keys()}


def _globals(code: CodeType) -> set[str]:
    """Global names that code reads, also in the functions and comprehensions inside it; not those of attributes.

    `dis.get_instructions` gives the same, and took a third of the time of importing the package.
    """
    names, extended = set(), 0
    for operation, argument in zip(code.co_code[::2], code.co_code[1::2], strict=True):
        argument |= extended << 8
        if operation == LOAD_GLOBAL:
            names.add(code.co_names[argument >> 1])
        extended = argument if operation == dis.EXTENDED_ARG else 0
    return names.union(*(_globals(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def _code(code: CodeType) -> str:
    """The contents of code, without line numbers."""
    constants = [_code(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return repr((code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars))


def _identity_of(value: Any, function: FunctionType, name: str) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(_identity_of(v, function, name) for v in value)})"
    if value is np or value is math:  # attributes of any other module may be edited unnoticed
        return str(value.__name__)
    if isinstance(value, bool | int | float | str | type(None) | np.generic):
        return repr(value)
    if isinstance(value, np.ndarray):  # a constant to the compiler
        return f"{value.dtype}{value.shape}{value.tobytes().hex()}"
    if hasattr(value, "identity"):
        return str(value.identity)
    raise TypeError(
        f"the kernel {function.__qualname__} uses {name!r}, a {type(value).__name__}; a kernel may use numpy, math, "
        "numbers, strings, tuples of these, and other kernels, each imported by its own name. Pass anything else "
        "through a field of the record."
    )

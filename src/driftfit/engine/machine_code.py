"""Machine code of a function that Python calls: compiled to bytes, loaded, and freed with its last reference.

Numba's own loader never frees anything. A driver is therefore compiled by Numba but loaded by another loader of LLVM
(ORC), as a library of its own: when nothing refers to the entry point any more, its memory is returned. What is kept on
disk is the same object code, so that a second process does not need the compiler at all.
"""

from __future__ import annotations

import ctypes
import itertools
import sys
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from numba import _dynfunc, njit
from numba.core.environment import lookup_environment
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys

from driftfit.engine.linking import LinkedDispatcher, Whole, forget, only_linked

ENVIRONMENT = "_ZN08NumbaEnv"
"""Beginning of the names of the variables through which compiled code finds the environment of a function."""

OWN_ADDRESSES = "numba.dynamic.globals"
"""Beginning of the names of variables that hold addresses of this process."""


class Code(NamedTuple):
    """A compiled function, as it is kept on disk."""

    data: bytes
    """Object code."""
    module: str
    name: str
    wrapper: str
    """Symbol of what Python calls."""
    outside: tuple[str, ...]
    """Symbols that it calls and does not have."""
    environments: tuple[tuple[str, Any], ...]
    """Symbols of environments, its own first, and the environments."""
    lasting: bool
    """Whether it means the same in another process."""


class WholeDispatcher(LinkedDispatcher):
    """A function that takes in all that it calls."""

    library = Whole


def compiled(function: FunctionType, arguments: tuple[Any, ...]) -> Code:
    """Compile a function for one signature. Afterwards the compiler keeps of its parts only those used last."""
    dispatcher = only_linked(njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True)(function), WholeDispatcher)
    dispatcher.compile(arguments)
    made = dispatcher.overloads[arguments]
    module = made.library._final_module
    variables = [v.name for v in module.global_variables if not v.is_declaration]
    own = cpu_target.target_context.get_env_name(made.fndesc)
    names = [own, *(name for name in variables if name.startswith(ENVIRONMENT) and name != own)]
    environments = {name: lookup_environment(name) for name in names if name in variables}
    absent = [f.name for f in (*module.functions, *module.global_variables) if f.is_declaration]
    code = Code(
        made.library.codegen._tm.emit_object(module), made.fndesc.modname, function.__name__,
        made.fndesc.llvm_cpython_wrapper_name, tuple(name for name in absent if not name.startswith("llvm.")),
        ((own, made.environment), *((name, env) for name, env in environments.items() if name != own and env)),
        all(env is None or env.can_cache() for env in environments.values())
        and not any(name.startswith(OWN_ADDRESSES) for name in variables),
    )  # fmt: skip
    forget()
    return code


def loaded(code: Code) -> Any:
    """The entry point of code; its memory is freed when nothing refers to the entry point."""
    loader = _loader()
    library = llvm.JITLibraryBuilder().add_object_img(code.data).add_current_process().export_symbol(code.wrapper)
    for name in code.outside:
        address = llvm.address_of_symbol(name)
        if address is not None:
            library.import_symbol(name, address)
    for name, _ in code.environments:
        library.export_symbol(name)
    tracker = library.link(loader, f"driftfit{next(_numbers)}")
    for name, environment in code.environments:
        ctypes.c_void_p.from_address(tracker[name]).value = id(environment)
    kept = (tracker, *(environment for _, environment in code.environments))
    module, own = sys.modules.get(code.module), code.environments[0][1]
    return _dynfunc.make_function(module, code.name, code.name, tracker[code.wrapper], own, kept)


_numbers = itertools.count()


@cache
def _loader() -> Any:
    """The loader; what compiled code calls of Numba's own is there after this."""
    cpu_target.target_context.refresh()
    rtsys.initialize(cpu_target.target_context)
    return llvm.create_lljit_compiler()

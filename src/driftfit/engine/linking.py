"""Functions that are only linked into others: no machine code of their own, and kept no longer than they are needed.

Numba optimises every function, emits its machine code, and keeps what it made of it (typed code, LLVM's module, machine
code) until the process ends, also where all that ever happens to a function is that a larger one takes it in. In a
machine of a hundred parts, six deep, that was three fifths of the time of compiling it; in a process that compiled
hundreds of drivers it was gigabytes. Here such a function is typed and turned into LLVM's language only, and of what
was made only the functions used last are kept, for the next driver that takes them in.

This leans on Numba's own parts: the library of code that a compilation makes, the environment that Python errors need,
which such functions do not raise, and the table of overloads of a dispatcher.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from weakref import ref

from llvmlite.binding import newpassmanagers as passes
from numba import njit
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import CPUDispatcher, cpu_target

KEPT = 100
"""Functions whose code is kept for drivers to come, of some 0.3 MB each; a driver takes in some twenty."""

# llvmlite 0.50 frees no pass manager: both classes inherit the `_dispose` that does nothing. They were
# three fifths of all memory that a compilation left behind.
for _manager in (passes.ModulePassManager, passes.FunctionPassManager):
    if _manager._dispose is passes.ffi.ObjectRef._dispose:
        _manager._dispose = passes.NewPassManager._dispose


class Linked(JITCodeLibrary):
    """Code for others to take in."""

    def _optimize_final_module(self) -> None:
        """Those who take it in do."""

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """There is none: nothing was emitted."""
        return 0

    def serialize_using_object_code(self) -> Any:
        """What is kept on disk: there is no object code."""
        return self.serialize_using_bitcode()


class Whole(Linked):
    """Code that has taken in all that it needs: optimised here, emitted and loaded by `machine_code`."""

    def _optimize_final_module(self) -> None:
        JITCodeLibrary._optimize_final_module(self)

    def get_pointer_to_function(self, name: str) -> int:
        """None yet; asking for it is how Numba says that nothing more will be added."""
        self._ensure_finalized()
        return 0


class LinkedDispatcher(CPUDispatcher):
    """A function that Numba compiles for others to take in."""

    library: type[Linked] = Linked

    def __call__(self, *arguments: Any) -> Any:
        raise TypeError(
            f"{self.py_func.__qualname__} is a part of a machine, which has no code of its own; to see what it does "
            "from Python call its py_func."
        )

    def compile(self, signature: Any) -> Any:
        """The types and code of one signature."""
        with _library_of(self.py_func.__qualname__, self.library):
            made = super().compile(signature)
        _used(self, signature)
        return made


class StepDispatcher(LinkedDispatcher):
    """A step: taken in by drivers; for Python it is compiled once more, into code that can be called.

    Optimised by itself as well: what the compiler sees of it inside a loop over lanes depends on that (5 per cent).
    """

    library = Whole

    def __call__(self, *arguments: Any) -> Any:
        if "callable" not in vars(self):
            self.callable = njit(error_model="numpy", nogil=True)(self.py_func)
        return self.callable(*arguments)


def only_linked(dispatcher: Any, kind: type[LinkedDispatcher] = LinkedDispatcher) -> Any:
    """Let a function that Numba compiles be linked into others and nothing else."""
    dispatcher.__class__ = kind
    return dispatcher


@contextmanager
def _library_of(name: str, kind: type[Linked]) -> Iterator[None]:
    """While it lasts, what is compiled under this name becomes `Linked`; of nested ones the inner stands."""
    codegen = cpu_target.target_context.codegen()
    create, restore, set_env = codegen.create_library, codegen.unserialize_library, codegen.set_env

    def create_linked(called: str, **options: Any) -> Any:
        return kind(codegen, called, **options) if called == name else create(called, **options)

    def restore_linked(stored: Any) -> Any:
        return kind._unserialize(codegen, stored) if stored[0] == name else restore(stored)

    def set_env_of_emitted(env_name: str, env: Any) -> None:
        if codegen._engine.is_symbol_defined(env_name):
            set_env(env_name, env)

    build = codegen._pass_builder

    def build_once(**options: Any) -> Any:
        key = tuple(sorted(options.items()))
        if key not in _builders:
            _builders[key] = build(**options)
        return _builders[key]

    before = {"create_library": create, "unserialize_library": restore, "set_env": set_env, "_pass_builder": build}
    try:
        vars(codegen).update(
            create_library=create_linked, unserialize_library=restore_linked, set_env=set_env_of_emitted,
            _pass_builder=build_once,
        )  # fmt: skip
        yield
    finally:
        vars(codegen).update(before)


_builders: dict[Any, Any] = {}
"""What makes LLVM's passes, by its options: Numba makes one for every function, and LLVM does not free all of it."""


_recent: OrderedDict[Any, None] = OrderedDict()
"""(dispatcher, types of the arguments) of what was compiled only to be linked, those used last at the end."""


def _used(dispatcher: Any, signature: Any) -> None:
    key = ref(dispatcher), tuple(getattr(signature, "args", signature))
    _recent[key] = None
    _recent.move_to_end(key)


def forget(most: int | None = None) -> None:
    """Let go of all but the functions used last (`KEPT`), and not while something is compiled that may take them in."""
    while len(_recent) > (KEPT if most is None else most):
        (place, arguments), _ = _recent.popitem(last=False)
        dispatcher = place()
        if dispatcher is not None and arguments in dispatcher.overloads:
            dispatcher.targetctx.remove_user_function(dispatcher.overloads.pop(arguments).entry_point)
            rest = list(dispatcher.overloads.values())
            dispatcher._reset_overloads()  # the table in C, which has no way to drop one of its rows
            for one in rest:
                dispatcher.add_overload(one)

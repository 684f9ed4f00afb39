"""Functions that are only linked into others: neither optimised nor turned into machine code by themselves.

Numba optimises every function and emits its machine code when it is compiled, also where all that ever happens to it is
that a larger one takes it in, which is then optimised once more. In a machine of a hundred parts, six deep, that was
three fifths of the time of compiling it.

This leans on Numba's own parts: the library of code that a compilation makes, and the environment that Python errors
need, which such functions do not raise.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.registry import CPUDispatcher, cpu_target


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


class LinkedDispatcher(CPUDispatcher):
    """A function that Numba compiles for others to take in."""

    def __call__(self, *arguments: Any) -> Any:
        raise TypeError(
            f"{self.py_func.__qualname__} is a part of a machine, which has no code of its own; to see what it does "
            "from Python call its py_func."
        )

    def compile(self, signature: Any) -> Any:
        """The types and code of one signature."""
        with _library_of(self.py_func.__qualname__):
            return super().compile(signature)


def only_linked(dispatcher: Any) -> Any:
    """Let a function that Numba compiles be linked into others and nothing else."""
    dispatcher.__class__ = LinkedDispatcher
    return dispatcher


@contextmanager
def _library_of(name: str) -> Iterator[None]:
    """While it lasts, what is compiled under this name becomes `Linked`; of nested ones the inner stands."""
    codegen = cpu_target.target_context.codegen()
    create, restore, set_env = codegen.create_library, codegen.unserialize_library, codegen.set_env

    def create_linked(called: str, **options: Any) -> Any:
        return Linked(codegen, called, **options) if called == name else create(called, **options)

    def restore_linked(stored: Any) -> Any:
        return Linked._unserialize(codegen, stored) if stored[0] == name else restore(stored)

    def set_env_of_emitted(env_name: str, env: Any) -> None:
        if codegen._engine.is_symbol_defined(env_name):
            set_env(env_name, env)

    changed = {"create_library": create_linked, "unserialize_library": restore_linked, "set_env": set_env_of_emitted}
    try:
        vars(codegen).update(changed)
        yield
    finally:
        vars(codegen).update(create_library=create, unserialize_library=restore, set_env=set_env)

"""What Numba looks for again and again while it compiles is looked for once.

Numba tries dozens of templates for every operation of every function, and compares compile options one by one for each:
a fifth of the time of compiling. What it found for an operation, types and options is remembered, by replacing
`Function.get_call_type` and the comparison of `Flags`. Before each function, and at every second call in it, it looks
for declarations of new types and functions; `known_once` looks once.

Private parts: `Function.get_call_type` and `_impl_keys`, `Flags._values`, `Record.__repr__`, `refresh` of the target
and typing contexts, `_registries`, `_check_llvm_bugs`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any

from numba import types
from numba.core.compiler import Flags
from numba.core.registry import cpu_target
from numba.core.targetconfig import ConfigStack

__all__ = ["cpu_target", "known_once", "replaced"]


@contextmanager
def replaced(owner: Any, **ours: Any) -> Iterator[None]:
    """While it lasts, attributes of an object are ours."""
    before = {key: vars(owner)[key] for key in ours if key in vars(owner)}
    try:
        vars(owner).update(ours)
        yield
    finally:
        for key in ours:
            del vars(owner)[key]
        vars(owner).update(before)


@contextmanager
def known_once() -> Iterator[None]:
    """While it lasts, Numba looks for declarations and for a bug of LLVM once, instead of before each function, and at
    every second call in it; of known declarations only new ones are installed. Sizes of types are found once too.
    """
    context = cpu_target.target_context
    if "refresh" in vars(context):
        yield
        return
    context.refresh()
    codegen, size = context.codegen(), cache(context.get_abi_sizeof)
    codegen._check_llvm_bugs()

    def look_again(at: Any) -> None:
        for registry in list(at._registries):
            at.install_registry(registry)

    with (
        replaced(context, refresh=partial(look_again, context), get_abi_sizeof=size),
        replaced(context.typing_context, refresh=partial(look_again, context.typing_context)),
        replaced(codegen, _check_llvm_bugs=lambda: None),
    ):
        yield


def _remembered(find: Callable[..., Any]) -> Callable[..., Any]:
    """The types of a call of one of Numba's own operations, as ``find`` gives them."""
    known: dict[Any, tuple[Any, Any]] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or not all(isinstance(one, _PLAIN) for one in args):
            return find(self, context, args, kws)
        key = self, context, tuple(args), ConfigStack.top_or_none()
        if key not in known:
            found = find(self, context, args, kws)
            known[key] = found, self._impl_keys[found.args]
        found, self._impl_keys[found.args] = known[key]  # options of another function may have changed the latter
        return found

    return get_call_type


def _same_options(one: Any, other: Any) -> bool:
    """Whether two sets of options are equal; one that was not given has its default."""
    if type(one) is not type(other):
        return False
    given, others = one._values, other._values
    return given == others or all(getattr(one, key) == getattr(other, key) for key in given.keys() | others.keys())


_PLAIN = types.Number, types.Boolean, types.Array, types.BaseTuple, types.Literal, int  # no code, which must be let go
_NAMES = hash(tuple(sorted(Flags.options)))  # what Numba's own hash amounts to: it sorts names, not values
types.Function.get_call_type = _remembered(types.Function.get_call_type)
Flags.__eq__ = _same_options
Flags.__hash__ = lambda self: _NAMES
types.Record.__repr__ = lambda self: self.name  # written out for every pass over a function, and read by nobody

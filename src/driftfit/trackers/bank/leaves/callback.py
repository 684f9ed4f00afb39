"""Functions that a compiled routine calls by address; a step looks the address up by symbol.

The routine of a bank is compiled once, when the user's function that it calls is not known yet. The function is
therefore compiled as a separate routine, a step looks up its address at run time, and `call` calls it.
"""

from __future__ import annotations

from typing import Any

from numba import types

from driftfit.engine.numba_internals import ir, named_intrinsic

NUMBERS = 6
"""Numbers that a function called by its address takes, before the address of its results."""
_KIND = ir.FunctionType(ir.VoidType(), [ir.DoubleType()] * NUMBERS + [ir.IntType(64)])


def _address_of(context: Any, machine: Any) -> Any:
    """The address of a compiled routine in this process."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        known = builder.module.globals.get(machine.symbol)
        function = known or ir.Function(builder.module, _KIND, machine.symbol)
        return builder.ptrtoint(function, ir.IntType(64))

    return types.intp(machine), build


def _call(context: Any, address: Any, numbers: Any, out: Any) -> Any:
    """Call the function at an address with a tuple of six numbers and the address of its results."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, given, results = arguments
        values = [builder.extract_value(given, k) for k in range(NUMBERS)]
        builder.call(builder.inttoptr(at, _KIND.as_pointer()), [*values, results])
        return context.get_dummy_value()

    return types.void(types.intp, types.UniTuple(types.float64, NUMBERS), types.intp), build


address_of = named_intrinsic("callback.address_of", _address_of)
call = named_intrinsic("callback.call", _call)

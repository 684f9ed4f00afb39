"""Functions that a compiled machine calls by their address, which a step finds by their symbol.

A machine is compiled once for all; a function of the user's that it calls is not known then. So the function becomes a
machine of its own (`driftfit.engine.kernel.outside`), a step asks for its address where it runs, and `call` goes there.

This leans on Numba's own parts: the descriptor of an external function, and LLVM's function types.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import funcdesc
from numba.extending import intrinsic

NUMBERS = 6
"""Numbers that a function called by its address takes, before the address of its results."""


@intrinsic
def address_of(context: Any, machine: Any) -> Any:
    """The address of a machine in this process."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        described = funcdesc.ExternalFunctionDescriptor(
            name=machine.symbol, restype=machine.sig.return_type, argtypes=machine.sig.args
        )
        function = context.declare_external_function(builder.module, described)
        return builder.ptrtoint(function, context.get_value_type(types.intp))

    return types.intp(machine), build


@intrinsic
def call(context: Any, address: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, out: Any) -> Any:
    """Call the function at an address with six numbers and the address of its results."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds = [ir.DoubleType()] * NUMBERS + [ir.IntType(64)]
        kind = ir.FunctionType(ir.VoidType(), kinds)
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.intp, *[types.float64] * NUMBERS, types.intp), build


for _one, _name in ((address_of, "address_of"), (call, "call")):
    _one.identity = f"callback.{_name}"
    _one._set_uuid(_one.identity)  # Numba would give it a new one in every process, and never find its callers on disk

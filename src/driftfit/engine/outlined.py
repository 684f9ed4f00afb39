"""Steps that drivers call instead of inlining them, compiled to object code of their own.

A driver inlines the steps of a tracker, and the compiler optimises them again in each driver: for every model, for
every set of stored results, for records and for streams. For a step that takes a microsecond a call costs nothing, so
it is compiled once for each kind of record that it works on, and drivers refer to it by its symbol. Records of one lane
are of one kind if they have the fields that the step names, whatever the number of parameters, the model and the gate.
"""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import Any
from weakref import WeakValueDictionary

from numba import types

from driftfit.engine import disk_cache
from driftfit.engine import numba_internals as internals
from driftfit.engine.compile_notice import compiling
from driftfit.engine.identity import names_in

PREFIX = "outlined-"
"""Beginning of the symbols of outlined steps, which are the names of their files too."""

SOURCES: dict[str, tuple[FunctionType, types.Type, bool]] = {}
"""The function, the type of its record and whether its code is short, by symbol, of all steps that this process met
while it compiled."""

LINKED: WeakValueDictionary[str, internals.Linked] = WeakValueDictionary()
"""Outlined steps that drivers of this process use, by symbol."""


def outlined(step: Any, short: bool = False, lanes: Any = None) -> Any:
    """A step, which takes the record only, as drivers call it. For one lane it is compiled once for all sizes of the
    record (`driftfit.engine.compile_time.open_record`), and for size if it is ``short`` because it seldom runs; for
    several lanes it is compiled once for each size, or ``lanes`` in its place.
    """
    named, lanes = names_in(step.py_func), lanes or step

    def typed(context: Any, record: Any) -> Any:
        known = record.fields["theta"].type.shape[-1] > 1
        fields = {name: record.fields[name] for name in sorted(named & record.fields.keys())} or record.fields
        taken, used = (record, lanes) if known else (internals.OpenRecord(fields), step)
        symbol = disk_cache.name_of(PREFIX.rstrip("-"), used.identity, taken)
        SOURCES[symbol] = used.py_func, taken, short and not known

        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            argument = given if known else [internals.opened(context, builder, fields, given[0])]
            return internals.call(context, builder, symbol, (taken,), argument)

        return types.none(record), build

    made = internals.named_intrinsic(f"outlined.{step.identity}.{lanes.identity}", typed)
    made.py_func, made.short = step.py_func, short
    return made


def called_by(code: internals.Code) -> dict[str, internals.Linked] | None:
    """The outlined steps that code calls, by symbol; None if one of them is neither in this process nor on disk, and
    its source is not known here: the driver that calls it must be compiled again.
    """
    found = {symbol: _linked(symbol) for symbol in code.outside if symbol.startswith(PREFIX)}
    return None if None in found.values() else found  # type: ignore[return-value]


def _linked(symbol: str) -> internals.Linked | None:
    """An outlined step in this process, from disk, or from the compiler."""
    found = LINKED.get(symbol)
    if found is None:
        stored = disk_cache.read(symbol)
        if stored is None:
            if symbol not in SOURCES:
                return None
            source, record, short = SOURCES[symbol]
            stored = object_code(source, symbol, (record,), from_python=False, short=short)
        found = LINKED[symbol] = internals.Linked(internals.Code(*stored))
    return found


def object_code(
    source: Callable[..., Any],
    name: str,
    arguments: tuple[types.Type, ...],
    from_python: bool = True,
    short: bool = False,
) -> internals.Code:
    """Compile a function for one signature, and store the code on disk under a name."""
    assert isinstance(source, FunctionType)
    twin = FunctionType(source.__code__, source.__globals__, source.__name__, None, source.__closure__)
    twin.__qualname__ = name.removesuffix(disk_cache.ENDING).replace("-", "_")
    try:
        with compiling():
            code = internals.emit(twin, arguments, from_python, short)
    except KeyError as missing:
        raise TypeError(
            f"a compiled step names the field {missing}, which its record does not have. The steps of a "
            "tracker see fields of the model only with TrackerSteps(..., reads_model=True)."
        ) from None
    if code.lasting:
        disk_cache.write(name, tuple(code))
    return code

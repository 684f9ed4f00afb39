"""Insert a check at every index of compiled code, of scalars and of SIMD vectors.

Numba's own checks raise an exception, which a routine that returns nothing cannot do. Here a violation calls back into
Python with its line, the index and the length, and the routine continues. The callback is found by a symbol, so that
code with checks is stored on disk like any other, in a folder of its own.
"""

from __future__ import annotations

import ctypes
import os
import sys
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SYMBOL = "driftfit_out_of_bounds"
PACKAGES = ("driftfit", "lab", "tests")
"""Folders whose lines are named; the frames of Numba itself are passed over."""
STORE = Path(__file__).parents[2] / "src" / "driftfit" / "engine" / "__pycache__"


def settings() -> dict[str, str]:
    """The variables with which a process must begin: Numba reads them when it is imported."""
    build = zlib.crc32(Path(__file__).read_bytes())
    return {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(STORE / f"checked-{build:08x}"), "NUMBA_OPT": "0"}


@dataclass
class Violations:
    """The violations since they were last taken."""

    places: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By file and line: an index, and the length of its array."""
    checks: int = 0
    """Checks that this process has compiled; what was found on disk has its own."""
    kept: list[Any] = field(default_factory=list)
    """The callback, which compiled code calls as long as the process lives."""

    def take(self) -> list[str]:
        """The violations since the last call."""
        result = [f"{place}: index {index} of {size}" for place, (index, size) in sorted(self.places.items())]
        self.places.clear()
        return result


def watch() -> Violations:
    """Insert checks into all code that this process compiles from now on."""
    import llvmlite.binding as llvm
    from llvmlite import ir
    from numba.core import cgutils, config
    from numba.core.registry import cpu_target

    from driftfit.engine import simd

    i64, violations = ir.IntType(64), Violations()
    kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), i64, i64])

    @ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_int64, ctypes.c_int64)
    def note(place: bytes, index: int, size: int) -> None:
        violations.places.setdefault(place.decode(), (index, size))

    violations.kept.append(note)
    llvm.add_symbol(SYMBOL, ctypes.cast(note, ctypes.c_void_p).value)

    def check(context: Any, builder: Any, bad: Any, index: Any, size: Any) -> None:
        violations.checks += 1
        place = context.insert_const_string(builder.module, _line())
        called = cgutils.get_or_insert_function(builder.module, kind, SYMBOL)
        with cgutils.if_unlikely(builder, bad):
            builder.call(called, [place, index, size])

    def checked(context: Any, builder: Any, index: Any, size: Any, axis: Any = None) -> None:
        wide = builder.sext(index, i64) if index.type.width < 64 else index
        check(context, builder, builder.icmp_unsigned(">=", wide, size), wide, size)

    def place(builder: Any, array: Any, row: Any, column: Any) -> Any:
        rows, columns = (builder.extract_value(array.shape, k) for k in (0, 1))
        at = builder.add(builder.mul(row, columns), column)
        size = builder.mul(rows, columns)
        last = builder.add(at, ir.Constant(i64, simd.WIDTH - 1))
        beyond = builder.or_(builder.icmp_signed("<", at, ir.Constant(i64, 0)), builder.icmp_signed(">=", last, size))
        check(cpu_target.target_context, builder, beyond, last, size)
        return builder.bitcast(builder.gep(array.data, [at]), simd._VECTOR8.as_pointer())

    pairs = simd._pair_place

    def pair_place(builder: Any, array: Any, at: Any) -> Any:
        size = _length(builder, array, array.shape.type.count - 1)
        check(cpu_target.target_context, builder, builder.icmp_unsigned(">=", at, size), at, size)
        return pairs(builder, array, at)

    for name in settings():  # processes that a test starts have no checks, and must not store their code in this folder
        del os.environ[name]
    config.reload_config = lambda: None  # it would see that the variables are gone
    cgutils.do_boundscheck = checked
    simd._place, simd._pair_place = place, pair_place
    return violations


def _length(builder: Any, array: Any, axes: int) -> Any:
    """The product of the first extents of an array."""
    shape = array.shape
    size = builder.extract_value(shape, 0)
    for k in range(1, axes):
        size = builder.mul(size, builder.extract_value(shape, k))
    return size


def _line() -> str:
    """The line of ours that is being compiled."""
    frame = sys._getframe(2)
    while frame is not None:
        where = getattr(frame.f_locals.get("self"), "loc", None)
        path = Path(str(getattr(where, "filename", "")))
        if where is not None and not set(PACKAGES).isdisjoint(path.parts):
            return f"{path.name}:{where.line}"
        frame = frame.f_back  # type: ignore[assignment]
    return "?"

"""Fields of records, variables and loops in compiled code: as Numba has them, in a fraction of the instructions.

Canaries: if one fails, `Lower` in Numba changed, on which `driftfit.engine.compile_time.lowering` leans.
"""

import numba
import numpy as np
import pytest
from numba import types
from numba.core.errors import LoweringError
from numba.core.registry import cpu_target

from driftfit.engine import numba_internals as internals
from driftfit.engine.compile_time.lowering import Direct
from driftfit.engine.kernel import Driver, kernel

RECORD = np.dtype(
    [("a", np.float64, (3, 4)), ("b", np.float64, (3, 4)), ("k", np.int64, (4,)), ("c", np.float64, (2, 3, 4))],
    align=True,
)


def entries(s, i):
    """Entries at constants, variables, and from the end; read, written and added to."""
    total = s.a[i, 1] + s.a[-1, -i] * s.k[3] + s.a[i - 2, np.uint8(2)]
    s.a[0, i] = total
    s.a[0, i] += s.k[-1]
    s.k[i] = 7.9
    s.c[1, -1, i] = s.a[0, i]
    return total


def shapes(s, i):
    """Shapes as a whole, one by one, and in loops."""
    n, L = s.a.shape
    whole = s.c.shape
    total = whole[0] + s.k.shape[0] + len(s.k) + s.c.ndim
    for j in range(n):
        for l in range(1, L):
            total += s.a[j, l] * (j + 1)
    for j in range(n - 1, -1, -1):
        total = 2.0 * total + s.a[j, 0]
    for _ in range(3, 1):
        total = -1.0
    return total + j


def views(s, i):
    """Fields as arrays: under a name, in another block, as rows, and passed on."""
    a = s.a
    if i > 0:
        a = s.b
    row, k = a[i], s.k
    total = 0.0
    for one in row:
        total += one
    for j in range(k.shape[0]):
        total += k[j] * added(s.a, j)
    s.c[1, :, 0] = 3.0
    numbers = range(2, 4) if i > 0 else range(5)
    return total + s.c[:, 1, 2].sum() + len(numbers)


def branches(s, i):
    """Variables that are assigned once, in one branch, or in a loop and used after it."""
    x, y = s.a[0, 0], 1.0
    once = x * 2.0
    if x > 0.0:
        y = once + i
    last = 0.0
    for l in range(s.k.shape[0]):
        z = s.a[1, l] + y
        if z > 1.0:
            last = z
            continue
        if l == 2:
            break
    return last + once + z + l


@numba.njit
def plus(a, j):
    return a[0, j] + a.shape[1]


@kernel
def added(a, j):
    return a[0, j] + a.shape[1]


def driver_of(step):
    def run(tile, i):
        return step(tile[0], i)

    return Driver(run)


def test_records_are_used_as_numba_uses_them():
    start = np.zeros(1, RECORD)
    start["a"], start["k"], start["c"] = np.arange(12.0).reshape(3, 4) - 3.3, [5, -2, 3, 1], 0.1
    for function in (entries, shapes, views, branches):
        theirs_of = numba.njit(type(function)(function.__code__, {**globals(), "added": plus}))

        driver = driver_of(kernel(function))
        for i in (0, 1):
            ours, theirs = start.copy(), start.copy()
            assert driver(ours, i) == theirs_of(theirs[0], i), f"{function.__doc__} Numba's `Lower` changed."
            assert ours.tobytes() == theirs.tobytes(), function.__doc__


def test_the_code_is_short(monkeypatch):
    def length(compiled):
        written = []
        library = type(cpu_target.target_context.codegen().create_library("none"))
        add = library.add_ir_module
        monkeypatch.setattr(library, "add_ir_module", lambda self, made: written.append(str(made)) or add(self, made))
        compiled.compile((numba.typeof(np.zeros(1, RECORD)[0]), numba.intp))
        monkeypatch.undo()
        return max(text.count("\n") for text in written)

    ours = internals.as_part(internals.under_ieee(entries, **internals.LINKED), internals.StepDispatcher)
    assert length(ours) < 0.4 * length(numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True)(entries))


def test_an_error_names_its_line(monkeypatch):
    def broken(self, inst):
        raise LoweringError("a reason")

    def twice(x):
        return 2.0 * x

    monkeypatch.setattr(Direct, "lower_inst", broken)
    with pytest.raises(LoweringError, match=r"(?s)a reason.*lowering .* at .*test_numba_lowering\.py"):
        internals.emit(twice, (types.float64,))

"""Lanes: the record that holds a state, and the decorators that compile functions of it.

The state of one tile is one NumPy record. Every field has a fixed shape with a trailing lane axis of length L, so that
for n parameters ``theta`` is (n, L) and ``P`` is (n, n, L). A *step* is a function ``step(s, l)`` that works on lane
``l`` of the record ``s`` and returns nothing; L = 1 is a stream or a record, L = 32 is thirty-two series side by side.
Shapes belong to the type of the record, so loops over parameters have bounds that the compiler knows.

    kernel    a step, or a function that steps call: inlined into its caller, compiled for every size of the record
    shared    a function of plain arrays with run-time bounds: compiled once for all sizes and kept on disk, called
    part      the same, but inlined into the compiled routine that calls it
    sized     a part that is compiled for each small number of parameters apart
    machine   a routine that steps call by its symbol, with addresses and numbers: compiled apart, once for all drivers
    Driver    what Python calls, with arrays and numbers

None of them may allocate but a `Driver`. Nothing here uses fast-math, so a step gives the same bits at every width.
`driftfit.engine.drivers` holds the loop that runs the steps.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import OrderedDict
from collections.abc import Callable
from operator import attrgetter
from threading import Lock
from types import FunctionType
from typing import Any
from weakref import WeakValueDictionary, ref

import numba
import numpy as np
import numpy.typing as npt
from numba import types
from numba.extending import models, register_model

from driftfit.engine import compile_notice, disk_cache
from driftfit.engine import numba_internals as internals
from driftfit.engine.compile_notice import compiling
from driftfit.engine.identity import identity
from driftfit.engine.outlined import called_by, object_code

Array = npt.NDArray[Any]
State = Any
"""A record of lanes as a kernel sees it: fields as attributes, each an array whose last axis is the lane."""

Step = Callable[[State, int], None]
"""A compiled step, called with the record and a lane."""


MADE: WeakValueDictionary[Any, Any] = WeakValueDictionary()
"""Compiled functions by identity and options: closures are made anew for each set of stored results, and for streams,
but not compiled anew."""


def _compiled(function: Callable[..., Any], cache: bool = False, short: bool = False, **options: bool) -> Any:
    """Compile under IEEE rules and without the GIL; its identity names it in the cache on disk. Whether its code is
    ``short`` is for the caller to see to.
    """
    assert isinstance(function, FunctionType)
    name = hashlib.sha256(f"{identity(function)}{sorted(options)}{'short' * short}".encode()).hexdigest()
    key = name, cache, tuple(sorted(options.items()))
    known = MADE.get(key)
    if known is not None:
        return known
    if cache:
        source = function
        defaults, closure = source.__defaults__, source.__closure__
        function = FunctionType(source.__code__, source.__globals__, source.__name__, defaults, closure)
        function.__qualname__, function.__doc__ = f"{source.__name__}_{name[:16]}", source.__doc__
    dispatcher = internals.under_ieee(function, **options)
    if cache:

        def file(signature: Any) -> str:
            return disk_cache.name_of(function.__name__, name, signature)

        internals.store_by(
            dispatcher, lambda sig: disk_cache.read(file(sig)), lambda sig, data: disk_cache.write(file(sig), data)
        )
    internals.name_for_pickle(dispatcher, name)
    MADE[key] = dispatcher
    return dispatcher


def kernel(function: Callable[..., Any], inline: bool = True, short: bool = False) -> Any:
    """Compile a step, or a function that steps call.

    Inlined: with a call inside the lane loop the loop stays scalar (measured: 14 ns instead of 6 a lane-step at n = 4).
    With ``inline=False`` the compiler may choose; this is for functions that the lane loop is faster without. One that
    seldom runs is ``short``: called, and compiled for size. Division follows IEEE rules instead of raising, the GIL is
    released, and there is no fast-math.
    """
    inline = inline and not short
    compiled = _compiled(function, short=short, forceinline=inline, **internals.LINKED)
    return internals.as_part(compiled, internals.StepDispatcher, for_constants=inline, short=short)


def shared(function: Callable[..., Any], arrays: bool = False) -> Any:
    """Compile a function of arrays once for all sizes, to be called.

    A step is recompiled for every size of the record. A function that takes views of one lane, as ``s.P[:, :, l]``,
    or arrays at addresses, is compiled once and found on disk after that. By default Numba inlines
    what an inlined function calls too: a bank became one function of 70,000 instructions, on which LLVM spent seven
    times as long. One that makes ``arrays``, for drivers only, says so.
    """
    options = {**internals.LINKED, "_nrt": arrays}
    return internals.as_part(_compiled(function, cache=True, forceinline=False, **options))


def part(function: Callable[..., Any]) -> Any:
    """Compile a function of arrays to be inlined into compiled routines, which know constants and strides.

    Passing a few dozen arrays may cost more than the work on them.
    """
    return internals.as_part(_compiled(function, cache=True, forceinline=True, **internals.LINKED))


def sized(function: Callable[..., Any]) -> Any:
    """The same, of a function whose first argument is a number of parameters: compiled once for each of 2, 3 and 4,
    which the compiler then knows, so that it unrolls loops and keeps their data in registers; and once for all others.
    """
    return _for_sizes(part(function), (2, 3, 4))


def _for_sizes(work: Any, sizes: tuple[int, ...]) -> Any:
    """``work`` with a constant for its first argument if that is one of the sizes."""
    if not sizes:
        return work
    size, others = sizes[0], _for_sizes(work, sizes[1:])
    work.for_constants = True

    @part
    def chosen(n: int, *rest: Any) -> Any:
        if n == size:
            return work(size, *rest)
        return others(n, *rest)

    return chosen


class Machine(types.ExternalFunction):
    """A routine that steps call by its symbol, with addresses and numbers: compiled once for all drivers.

    An ordinary function that a driver calls is linked into it and optimised again for every type of record. A machine
    is compiled apart; drivers on disk know its name only, and `load` gives that an address in this process.
    """

    identity: str
    short: bool

    @property
    def key(self) -> str:
        """By which Numba compares types: the symbol alone, since hashing the signature too takes 5 us."""
        return self.symbol  # type: ignore[no-any-return]

    @property
    def dispatcher(self) -> Any:
        """The compiled function behind it."""
        return _DISPATCHERS[self.symbol]

    @property
    def py_func(self) -> Any:
        """The Python function that it was made of."""
        return self.dispatcher.py_func

    def __reduce__(self) -> Any:
        """By its name: Numba pickles the globals of a step into the key of its cache, and numbers types by process."""
        return _machine, (self.symbol,)

    def load(self) -> None:
        """Compile the machine, or find it on disk, and let drivers find it."""
        if self.symbol not in _LOADED:
            with internals.compiler_lock:  # of two threads that need it one compiles
                if self.symbol not in _LOADED:
                    with compiling():
                        kinds = self.sig.args
                        _LOADED[self.symbol] = internals.publish(self.dispatcher, kinds, self.symbol, self.short)
                    internals.forget(KEPT)


register_model(Machine)(models.OpaqueModel)
_MACHINES: dict[str, Machine] = {}
_DISPATCHERS: dict[str, Any] = {}
_LOADED: dict[str, Any] = {}
"""The owners of the code, without which it would be freed."""


def _machine(symbol: str) -> Machine:
    return _MACHINES[symbol]


def machine(function: Callable[..., Any], short: bool = False) -> Machine:
    """Make a machine of a function of addresses, whole numbers, and arguments annotated as float.

    With ``short`` it is compiled for size, with all that it calls: in half the time, and as fast where loops are short.
    """
    assert isinstance(function, FunctionType)
    dispatcher = _compiled(function, cache=True, short=short, no_cpython_wrapper=True)
    symbol = f"driftfit_{function.__name__}_{dispatcher.identity[:32]}"
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    kinds = [types.float64 if function.__annotations__.get(name) == "float" else types.intp for name in names]
    made = Machine(symbol, types.void(*kinds))
    made.identity, made.short = dispatcher.identity, short
    _DISPATCHERS[symbol] = dispatcher
    _MACHINES[symbol] = made
    return made


class Driver:
    """A function that Python calls with arrays and numbers: compiled, and kept on disk, once for every signature.

    Entry points that were not used for long are let go, and their memory with them, when a process has many
    (`MOST_ENTRIES`); one that is needed again comes back from disk in milliseconds.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        assert isinstance(function, FunctionType)
        self.function = function
        self._identity = identity(function)
        self._entries: dict[Any, Any] = {}

    def __call__(self, *given: Any) -> Any:
        """Run on arrays and numbers. Whether arrays are read-only is not part of the signature."""
        try:
            kind: Any = tuple(map(_KIND, given))
        except AttributeError:  # numbers, and tuples of arrays
            kind = tuple(map(_kind, given))
        return self.of_kind(kind, given)

    def of_kind(self, kind: Any, given: tuple[Any, ...]) -> Any:
        """The same where the caller knows what decides the signature, and has no need to ask every array."""
        found = self._entries.get(kind)
        if found is None:  # the compiler's own types take half a millisecond to make and compare
            found = self._entries[kind] = self.entry(*(_type(a) for a in given))
        _entries.used(found, self)
        return found(*given)

    def entry(self, *arguments: types.Type) -> Any:
        """The compiled entry point for one signature.

        Calling it skips the dispatcher, which looks at the type of every argument at every call (300 ns, and 2 us for
        arrays of records); it does not check anything, so the caller must.
        """
        found = self._entries.get(arguments)
        if found is None:
            with internals.compiler_lock:  # of two threads that need it one compiles
                found = self._entries.get(arguments) or self._made(arguments)
                self._entries[arguments] = found
        _entries.used(found, self)
        return found

    def _made(self, arguments: tuple[types.Type, ...]) -> Any:
        """From disk, or from the compiler."""
        name = disk_cache.name_of(self.function.__name__, self._identity, arguments)
        stored = disk_cache.read(name)
        code = None if stored is None else internals.Code(*stored)
        outside = code and called_by(code)
        if code is None or outside is None:
            code = object_code(self.function, name, arguments)
            outside = called_by(code)
            internals.forget(KEPT)
        assert outside is not None
        return internals.load(code, outside)

    def let_go(self, found: Any) -> None:
        """Forget an entry point; whoever holds it may continue to use it."""
        self._entries = {key: one for key, one in self._entries.items() if one is not found}


_KIND = attrgetter("dtype", "ndim", "flags.num")
"""Properties of an array on which the compiler's type depends, and more: asked for together they take half the time.
Numbers of NumPy have them too; no driver takes arrays without axes, with which they could be confused."""


def _kind(value: Any) -> Any:
    inner = value if isinstance(value, tuple) else ()
    return _KIND(value) if isinstance(value, np.ndarray) else (type(value), *map(_kind, inner))


def _type(value: Any) -> types.Type:
    kind = numba.typeof(value)
    return kind.copy(readonly=False) if isinstance(kind, types.Array) else kind


MOST_ENTRIES = 256
"""Entry points of drivers that a process keeps, of some 0.3 MB each."""

KEPT = 300
"""Parts whose code is kept for later drivers, of some 0.2 MB each; a driver inlines some twenty to sixty, and the
same ones for a record, a smoother and a stream. More of them make sense where a process compiles many configurations in
turn.
"""


class _Entries:
    """Entry points of all drivers, those used last at the end."""

    def __init__(self) -> None:
        self._owners: OrderedDict[Any, ref[Driver]] = OrderedDict()
        self._last: Any = None
        self.lock = Lock()

    def used(self, entry: Any, owner: Driver) -> None:
        """Mark an entry point as used, and release the least recently used ones."""
        if entry is self._last:
            return
        with self.lock:
            self._last = entry
            self._owners.setdefault(entry, ref(owner))
            self._owners.move_to_end(entry)
            while len(self._owners) > MOST_ENTRIES:
                old, place = self._owners.popitem(last=False)
                holder = place()
                if holder is not None:
                    holder.let_go(old)


_entries = _Entries()

_LOCKS = (internals.compiler_lock, _entries.lock, compile_notice.lock)
"""In the order in which they are taken."""


def _acquire_locks() -> None:
    for lock in _LOCKS:
        lock.acquire()


def _release_locks() -> None:
    for lock in reversed(_LOCKS):
        lock.release()


if hasattr(os, "register_at_fork"):  # a child process has no thread that would release its parent's locks
    os.register_at_fork(before=_acquire_locks, after_in_parent=_release_locks, after_in_child=_release_locks)

floats = internals.array_of("floats", 2, types.float64)
"""floats(address, rows, columns): the array (rows, columns) of floats that begins at an address."""
cubes = internals.array_of("cubes", 3, types.float64)
"""cubes(address, rows, columns, lanes): the array (rows, columns, lanes) of floats that begins at an address."""
wholes = internals.array_of("wholes", 2, types.int64)
"""wholes(address, rows, columns): the array (rows, columns) of whole numbers that begins at an address."""


def _in_a_row(context: Any, numbers: Any) -> Any:
    """The typed half of `packed`."""
    word, index = internals.ir.IntType(64), internals.ir.IntType(32)

    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        with builder.goto_entry_block():
            place = builder.alloca(internals.ir.ArrayType(word, len(numbers)))
        for k, kind in enumerate(numbers):
            value = context.cast(builder, builder.extract_value(given[0], k), kind, types.intp)
            builder.store(value, builder.gep(place, [index(0), index(k)], inbounds=True))
        return builder.ptrtoint(place, word)

    return types.intp(numbers), build


packed = internals.named_intrinsic("packed", _in_a_row)
"""packed((a, b, ..)): the address of these whole numbers, which ``wholes(address, 1, count)`` reads in the routine.

It holds until the function that packs them returns, so the routine must be called in the same function.
"""


@kernel
def nothing(s: State, l: int) -> None:
    """The step that changes nothing."""


LOG2 = 0.6931471805599453
LOG2_HIGH = 0.6931471803691238  # ln 2 with its last 32 bits zero, so that k * LOG2_HIGH is exact
LOG2_LOW = 1.9082149292705877e-10
ROUND = 6755399441055744.0  # 1.5 * 2^52: adding and subtracting it rounds to a whole number without a call
EXP = tuple(1.0 / math.factorial(i) for i in range(14))
ARTANH = tuple(1.0 / i for i in range(1, 24, 2))


@kernel
def exp(x: float) -> float:
    """e^x within 2 ulp, the same bits at every lane width (a vectorised library exp differs from the scalar one).

    x = k ln 2 + r with |r| <= ln 2 / 2, then the Taylor series of e^r to r^13 and 2^k through the exponent bits.
    Arguments are held within [-708, 709]. Terms are added in pairs, fours and eights: one after the other they would be
    a chain of twenty-six operations of which each waits for the last.
    """
    x = min(709.0, max(-708.0, x))
    k = (x * (1.0 / LOG2) + ROUND) - ROUND
    r = (x - k * LOG2_HIGH) - k * LOG2_LOW
    r2 = r * r
    r4 = r2 * r2
    low = (EXP[4] + EXP[5] * r) + (EXP[6] + EXP[7] * r) * r2
    high = ((EXP[8] + EXP[9] * r) + (EXP[10] + EXP[11] * r) * r2) + (EXP[12] + EXP[13] * r) * r4
    total = 1.0 + (r + (r2 * (EXP[2] + EXP[3] * r) + r4 * (low + high * r4)))
    return total * np.int64((np.int64(k) + 1023) << 52).view(np.float64)


@kernel
def log(x: float) -> float:
    """Natural logarithm of a positive normal number within 2 ulp, the same bits at every lane width.

    x = 2^k m with m in [0.7, 1.42); log m = 2 artanh(f), f = (m - 1) / (m + 1), by its series to f^23.
    """
    bits = np.float64(x).view(np.int64)
    k = (bits >> 52) - 1023
    m = np.int64((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    up = m > 1.4142135623730951
    m = 0.5 * m if up else m
    k = k + 1 if up else k
    f = (m - 1.0) / (m + 1.0)
    s = f * f
    s2 = s * s
    s4 = s2 * s2
    low = (ARTANH[4] + ARTANH[5] * s) + (ARTANH[6] + ARTANH[7] * s) * s2
    high = (ARTANH[8] + ARTANH[9] * s) + (ARTANH[10] + ARTANH[11] * s) * s2
    total = 1.0 + (s * ARTANH[1] + (s2 * (ARTANH[2] + ARTANH[3] * s) + s4 * (low + high * s4)))
    return k * LOG2_HIGH + (2.0 * f * total + k * LOG2_LOW)

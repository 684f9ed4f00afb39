"""Lanes: the record that holds a state, the decorator that compiles a step, and the drivers that run steps.

The state of one tile is one NumPy record. Every field has a fixed shape with a trailing lane axis of length L, so that
for n parameters ``theta`` is (n, L) and ``P`` is (n, n, L). A *step* is a function ``step(s, l)`` that works on lane
``l`` of the record ``s`` and returns nothing; L = 1 is a stream or a record, L = 32 is thirty-two series side by side.
Shapes belong to the type of the record, so loops over parameters have bounds that the compiler knows.

Nothing here uses fast-math, so a step gives the same bits at every width. `driftfit.engine.drivers` holds the loop
that runs the steps.
"""

from __future__ import annotations

import dis
import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from threading import Lock, RLock
from types import CellType, CodeType, FunctionType
from typing import Any
from weakref import ref

import numba
import numpy as np
import numpy.typing as npt
from llvmlite.binding import add_symbol
from numba import carray, njit, types
from numba.core import cgutils
from numba.core.datamodel import models, register_default
from numba.extending import intrinsic

from driftfit.engine import disk_cache
from driftfit.engine.compile_notice import compiling
from driftfit.engine.linking import StepDispatcher, only_linked
from driftfit.engine.machine_code import Code, compiled, loaded

Array = npt.NDArray[Any]
State = Any
"""A record of lanes as a kernel sees it: fields as attributes, each an array whose last axis is the lane."""

Step = Callable[[State, int], None]
"""A compiled step, called with the record and a lane."""


def identity(function: FunctionType) -> str:
    """A name for a function that changes when its code, or anything that it uses, changes.

    Numba's cache looks at the time stamp of the one file that holds the driver; steps live in other files. Giving every
    step an identity made of its code and the identities of what it refers to lets drivers that are closures over steps
    be found on disk by a second process, and recompiles them when a step was edited. The code is what was compiled, not
    its text: the file may have been edited since it was imported, and at a prompt there is none.
    """
    names = _globals(function.__code__) & function.__globals__.keys()
    used = {name: function.__globals__[name] for name in names}
    used |= dict(zip(function.__code__.co_freevars, (c.cell_contents for c in function.__closure__ or ()), strict=True))
    used |= {"defaults": (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).items())}
    parts = [function.__module__, function.__qualname__, _code(function.__code__)]
    parts += [f"{name}={_identity_of(value, function, name)}" for name, value in sorted(used.items())]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _globals(code: CodeType) -> set[str]:
    """Global names that code reads, also in the functions and comprehensions inside it; not those of attributes."""
    names = {i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}
    return names.union(*(_globals(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def _code(code: CodeType) -> str:
    """What code does, without the places where its text stands."""
    constants = [_code(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return repr((code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars))


def _identity_of(value: Any, function: FunctionType, name: str) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(_identity_of(v, function, name) for v in value)})"
    if value is carray:
        return "carray"
    if value is np or value is math:  # what hangs on any other module may be edited unseen
        return str(value.__name__)
    if isinstance(value, bool | int | float | str | type(None) | np.generic):
        return repr(value)
    if isinstance(value, np.ndarray):  # a constant to the compiler
        return f"{value.dtype}{value.shape}{value.tobytes().hex()}"
    if hasattr(value, "identity"):
        return str(value.identity)
    raise TypeError(
        f"the kernel {function.__qualname__} uses {name!r}, a {type(value).__name__}; a kernel may use numpy, math, "
        "numbers, strings, tuples of these, and other kernels, each imported by its own name. Pass anything else "
        "through a field of the record."
    )


def _compiled(function: Callable[..., Any], cache: bool = False, **options: bool) -> Any:
    """Compile under IEEE rules and without the GIL; the cache on disk and `identity` know it by what it does."""
    assert isinstance(function, FunctionType)
    name = hashlib.sha256(f"{identity(function)}{sorted(options)}".encode()).hexdigest()
    if cache:
        source = function
        defaults, closure = source.__defaults__, source.__closure__
        function = FunctionType(source.__code__, source.__globals__, source.__name__, defaults, closure)
        function.__qualname__, function.__doc__ = f"{source.__name__}_{name[:16]}", source.__doc__
    dispatcher = njit(error_model="numpy", nogil=True, **options)(function)
    if cache:
        dispatcher._cache = disk_cache.Kept(function.__name__, name)
    dispatcher.identity = name
    dispatcher._set_uuid(name)
    dispatcher.again = lambda other: _compiled(other, cache, **options)
    return dispatcher


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a step, or a function that steps call.

    Always inlined: with a call inside the lane loop the loop stays scalar (measured: 14 ns instead of 6 a lane-step at
    n = 4). Division follows IEEE rules instead of raising, the GIL is released, and there is no fast-math.
    """
    return only_linked(_compiled(function, forceinline=True, no_cfunc_wrapper=True), StepDispatcher)


def shared(function: Callable[..., Any]) -> Any:
    """Compile a function of one lane's arrays once for all sizes, for what runs seldom.

    A step is compiled anew for every size of the record. A function that takes views of one lane, as ``s.P[:, :, l]``,
    is compiled once and found on disk after that.
    """
    return _compiled(function, cache=True, no_cfunc_wrapper=True)


_PLAIN = {"no_cfunc_wrapper": True, "no_cpython_wrapper": True, "_nrt": False}


def core(function: Callable[..., Any]) -> Any:
    """Compile a part of a machine that works on plain arrays with run-time bounds, once for all sizes.

    As `shared`, without what compiled code needs to be called from Python or to own memory: reference counts of slices
    and wrappers took nine tenths of the time of compiling a large machine. It may not allocate. It is called, and not
    inlined also where what calls it is: a large machine would become one function, on which LLVM spends seven times as
    long.
    """
    made = only_linked(_compiled(function, cache=True, **_PLAIN, forceinline=False))
    made.again = core
    return made


def part(function: Callable[..., Any]) -> Any:
    """Compile a part of a machine, as `core`, to be inlined into what calls it, which knows constants and strides.

    Passing a few dozen arrays may cost more than the work on them.
    """
    made = only_linked(_compiled(function, cache=True, forceinline=True, **_PLAIN))
    made.again = part
    return made


def sized(function: Callable[..., Any]) -> Any:
    """Compile a part of a machine whose first argument is a number of parameters: once for each of two, three and four,
    which the compiler then knows, so that it unrolls loops and keeps what they work on in registers; and once for all.
    """
    work = part(function)

    @part
    def chosen(n: int, *rest: Any) -> Any:
        if n == 2:
            return work(2, *rest)
        if n == 3:
            return work(3, *rest)
        if n == 4:
            return work(4, *rest)
        return work(n, *rest)

    return chosen


class Outside(types.ExternalFunction):
    """A machine that steps call by its symbol, with addresses and numbers: compiled once for all drivers.

    What a driver calls in the ordinary way is linked into it and optimised again for every type of record. A machine is
    compiled apart; drivers on disk know its name only, and `load` gives that an address in this process.
    """

    identity: str

    @property
    def py_func(self) -> Any:
        """The Python function that it was made of."""
        return _OUTSIDE[self.symbol].py_func

    def __reduce__(self) -> Any:
        """By its name: Numba pickles what a step uses into the key of its cache, and numbers types by process."""
        return _machine, (self.symbol,)

    def load(self) -> None:
        """Compile the machine, or find it on disk, and let drivers find it."""
        if self.symbol not in _LOADED:
            dispatcher = _OUTSIDE[self.symbol]
            with compiling():
                dispatcher.compile(self.sig.args)
            owner, described = attrgetter("library", "fndesc")(next(iter(dispatcher.overloads.values())))
            _LOADED[self.symbol] = owner  # of the code, which would go with it
            add_symbol(self.symbol, owner.get_pointer_to_function(described.llvm_cfunc_wrapper_name))


register_default(Outside)(models.OpaqueModel)
_MACHINES: dict[str, Outside] = {}
_OUTSIDE: dict[str, Any] = {}
_LOADED: dict[str, Any] = {}


def _machine(symbol: str) -> Outside:
    return _MACHINES[symbol]


def outside(function: Callable[..., Any]) -> Outside:
    """Make a machine of a function of addresses, whole numbers, and arguments annotated as float."""
    assert isinstance(function, FunctionType)
    dispatcher = _compiled(function, cache=True)
    symbol = f"driftfit_{function.__name__}_{dispatcher.identity[:32]}"
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    kinds = [types.float64 if function.__annotations__.get(name) == "float" else types.intp for name in names]
    machine = Outside(symbol, types.void(*kinds))
    machine.identity = dispatcher.identity
    _OUTSIDE[symbol] = dispatcher
    _MACHINES[symbol] = machine
    return machine


def exchanged(functions: Sequence[Any], others: Mapping[Any, Any]) -> tuple[Any, ...]:
    """Compiled functions, or machines, made anew with other functions in the place of some that they call.

    ``others`` says what takes whose place, also where it is called through others. So a second form of a machine is the
    first with some parts exchanged, and is compiled only where it is asked for.

    Raises
    ------
    ValueError
        If something whose place is taken is called nowhere.
    """
    found = {id(old): (old, new, new is old) for old, new in others.items()}
    made = tuple(_again(function, found) for function in functions)
    unused = [old.__name__ for old, new, asked in (found[id(old)] for old in others) if not asked]
    if unused:
        raise ValueError(f"exchanged: nothing calls {', '.join(unused)}.")
    return made


def _again(value: Any, found: dict[int, tuple[Any, Any, bool]]) -> Any:
    if id(value) not in found:
        found[id(value)] = value, _rebuilt(value, found), True
    old, new, _ = found[id(value)]
    found[id(value)] = old, new, True
    return new


def _rebuilt(value: Any, found: dict[int, tuple[Any, Any, bool]]) -> Any:
    """The function itself where nothing in it is exchanged."""
    inner = _OUTSIDE[value.symbol] if isinstance(value, Outside) else value
    if not hasattr(inner, "again"):
        return value
    source = inner.py_func
    used = {name: source.__globals__[name] for name in _globals(source.__code__) & source.__globals__.keys()}
    new = {name: _again(one, found) for name, one in used.items()}
    held = [cell.cell_contents for cell in source.__closure__ or ()]
    hold = [_again(one, found) for one in held]
    if all(new[name] is one for name, one in used.items()) and all(a is b for a, b in zip(held, hold, strict=True)):
        return value
    names, closure = source.__globals__ | new, tuple(CellType(one) for one in hold) or None
    made = FunctionType(source.__code__, names, source.__name__, source.__defaults__, closure)
    return outside(made) if isinstance(value, Outside) else inner.again(made)


@intrinsic
def _pointer(context: Any, address: Any) -> Any:
    """An address as a pointer."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.intp), build


_pointer.identity = "pointer"
_pointer._set_uuid("pointer")  # Numba would give it a new one in every process, and never find its callers on disk


def routine(function: Callable[..., Any]) -> Any:
    """Compile a part of a step that the lane loop is better without: it may be called instead of inlined."""
    return only_linked(_compiled(function, no_cfunc_wrapper=True), StepDispatcher)


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
        kind = tuple(_kind(a) for a in given)
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
            with _compiler:  # of two threads that need it one compiles
                found = self._entries.get(arguments) or self._made(arguments)
                self._entries[arguments] = found
        _entries.used(found, self)
        return found

    def _made(self, arguments: tuple[types.Type, ...]) -> Any:
        """From disk, or from the compiler."""
        source = self.function
        name = disk_cache.name_of(source.__name__, self._identity, arguments)
        code = disk_cache.read(name)
        if code is None:
            twin = FunctionType(source.__code__, source.__globals__, source.__name__, None, source.__closure__)
            twin.__qualname__ = name.removesuffix(disk_cache.ENDING).replace("-", "_")
            with compiling():
                code = compiled(twin, arguments)
            if code.lasting:
                disk_cache.write(name, tuple(code))
        return loaded(Code(*code))

    def let_go(self, found: Any) -> None:
        """Forget an entry point; who holds it may go on using it."""
        self._entries = {key: one for key, one in self._entries.items() if one is not found}


LAYOUT = 0x0001 | 0x0002 | 0x0100
"""NumPy's flags of what the compiler's type of an array knows: rows contiguous, columns contiguous, aligned."""


def _kind(value: Any) -> Any:
    """What the type of an argument depends on."""
    if not isinstance(value, np.ndarray):
        return type(value)
    return value.dtype, value.ndim, value.flags.num & LAYOUT


def _type(value: Any) -> types.Type:
    kind = numba.typeof(value)
    return kind.copy(readonly=False) if isinstance(kind, types.Array) else kind


MOST_ENTRIES = 256
"""Entry points of drivers that a process keeps, of some 0.3 MB each."""


class _Entries:
    """Entry points of all drivers, those used last at the end."""

    def __init__(self) -> None:
        self._owners: OrderedDict[Any, ref[Driver]] = OrderedDict()
        self._lock = Lock()

    def used(self, entry: Any, owner: Driver) -> None:
        """Note that an entry point is in use, and let go of those that were not for longest."""
        with self._lock:
            self._owners.setdefault(entry, ref(owner))
            self._owners.move_to_end(entry)
            while len(self._owners) > MOST_ENTRIES:
                old, place = self._owners.popitem(last=False)
                holder = place()
                if holder is not None:
                    holder.let_go(old)


_entries = _Entries()
_compiler = RLock()


@kernel
def floats(address: int, rows: int, columns: int) -> Any:
    """The array (rows, columns) of floats that begins at an address."""
    return carray(_pointer(address), (rows, columns), np.float64)


@kernel
def cubes(address: int, rows: int, columns: int, lanes: int) -> Any:
    """The array (rows, columns, lanes) of floats that begins at an address."""
    return carray(_pointer(address), (rows, columns, lanes), np.float64)


@kernel
def wholes(address: int, rows: int, columns: int) -> Any:
    """The array (rows, columns) of whole numbers that begins at an address."""
    return carray(_pointer(address), (rows, columns), np.int64)


@kernel
def nothing(s: State, l: int) -> None:
    """The step that leaves the record alone."""


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

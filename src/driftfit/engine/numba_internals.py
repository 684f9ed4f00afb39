"""What uses private parts of Numba and llvmlite. Only this module and the folder `compile_time` import them.

Each section names the private parts that it uses, and the reason. `tests/contract/test_numba_internals.py` has a canary
for each, which names in one sentence what broke. Tried with the versions in `TRIED`.

    lock           numba.core.compiler_lock         one lock for all that compiles, so that threads cannot mix
    identity       Dispatcher._set_uuid             other processes find closures over compiled functions
    stored         Dispatcher._cache,               one file for each function and signature, without Numba's index
                   CompileResult._reduce, _rebuild
    code to link   JITCodeLibrary, CPUDispatcher,   a part is typed and turned into LLVM's language only, not emitted;
                   get_call_template, codegen's     one copy serves all constants
                   factories
    memory         _reset_overloads,                what the compiler made of a part is let go
                   remove_user_function, _dispose
    object code    codegen._tm, llvmlite's ORC,     drivers are kept as object code and freed with the last reference
                   numba._dynfunc, environments
    symbols        llvm_cfunc_wrapper, call_conv   machines and outlined steps are called by name
    arrays         make_array, populate_array      an array at an address without reference counts
    fields         AttributeTemplate                fields of a table by name; see `driftfit.bank.table`
    vectors        llvmlite.ir                      instructions on SIMD vectors; see `driftfit.engine.simd`

Public means (`numba.njit`, `numba.extending`) serve for types, intrinsics, data models, options and the passes.
"""

from __future__ import annotations

import ctypes
import itertools
import sys
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import cache
from importlib.metadata import version
from types import FunctionType, MappingProxyType
from typing import Any, NamedTuple
from weakref import ref

import llvmlite.binding as llvm
import numba
from numba import _dynfunc, njit, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import lookup_environment
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.extending import intrinsic

from driftfit.engine.compile_time.lookups import cpu_target, known_once, replaced
from driftfit.engine.compile_time.lowering import Pipeline
from driftfit.engine.compile_time.open_record import (
    WORD,
    AttributeTemplate,
    OpenRecord,
    array_from,
    entry_of,
    ir,
    opened,
)

__all__ = ["WORD", "AttributeTemplate", "OpenRecord", "dumps", "entry_of", "ir", "opened"]

TRIED = {
    "numba": ("0.66.0", "0.67.0", "0.68.0", "0.68.1"),
    "llvmlite": ("0.48.0", "0.49.0", "0.50.0"),
}
"""Versions with which the canary tests passed."""


# ---- lock -----------------------------------------------------------------------------------------------------------

compiler_lock = global_compiler_lock
"""Held by whoever compiles. It is Numba's own: with a second lock, a thread that compiles a user's function which calls
ours, and one that compiles ours, would take the two in opposite orders."""


# ---- identity -------------------------------------------------------------------------------------------------------


def name_for_pickle(compiled: Any, name: str) -> None:
    """Give a compiled function or an intrinsic a name that is the same in every process.

    Numba numbers functions at random in each process, and the number is part of all that refers to them.
    """
    compiled.identity = name
    compiled._set_uuid(name)


# ---- compile options ------------------------------------------------------------------------------------------------

LINKED = {"no_cfunc_wrapper": True, "no_cpython_wrapper": True, "_nrt": False}
"""Options of code that only compiled code calls. It makes no arrays, so it needs no reference counts, which took nine
tenths of the time of compiling a bank."""


def under_ieee(function: Callable[..., Any], **options: bool) -> Any:
    """Compile with IEEE 754 division, without fast-math, and without the GIL."""
    return njit(error_model="numpy", nogil=True, pipeline_class=Pipeline, **options)(function)


# ---- stored ---------------------------------------------------------------------------------------------------------


def target() -> str:
    """The versions on which code depends, and the processor for which it is generated."""
    processor = cpu_target.target_context.codegen().magic_tuple()
    return f"{numba.__version__, version('llvmlite')}{sys.byteorder}{processor}"


class Stored:
    """The cache of a dispatcher: ``read(sig)`` returns stored code, ``write(sig, data)`` stores it."""

    cache_path = ""

    def __init__(self, read: Callable[[Any], Any], write: Callable[[Any, Any], None]) -> None:
        self._read, self._write = read, write

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        target_context.refresh()
        found = self._read(sig)
        return None if found is None else CompileResult._rebuild(target_context, *found)

    def save_overload(self, sig: Any, data: Any) -> None:
        if not data.lifted and not data.library.has_dynamic_globals:
            self._write(sig, data._reduce())

    def enable(self) -> None:
        """Nothing: it is always on, and nothing waits to be written."""

    disable = flush = enable


def store_by(dispatcher: Any, read: Callable[[Any], Any], write: Callable[[Any, Any], None]) -> None:
    """Store the code of a dispatcher by ``read`` and ``write``."""
    dispatcher._cache = Stored(read, write)


# ---- code to link ---------------------------------------------------------------------------------------------------


class Routine(JITCodeLibrary):
    """A routine with all that it calls."""

    short = False
    """Whether LLVM is asked for short code: loops are neither unrolled nor given vectorised copies."""

    def _optimize_final_module(self) -> None:
        if self.short:
            _be_short(self._final_module)
        super()._optimize_final_module()


class Fragment(Routine):
    """Code that other functions inline: neither optimised nor emitted; that is done by the function that inlines it."""

    def _optimize_functions(self, module: Any) -> None:
        """Passes over single functions, at one level: what is stored does not depend on who asked for it first."""
        with at_level_two():
            super()._optimize_functions(module)

    def _optimize_final_module(self) -> None:
        """Left to the function that inlines it."""

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """There is no pointer: nothing was emitted."""
        return 0

    serialize_using_object_code = JITCodeLibrary.serialize_using_bitcode  # on disk: there is no object code


class WholeFragment(Fragment):
    """Code that is optimised together with everything that it inlines."""

    _optimize_functions = JITCodeLibrary._optimize_functions
    _optimize_final_module = Routine._optimize_final_module

    def get_pointer_to_function(self, name: str) -> int:
        """None yet; asking for it is how Numba says that nothing more will be added."""
        self._ensure_finalized()
        return 0


class StepFragment(WholeFragment):
    """A step that inlines no other step is optimised: the speed of a loop over lanes depends on it (5 %). One that
    inlines others is optimised with the driver: at every level it took a quarter of the time, for no faster code.

    A short step is called, and only its own code is short.
    """

    def _optimize_functions(self, module: Any) -> None:
        if self.short:
            _be_short(module, "noinline", "cold")
        super()._optimize_functions(module)

    def _optimize_final_module(self) -> None:
        if not any(isinstance(one, StepFragment) for one in self._linking_libraries):
            JITCodeLibrary._optimize_final_module(self)


def _be_short(module: Any, *more: str) -> None:
    """Ask for short code of all functions of a module."""
    for one in module.functions:
        if not one.is_declaration:
            for attribute in ("optsize", *more):
                one.add_function_attribute(attribute)


class PartDispatcher(CPUDispatcher):
    """A function that Numba compiles so that others inline it."""

    library: type[Fragment] = Fragment
    short = False

    for_constants = False
    """Whether constants are part of the types of a call. Numba would compile a copy for 0 and one for other numbers."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        if not self.for_constants:
            args = [one.literal_type if isinstance(one, types.Literal) else one for one in args]
        return super().get_call_template(args, kws)

    def __call__(self, *arguments: Any) -> Any:
        raise TypeError(
            f"{self.py_func.__qualname__} is a part of a compiled routine, which has no code of its own; to see what "
            "it does from Python call its py_func."
        )

    def compile(self, signature: Any) -> Any:
        """The types and code of one signature."""
        with compiler_lock, _library_of(self.py_func.__qualname__, self.library, self.short):
            made = super().compile(signature)
            _note_use(self, signature)
        return made


class StepDispatcher(PartDispatcher):
    """A step: inlined by drivers; for Python it is compiled again, into code that can be called."""

    library = StepFragment
    for_constants = True

    def __call__(self, *arguments: Any) -> Any:
        if "callable" not in vars(self):
            self.callable = under_ieee(self.py_func)
        return self.callable(*arguments)


def as_part(dispatcher: Any, kind: type[PartDispatcher] = PartDispatcher, **settings: Any) -> Any:
    """Make a function that Numba compiles only linkable into others, with settings of a `PartDispatcher`."""
    dispatcher.__class__ = kind
    vars(dispatcher).update(settings)
    return dispatcher


@contextmanager
def _library_of(name: str, kind: type[Routine], short: bool) -> Iterator[None]:
    """Within it, what is compiled under this name is of this kind; where they are nested, the inner one applies.

    Only for whoever holds `compiler_lock`: Numba's factories are replaced for all threads.
    """
    codegen = cpu_target.target_context.codegen()
    create, restore, set_env = codegen.create_library, codegen.unserialize_library, codegen.set_env

    def create_fragment(called: str, **options: Any) -> Any:
        if called != name:
            return create(called, **options)
        made = kind(codegen, called, **options)
        made.short = short
        return made

    def restore_fragment(stored: Any) -> Any:
        return kind._unserialize(codegen, stored) if stored[0] == name else restore(stored)

    def set_env_of_emitted(env_name: str, env: Any) -> None:
        if codegen._engine.is_symbol_defined(env_name):
            set_env(env_name, env)

    with (
        known_once(),
        replaced(
            codegen, create_library=create_fragment, unserialize_library=restore_fragment, set_env=set_env_of_emitted
        ),
    ):
        yield


@contextmanager
def at_level_two() -> Iterator[None]:
    """While it lasts, LLVM optimises at its second level at most, which is for long code: the third takes longer and
    made an `AdaptiveKalman` a quarter slower. Lanes of a short step need the third.
    """
    codegen = cpu_target.target_context.codegen()
    build, level = codegen._pass_builder, min(2, numba.config.OPT)
    with replaced(codegen, _pass_builder=lambda **options: build(**{"opt": level, **options})):
        yield


# ---- memory ---------------------------------------------------------------------------------------------------------

# llvmlite 0.50 frees no pass manager: both classes inherit the `_dispose` that does nothing. They were three fifths of
# all memory that a compilation left behind. Builders of passes leave 2 kB each; they must not be kept for a second run
# though: every run adds observers to its builder that end with the run, and each of them delays all later passes.
passes = llvm.newpassmanagers
for _manager in (passes.ModulePassManager, passes.FunctionPassManager):
    if _manager._dispose is passes.ffi.ObjectRef._dispose:
        _manager._dispose = passes.NewPassManager._dispose

_recent: OrderedDict[Any, None] = OrderedDict()
"""(dispatcher, types of arguments) of functions that were compiled only to be linked, the most recently used last."""


def _note_use(dispatcher: Any, signature: Any) -> None:
    key = ref(dispatcher), tuple(getattr(signature, "args", signature))
    _recent[key] = None
    _recent.move_to_end(key)


def forget(most: int) -> None:
    """Release all but the ``most`` recently used parts, while nothing is compiled that may inline them."""
    while len(_recent) > most:
        (place, arguments), _ = _recent.popitem(last=False)
        dispatcher = place()
        if dispatcher is not None and arguments in dispatcher.overloads:
            dispatcher.targetctx.remove_user_function(dispatcher.overloads.pop(arguments).entry_point)
            rest = list(dispatcher.overloads.values())
            dispatcher._reset_overloads()  # the table in C, which has no way to drop one of its rows
            for one in rest:
                dispatcher.add_overload(one)


# ---- object code ----------------------------------------------------------------------------------------------------

ENVIRONMENT = "_ZN08NumbaEnv"
"""Beginning of the names of the variables through which compiled code finds the environment of a function."""

OWN_ADDRESSES = "numba.dynamic.globals"
"""Beginning of the names of variables that hold addresses of this process."""


class Code(NamedTuple):
    """A compiled function that Python or other code calls, as stored on disk."""

    data: bytes
    """Object code."""
    module: str
    name: str
    entry: str
    """Symbol of the function that is called."""
    outside: tuple[str, ...]
    """Symbols that it calls and does not define."""
    environments: tuple[tuple[str, Any], ...]
    """Symbols of environments, its own first, and the environments."""
    lasting: bool
    """Whether it is valid in another process."""


def emit(function: FunctionType, arguments: tuple[Any, ...], from_python: bool = True, short: bool = False) -> Code:
    """Compile a function for one signature, with all that it inlines, to object code; ``short``: for size."""
    with compiler_lock, nullcontext() if from_python else at_level_two():
        options = {"no_cfunc_wrapper": True, "no_cpython_wrapper": not from_python}
        dispatcher = as_part(under_ieee(function, **options), library=WholeFragment, short=short)
        dispatcher.compile(arguments)
        made = dispatcher.overloads[arguments]
        module = made.library._final_module
        variables = [v.name for v in module.global_variables if not v.is_declaration]
        own = cpu_target.target_context.get_env_name(made.fndesc)
        names = [own, *(name for name in variables if name.startswith(ENVIRONMENT) and name != own)]
        environments = {name: lookup_environment(name) for name in names if name in variables}
        absent = [f.name for f in (*module.functions, *module.global_variables) if f.is_declaration]
        entry = made.fndesc.llvm_cpython_wrapper_name if from_python else made.fndesc.llvm_func_name
        return Code(
            made.library.codegen._tm.emit_object(module), made.fndesc.modname, function.__name__, entry,
            tuple(name for name in absent if not name.startswith("llvm.")),
            ((own, made.environment), *((name, env) for name, env in environments.items() if name != own and env)),
            all(env is None or env.can_cache() for env in environments.values())
            and not any(name.startswith(OWN_ADDRESSES) for name in variables),
        )  # fmt: skip


class Linked:
    """Code in this process, at ``address``. Numba's loader never frees anything; this one does with the last reference.

    ``outside`` is the linked code that it calls, by symbol.
    """

    def __init__(self, code: Code, outside: Mapping[str, Linked] = MappingProxyType({})) -> None:
        library = llvm.JITLibraryBuilder().add_object_img(code.data).add_current_process().export_symbol(code.entry)
        loader = _loader()
        for name in code.outside:
            address = outside[name].address if name in outside else llvm.address_of_symbol(name)
            if address is not None:
                library.import_symbol(name, address)
        for name, _ in code.environments:
            library.export_symbol(name)
        tracker = library.link(loader, f"driftfit{next(_numbers)}")
        for name, environment in code.environments:
            ctypes.c_void_p.from_address(tracker[name]).value = id(environment)
        self._kept = tracker, dict(outside), code.environments
        self.address: int = tracker[code.entry]


def load(code: Code, outside: Mapping[str, Linked] = MappingProxyType({})) -> Any:
    """The entry point of code for Python."""
    made, module, own = Linked(code, outside), sys.modules.get(code.module), code.environments[0][1]
    return _dynfunc.make_function(module, code.name, code.name, made.address, own, (made,))


_numbers = itertools.count()


@cache
def _loader() -> Any:
    """The loader; after this, Numba's own functions that compiled code calls are available."""
    cpu_target.target_context.refresh()
    rtsys.initialize(cpu_target.target_context)
    return llvm.create_lljit_compiler()


# ---- symbols --------------------------------------------------------------------------------------------------------


def publish(dispatcher: Any, arguments: tuple[Any, ...], symbol: str, short: bool) -> Any:
    """Compile a function, or find it on disk, and let code call it by a symbol; returns the owner of the code."""
    with compiler_lock, _library_of(dispatcher.py_func.__qualname__, Routine, short), at_level_two():
        dispatcher.compile(arguments)
    made = next(iter(dispatcher.overloads.values()))
    llvm.add_symbol(symbol, made.library.get_pointer_to_function(made.fndesc.llvm_cfunc_wrapper_name))
    return made.library


def call(context: Any, builder: Any, symbol: str, arguments: tuple[Any, ...], given: Any) -> Any:
    """Call a function that returns nothing by its symbol, as Numba's functions call each other."""
    rules, known = context.call_conv, builder.module.globals
    called = known.get(symbol) or ir.Function(builder.module, rules.get_function_type(types.none, arguments), symbol)
    rules.call_function(builder, called, types.none, arguments, given)
    return context.get_dummy_value()


# ---- arrays ---------------------------------------------------------------------------------------------------------


def array_at(context: Any, builder: Any, array: Any, address: Any, shape: Any) -> Any:
    """The C array of a type and shape that begins at an address, while code is built."""
    data = builder.inttoptr(address, context.get_data_type(array.dtype).as_pointer())
    return array_from(context, builder, array, data, shape)


def array_of(name: str, axes: int, dtype: Any) -> Any:
    """An intrinsic ``f(address, rows, columns)`` or ``f(address, rows, columns, lanes)``: the C array at an address.

    `numba.carray` does the same with two additional functions for every caller, and counts references.
    """
    array = types.Array(dtype, axes, "C")

    def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return array_at(context, builder, array, given[0], given[1:])

    def matrix(context: Any, address: Any, rows: Any, columns: Any) -> Any:
        return array(*[types.intp] * 3), build

    def cube(context: Any, address: Any, rows: Any, columns: Any, lanes: Any) -> Any:
        return array(*[types.intp] * 4), build

    return named_intrinsic(name, matrix if axes == 2 else cube)


def named_intrinsic(name: str, typed: Any) -> Any:
    """An intrinsic with a name that is the same in every process."""
    made = intrinsic(typed)
    name_for_pickle(made, name)
    return made

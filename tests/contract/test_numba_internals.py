"""Canaries: what the engine leans on inside Numba and llvmlite, one test each, which says what broke.

After an upgrade of Numba run this file first: `pytest -n 0 tests/contract/test_numba_internals.py`.
"""

import gc
import operator
import threading
import weakref
from functools import partial
from pathlib import Path
from types import FunctionType

import numba
import numpy as np
import pytest
from numba import types
from numba.core import postproc
from numba.core.compiler import Flags
from numba.core.registry import cpu_target
from numba.core.typing.templates import AbstractTemplate

from driftfit.engine import kernel
from driftfit.engine import numba_internals as internals
from driftfit.engine.compile_time.lookups import known_once
from driftfit.engine.compile_time.lowering import UNUSED
from driftfit.engine.kernel import Driver, cubes, floats, machine, part, shared, wholes
from driftfit.engine.simd import fill, load, plus, store

SRC = Path(__file__).parents[2] / "src" / "driftfit"
VECTOR = types.Array(types.float64, 1, "C")


pytestmark = pytest.mark.usefixtures("own_cache")


def first(y):
    return y[0]


def test_the_lock_is_the_one_that_numba_compiles_under():
    compiled = numba.njit(first)
    with internals.compiler_lock, internals.compiler_lock:  # it can be taken twice
        other = threading.Thread(target=compiled, args=(np.ones(1),))
        other.start()
        other.join(0.2)
        assert other.is_alive(), "Numba compiles without the lock of numba.core.compiler_lock: threads can mix patches."
    other.join(60.0)
    assert not other.is_alive(), "The lock of numba.core.compiler_lock is not given back."


def test_a_compiled_function_has_the_same_name_in_every_process():
    def named():
        made = internals.under_ieee(FunctionType(first.__code__, {"__name__": __name__, "__builtins__": {}}, "first"))
        internals.name_for_pickle(made, "a name")
        return internals.dumps(made)

    assert named() == named(), "Dispatcher._set_uuid no longer decides how Numba pickles a function."
    assert b"floats" in internals.dumps(floats), "_Intrinsic._set_uuid no longer names an intrinsic."


def test_what_was_stored_is_found_by_another_dispatcher():
    kept, compiled = {}, []

    def dispatcher():
        made = internals.under_ieee(first)
        internals.store_by(made, lambda sig: kept.get(str(sig)), lambda sig, data: kept.update({str(sig): data}))
        return made

    with numba.core.event.install_listener("numba:compile", Count(compiled)):
        assert dispatcher()(np.full(1, 3.0)) == 3.0
        assert (len(kept), len(compiled)) == (1, 1), "Numba does not ask the dispatcher's _cache to save an overload."
        assert dispatcher()(np.full(1, 4.0)) == 4.0
    assert len(compiled) == 1, "CompileResult._reduce and _rebuild, or _Cache.load_overload, no longer restore code."


class Count(numba.core.event.Listener):
    def __init__(self, seen):
        self.seen = seen

    def on_start(self, event):
        self.seen.append(event)

    def on_end(self, event):
        pass


@part
def doubled(y):
    return 2.0 * y[1:][0]


@shared
def added(y):
    return doubled(y) + 1.0


def test_parts_are_linked_and_not_emitted():
    def use(y):
        return added(y)

    codegen = cpu_target.target_context.codegen()
    before = {**vars(codegen)}
    assert Driver(use)(np.array([1.0, 2.0])) == 5.0
    assert vars(codegen) == before, "The codegen's factories are not put back after a compilation."
    (made,) = doubled.overloads.values()
    assert isinstance(made.library, internals.Fragment), "codegen.create_library no longer decides on the library."
    assert not codegen._engine.is_symbol_defined(made.fndesc.llvm_func_name), "Parts are emitted, which takes time."
    assert "NRT_incref" not in made.library.get_llvm_str(), "_nrt=False leaves reference counts in."
    assert "cpython" not in made.library.get_llvm_str(), "no_cpython_wrapper leaves the wrapper in."
    with pytest.raises(TypeError, match="py_func"):
        doubled(np.ones(2))


def test_what_is_seldom_run_and_short_routines_are_compiled_for_size():
    @partial(kernel.kernel, short=True)
    def halved(x):
        return 0.5 * x

    def use(y):
        return halved(y[0])

    def routine(address):
        floats(address, 1, 1)[0, 0] += 1.0

    def code(short):
        made = internals.publish(internals.under_ieee(routine), (types.intp,), f"canary_{short}", short)
        return made.get_llvm_str()

    assert Driver(use)(np.array([1.0, 2.0])) == 0.5
    (made,) = halved.overloads.values()
    assert {"optsize", "noinline", "cold"} <= set(made.library.get_llvm_str().split()), "No attributes: see _be_short."
    assert "optsize" in code(True), "Routine._optimize_final_module is no longer called before LLVM's passes."
    assert "optsize" not in code(False)


def test_passes_for_what_is_not_used_are_left_out():
    def passes(made):
        made.compile((VECTOR,))
        (times,) = made.overloads[(VECTOR,)].metadata["pipeline_times"].values()
        return {name.split("_", 1)[1] for name in times}

    every, ours = passes(numba.njit(first)), passes(internals.under_ieee(first))
    assert every - ours == UNUSED | {"native_lowering"}, "DefaultPassBuilder or the names of its passes changed."
    assert ours - every == {"direct_lowering"}


def test_lifetimes_of_variables_are_searched_once(monkeypatch):
    def larger(x, y):
        return x if x > y else y

    searched = []
    search = postproc.analysis.compute_dead_maps
    monkeypatch.setattr(postproc.analysis, "compute_dead_maps", lambda *given: searched.append(given) or search(*given))
    internals.emit(larger, (types.float64, types.float64))
    assert len(searched) == 1, (
        "PostProcessor.run is not what analyses a function: a tenth of compiling in Python is lost."
    )
    searched.clear()
    numba.njit(larger).compile((types.float64, types.float64))
    assert len(searched) > 1, "Functions of users are analysed in our way."


def test_declarations_are_looked_for_once_and_put_back():
    context = cpu_target.target_context
    parts = context, context.typing_context, context.codegen()
    before = [{**vars(one)} for one in parts]
    with known_once():
        assert vars(context).keys() > before[0].keys()
        assert context.get_abi_sizeof(context.get_data_type(types.float64)) == 8
        context.refresh()
    assert [vars(one).keys() for one in parts] == [one.keys() for one in before], "Methods are not put back."


def test_instructions_leave_nothing_for_the_garbage_collector():
    def left():
        return sum(issubclass(type(one), internals.ir.Instruction) for one in gc.get_objects())

    gc.collect()
    gc.disable()
    try:
        before = left()
        internals.emit(first, (VECTOR,), from_python=False)
        assert left() <= before + 20, "llvmlite's instructions keep each other until they are searched for."
    finally:
        gc.enable()


def test_operations_are_typed_once(monkeypatch):
    def total(y, i):
        return y[i] + y[i] * y[i]

    def other(y, i):
        return y[i] * y[i] + y[i]

    internals.emit(total, (VECTOR, types.intp))
    plus = cpu_target.typing_context.resolve_value_type(operator.add)
    pair = types.float64, types.float64
    implementation = plus._impl_keys[pair]
    monkeypatch.setitem(plus._impl_keys, pair, "of a function with other options")
    tried = []
    monkeypatch.setattr(
        AbstractTemplate,
        "apply",
        lambda self, *given, apply=AbstractTemplate.apply: tried.append(self) or apply(self, *given),
    )
    internals.emit(other, (VECTOR, types.intp))
    assert not tried, "Function.get_call_type or Flags changed: operations are typed again in every function."
    assert plus._impl_keys[pair] == implementation, "Functions with other options decide what our operations call."


def test_one_copy_of_a_part_serves_all_constants():
    @part
    def scaled(y, factor, place):
        return y[place] * factor

    @Driver
    def use(y, place):
        return scaled(y, 2.0, 0) + scaled(y, 2.0, place) + scaled(y, 3.0, 1)

    assert use(np.array([1.0, 10.0]), 1) == 52.0
    assert len(scaled.overloads) == 1, "Dispatcher.get_call_template is no longer what decides the types of a call."


def test_functions_with_other_options_are_typed_by_themselves():
    strict, loose, again = Flags(), Flags(), Flags()
    loose.fastmath = True
    again.fastmath = False  # the default, given explicitly
    assert strict != loose, "Flags._values no longer holds the options: a user's fast-math could enter our code."
    assert strict == again
    assert hash(strict) == hash(again), "Equal options differ."
    assert Flags.options["fastmath"].default == strict.fastmath


def test_parts_are_forgotten_and_compiled_again():
    def use(y):
        return added(y) * 3.0

    assert Driver(use)(np.array([1.0, 2.0])) == 15.0
    reference = weakref.ref(next(iter(doubled.overloads.values())).library)
    internals.forget(0)
    gc.collect()
    assert not doubled.overloads, "Dispatcher.overloads is no longer the table of what was compiled."
    assert reference() is None, "Something else of Numba's keeps the code of parts: memory grows with every driver."
    assert Driver(use)(np.array([1.0, 3.0])[::1].astype("f4")) == 21.0, "_reset_overloads left a stale table."


def test_pass_managers_are_freed():
    passes = internals.passes
    for manager in (passes.ModulePassManager, passes.FunctionPassManager):
        assert manager._dispose is not passes.ffi.ObjectRef._dispose, f"{manager.__name__} is never freed."


def test_object_code_is_loaded_and_freed():
    code = internals.emit(first, (VECTOR,))
    assert code.lasting, "Code is marked as holding addresses of this process: nothing would be kept on disk."
    entry = internals.load(code)
    assert entry(np.full(1, 7.0)) == 7.0, "codegen._tm.emit_object, LLVM's ORC or _dynfunc.make_function changed."
    assert internals.load(internals.Code(*code))(np.full(1, 8.0)) == 8.0
    reference = weakref.ref(entry)
    del entry
    gc.collect()
    assert reference() is None, "Something keeps the entry point: the memory of drivers is never freed."


def test_loaded_code_finds_its_environment():
    def careful(y):
        if y[0] < 0.0:
            raise ValueError("negative")
        return y[0]

    driver = Driver(careful)
    with pytest.raises(ValueError, match="negative"):  # the exception is read from the environment
        driver(np.array([-1.0]))
    assert driver(np.array([2.0])) == 2.0


@machine
def machine_scale(y: int, n: int, factor: float) -> None:
    x = floats(y, n, 1)
    for i in range(n):
        x[i, 0] *= factor


def test_a_machine_is_called_by_its_symbol():
    def use(y):
        machine_scale(y.ctypes.data, y.shape[0], 3.0)

    machine_scale.load()
    y = np.arange(4.0)
    Driver(use)(y)
    assert y.tolist() == [0.0, 3.0, 6.0, 9.0], "llvm_cfunc_wrapper_name or add_symbol changed."


def test_arrays_at_addresses():
    def use(a, k, out):
        m, c, w = floats(a.ctypes.data, 4, 3), cubes(a.ctypes.data, 2, 2, 3), wholes(k.ctypes.data, 2, 3)
        out[0], out[1], out[2] = m[2, 1], c[1, 0, 1], w[1, 2]
        m[3, :][2] = 50.0
        out[3], out[4] = m.shape[0], c[:, :, 1].shape[1]

    a, out = np.arange(12.0), np.zeros(5)
    Driver(use)(a, np.arange(6), out)
    assert out.tolist() == [7.0, 7.0, 5.0, 4.0, 2.0], "make_array or populate_array no longer lays out an array."
    assert a[11] == 50.0, "An array at an address is a copy."


def test_instructions_on_vectors():
    def use(x):
        store(x, 1, 0, plus(load(x, 0, 0), fill(1.0)))

    x = np.arange(16.0).reshape(2, 8)
    Driver(use)(x)
    assert x[1].tolist() == list(range(1, 9)), "llvmlite.ir or Numba's models of primitive types changed."


def test_the_decorators_are_six():
    """`kernel`, `shared`, `part`, `sized`, `machine` and `Driver` are all that compiles."""
    makers = {name for name, value in vars(kernel).items() if callable(value) and value.__module__ == kernel.__name__}
    public = {name for name in makers if not name.startswith("_")}
    assert public - {"exp", "log", "nothing", "packed"} == {
        "kernel", "shared", "part", "sized", "machine", "Machine", "Driver",
    }  # fmt: skip

"""Compiled code: two processes at once, layouts, places that cannot be written, memory that is returned, one
compile_notice.
"""

import ast
import gc
import os
import pty
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import event
from numba.core.registry import cpu_target

from driftfit.engine import compile_notice, disk_cache, kernel, numba_internals
from driftfit.engine.kernel import Driver, machine, part

SRC = Path(__file__).parents[2] / "src"

FIRST = """
import sys, time
import numpy as np
from driftfit.engine import disk_cache
from driftfit.engine.kernel import Driver

def total(y):
    sum = 0.0
    for t in range(y.shape[0]):
        sum += y[t] * (t + 1)
    return sum

driver = Driver(total)
y = np.arange(6.0)[:: int(sys.argv[1])]
write = disk_cache.write
def slowly(name, content):  # both processes have read what is there before either of them writes
    open(sys.argv[2] + sys.argv[1], "w").close()
    for _ in range(600):
        if all(__import__("os").path.exists(sys.argv[2] + k) for k in "12"):
            break
        time.sleep(0.05)
    write(name, content)
disk_cache.write = slowly if len(sys.argv) > 3 else write
print(driver(y))
"""


def start(code, *arguments, **environment):
    given = {**os.environ, "PYTHONPATH": str(SRC), **environment}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)], env=given, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


def ended(process):
    result, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return result.strip(), errors


def test_two_processes_that_compile_at_once_do_not_mix_layouts(tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    script = tmp_path / "layouts.py"
    script.write_text(FIRST)
    code = f"import runpy; runpy.run_path({str(script)!r}, run_name='layouts')"
    at_once = [start(code, stride, tmp_path / "ready", "slowly", **cache) for stride in (1, 2)]
    assert [ended(process)[0] for process in at_once] == ["70.0", "16.0"]
    later = [start(code, stride, tmp_path / "ready", **cache) for stride in (1, 2)]
    assert [ended(process)[0] for process in later] == ["70.0", "16.0"]


NOWHERE = """
import warnings
import numpy as np
from driftfit.engine import disk_cache
from driftfit.engine.kernel import Driver

def plus(y):
    return y[0] + 1.0

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    one, other = Driver(plus)(np.zeros(1)), Driver(plus)(np.zeros(2)[::2])
    print(one, other, len(caught), "NUMBA_CACHE_DIR" in str(caught[0].message))
"""


def test_where_nothing_can_be_written_code_is_compiled_in_memory_with_one_warning(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    script = tmp_path / "nowhere.py"
    script.write_text(NOWHERE)
    code = f"import runpy; runpy.run_path({str(script)!r}, run_name='nowhere')"
    result, _ = ended(start(code, NUMBA_CACHE_DIR=str(blocked / "cache"), HOME=str(blocked)))
    assert result == "1.0 1.0 1 True"


def test_the_package_can_be_imported_where_no_folder_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_cache, "folders", lambda: (tmp_path / "file" / "a", tmp_path / "file" / "b"))
    (tmp_path / "file").write_text("no folder")
    disk_cache.folder.cache_clear()
    try:
        assert disk_cache.folder() is None
        assert disk_cache.read("anything") is None
        assert disk_cache.contents() == (None, 0, 0, 0)
        assert disk_cache.prune(0.0) == 0
    finally:
        disk_cache.folder.cache_clear()


def test_a_cache_that_can_only_be_read_is_read(tmp_path, monkeypatch):
    filled = tmp_path / "image"
    try:
        monkeypatch.setattr(disk_cache, "folders", lambda: (filled,))
        disk_cache.folder.cache_clear()
        assert Driver(second)(np.ones((2, 2))) == 1.0
        assert len(list(filled.iterdir())) == 1
        monkeypatch.setattr(disk_cache, "folder", lambda: None)
        monkeypatch.setattr(numba_internals, "emit", None)  # the compiler is not asked
        assert Driver(second)(np.ones((2, 2))) == 1.0
        assert disk_cache.contents()[:2] == (filled, 1)
    finally:
        monkeypatch.undo()
        disk_cache.folder.cache_clear()


def second(y):
    return y[0, 1]


def test_layouts_are_distinguished(own_cache):
    driver = Driver(second)
    table = np.arange(12.0).reshape(3, 4)
    assert [driver(a) for a in (table, np.asfortranarray(table), table[:, ::2], table.T)] == [1.0, 1.0, 2.0, 4.0]


def test_memory_is_freed_with_the_last_reference(own_cache, monkeypatch):
    monkeypatch.setattr(kernel, "MOST_ENTRIES", 2)
    driver = Driver(second)
    arrays = [np.ones((3, 3), kind) for kind in ("f8", "f4", "i8")]
    held, *others = (driver.entry(numba.typeof(array)) for array in arrays)
    entries = [weakref.ref(one) for one in (held, *others)]
    del others
    gc.collect()
    assert [entry() is None for entry in entries] == [False, False, False]  # the first was let go, but it is held
    assert held(arrays[0]) == 1.0
    del held
    gc.collect()
    assert [entry() is None for entry in entries] == [True, False, False]
    assert driver(arrays[0]) == 1.0  # back from disk


def test_what_only_the_compiler_needs_is_forgotten(own_cache):
    @kernel.kernel
    def twice(x):
        return 2.0 * x

    def user(y):
        return twice(y[0])

    assert Driver(user)(np.ones(1)) == 2.0
    assert len(twice.overloads) == 1
    assert twice(1.0) == 2.0  # from Python it has code of its own
    numba_internals.forget(0)
    assert len(twice.overloads) == 0
    assert Driver(user)(np.ones(1, "f4")) == 2.0


def test_files_are_whole_or_not_used_and_are_pruned(own_cache):
    assert Driver(second)(np.ones((2, 2))) == 1.0
    (path,) = own_cache.iterdir()
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    assert disk_cache.read(path.name) is None
    assert Driver(second)(np.ones((2, 2))) == 1.0
    assert disk_cache.read(path.name) is not None
    (own_cache / f"second-00000000-{'0' * 40}.compiled").write_bytes(b"of another version")
    # listed, but gone when it is looked at, as if another process had just finished it
    (own_cache / f"{path.name}.1.tmp").symlink_to(own_cache / "absent")
    found = disk_cache.contents()
    assert (found.files, found.usable) == (2, 1)
    assert disk_cache.prune(30.0) == 1
    assert disk_cache.prune(0.0) == 1
    assert disk_cache.contents().files == 0


WAITS = """
import time
from driftfit.engine import compile_notice
compile_notice.PATIENCE = 0.05
for _ in range(2):
    with compile_notice.compiling():
        time.sleep(0.3)
print("done")
"""


def test_compiling_is_announced_once_and_only_on_a_terminal():
    process = start(WAITS)
    assert ended(process) == ("done", "")
    ours, theirs = pty.openpty()
    environment = {**os.environ, "PYTHONPATH": str(SRC)}
    command = [sys.executable, "-c", WAITS]
    process = subprocess.run(command, env=environment, stdout=subprocess.PIPE, stderr=theirs, text=True, check=True)
    os.close(theirs)
    assert process.stdout == "done\n"
    assert os.read(ours, 1000).decode().split("\r\n") == [compile_notice.TEXT, ""]
    os.close(ours)


def family(number):
    """Parts that call each other, and a machine that calls them, of their own for every number."""

    @part
    def inner(x):
        return x + number

    @part
    def outer(x):
        return 2.0 * inner(x)

    def machine_of_family(k: int, x: float) -> None:
        outer(x)

    machine_of_family.__qualname__ += str(number)
    return machine(machine_of_family), lambda y: outer(y[0]) if number else y[0]


def test_two_threads_that_compile_at_once_do_not_mix(own_cache):
    """What is replaced in Numba while a part is compiled is put back, whatever another thread replaced meanwhile."""
    codegen = cpu_target.target_context.codegen()
    before, barrier, failures = {**vars(codegen)}, threading.Barrier(2), []

    def work(numbers):
        try:
            for number in numbers:
                barrier.wait(60.0)
                family(number)[0].load()
        except BaseException as failure:
            failures.append(failure)

    threads = [threading.Thread(target=work, args=(numbers,)) for numbers in ((1.0, 2.0), (3.0, 4.0))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert vars(codegen) == before


FORKS = """
import os, sys, threading
import numpy as np
from driftfit.engine.kernel import Driver
from numba.core import event

def plus(y):
    return y[0] + 1.0

def times(y):
    return y[0] * 3.0

inside, forked = threading.Event(), threading.Event()

class Slowly(event.Listener):
    def on_start(self, happened):
        inside.set()
        forked.wait(0.5)  # in the middle of compiling, while the other thread forks
    def on_end(self, happened):
        pass

with event.install_listener("numba:compile", Slowly()):
    thread = threading.Thread(target=Driver(plus), args=(np.ones(1),))
    thread.start()
    inside.wait()
    child = os.fork()
    forked.set()
    if child == 0:
        print(Driver(plus)(np.ones(1)), Driver(times)(np.ones(1)), flush=True)
        os._exit(0)
    thread.join()
_, status = os.waitpid(child, 0)
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_fork_while_another_thread_compiles(tmp_path):
    script = tmp_path / "forks.py"
    script.write_text(FORKS)
    code = f"import runpy; runpy.run_path({str(script)!r}, run_name='forks')"
    result, _ = ended(start(code, NUMBA_CACHE_DIR=str(tmp_path / "cache")))
    assert result == "2.0 3.0"


class Interrupt(event.Listener):
    """The user's Ctrl-C when the compiler has done so many steps."""

    def __init__(self, steps):
        self.left = steps

    def on_start(self, happened):
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt

    def on_end(self, happened):
        pass


@pytest.mark.parametrize("steps", [1, 12, 25])
def test_an_interrupted_compilation_can_be_repeated(own_cache, steps):
    codegen = cpu_target.target_context.codegen()
    before, driver = {**vars(codegen)}, Driver(family(10.0 + steps)[1])
    with pytest.raises(KeyboardInterrupt), event.install_listener("numba:run_pass", Interrupt(steps)):
        driver(np.ones(1))
    assert vars(codegen) == before
    assert all(path.suffix == disk_cache.ENDING for path in own_cache.glob("*"))
    assert driver(np.ones(1)) == 2.0 * (11.0 + steps)


def test_a_write_that_is_interrupted_leaves_no_file(own_cache, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as while_writing:
        while_writing.setattr(os, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            Driver(second)(np.ones((2, 2)))
    assert list(own_cache.iterdir()) == []
    assert Driver(second)(np.ones((2, 2))) == 1.0


def stray(source):
    """Functions that do more with the address of what they pack than call a routine."""
    found = []
    for function in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)):
        inside = list(ast.walk(function))
        packing = [one for one in inside if isinstance(one, ast.Call) and getattr(one.func, "id", "") == "packed"]
        kept = [one for one in inside if isinstance(one, ast.Assign) and one.value in packing and len(one.targets) == 1]
        names = {getattr(one.targets[0], "id", None) for one in kept}
        calls = [one.value for one in inside if isinstance(one, ast.Expr) and isinstance(one.value, ast.Call)]
        machines = [one for one in calls if getattr(one.func, "id", "").startswith("machine")]
        given = [argument for one in machines for argument in one.args]
        used = [
            one for one in inside if isinstance(one, ast.Name) and one.id in names and isinstance(one.ctx, ast.Load)
        ]
        if len(kept) != len(packing) or not all(one in given for one in used):
            found.append(function.name)
    return found


def test_an_address_on_the_stack_stays_in_its_function():
    """What a function packs is gone when it returns."""
    sources = {path.name: path.read_text() for path in (SRC / "driftfit").rglob("*.py")}
    users = [
        name
        for name, text in sources.items()
        for one in ast.walk(ast.parse(text))
        if isinstance(one, ast.ImportFrom) and one.module == "driftfit.engine.kernel" and "packed" in ast.unparse(one)
    ]
    assert {"diffuse.py"} <= set(users)
    assert {name: stray(sources[name]) for name in users} == {name: [] for name in users}
    right = "def f(s):\n    at = packed((1, 2))\n    machine_f(at, 3)\n"
    for line in ("return at", "s.kept = at", "later(at)"):
        assert stray(f"{right}    {line}\n") == ["f"]

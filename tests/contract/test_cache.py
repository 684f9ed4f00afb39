"""Compiled code is found on disk by a second process, and an edited step is compiled again."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import driftfit
from driftfit.engine import disk_cache
from driftfit.engine.kernel import kernel

COUNT = """
import json, sys
from numba.core import event

class Count(event.Listener):
    compiled = 0
    def on_start(self, happened):
        Count.compiled += 1
    def on_end(self, happened):
        pass

count = Count()
event.register("numba:compile", count)
"""

EVERY_TRACKER = """
from contract_table import forms, model_of, ready
from driftfit import ARX, Live, track
from driftfit.trackers import found

for tracker in [ready(kind, **form) for kind in found().values() for form in forms(kind)]:
    model = model_of(tracker, ARX(2, 2).bind(1))
    live = Live(model, tracker)
    track(model, tracker, [1.0, 2.0], [1.0, 1.0])
    live.update(1.0, 1.0)
"""

NAMES = """
from driftfit.engine import disk_cache

wanted, read = set(), disk_cache.read
disk_cache.read = lambda name: wanted.add(name) or read(name)
"""

WARM = (
    COUNT
    + NAMES
    + """
from driftfit.cli import app

app(["warm", "--model", "arx:1,1", "--tracker", "rls", "-p", "forgetting=0.98"], standalone_mode=False)
print(json.dumps([Count.compiled, sorted(wanted)]))
"""
)

WARMED = (
    COUNT
    + NAMES
    + """
import numpy as np
from driftfit import ARX, RLS, Live, track

y, u = np.random.default_rng(1).normal(size=(2, 300))
run = track(ARX(1, 1), RLS(0.99), y, u)
run.summary(), run.verdict()
Live(ARX(1, 1), RLS(0.99)).update(0.0, u[0])
print(json.dumps([Count.compiled, sorted(wanted)]))
"""
)

OWN_TRACKER = (
    COUNT
    + """
from own_tracker import Half
from driftfit import Regression, track

run = track(Regression(1), Half(), [1.0, 1.0], [1.0, 1.0])
found = [Count.compiled, run.theta[-1, 0]]
print(json.dumps(found))
"""
)

OWN_PARTS = """
from driftfit.engine.kernel import kernel

GAIN = 0.5

@kernel
def gain(s, l):
    return GAIN * s.ok[l]

@kernel
def twice(x):
    return 2.0 * x
"""

OWN_FILE = """
from dataclasses import dataclass
import numpy as np
from driftfit.engine.drivers import TrackerSteps, unknown
from driftfit.engine.kernel import kernel, nothing, shared
from driftfit.trackers.base import Tracker
from own_parts import gain, twice

@shared
def same(x):
    return 0.5 * twice(x)

@kernel
def correct(s, l):
    s.y_hat[l] = s.theta[0, l] * s.phi[0, l]
    s.e[l] = s.y[l] - s.y_hat[l]
    s.theta[0, l] += gain(s, l) * same(s.e[l])

@dataclass(frozen=True)
class Half(Tracker):
    covariance = False
    def state(self, n):
        return {"theta": np.zeros(n)}
    @property
    def steps(self):
        return TrackerSteps(nothing, nothing, correct, unknown, nothing)
"""


def run(code, tmp_path, shared=False):
    """What a fresh process prints last, as JSON; with a cache of its own unless it is shared with the other tests."""
    paths = [str(tmp_path), str(Path(driftfit.__file__).parents[1]), str(Path(__file__).parents[1])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    environment["NUMBA_CACHE_DIR"] = os.environ.get("NUMBA_CACHE_DIR", "") if shared else str(tmp_path / "cache")
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_second_process_compiles_nothing(tmp_path):
    """What this process compiles is on disk, but for what a test before stored in a folder of its own."""
    exec(EVERY_TRACKER, {})
    code = f"{COUNT}{EVERY_TRACKER}print(json.dumps(Count.compiled))"
    assert any(run(code, tmp_path, shared=True) == 0 for _ in range(2))


def test_warm_leaves_nothing_to_compile(tmp_path):
    """`driftfit warm`, as in a container image: record, stream, summary and verdict of another process find it all.

    Other tests have stored much of it, so the names that are looked up tell what `warm` would have compiled.
    """
    _, stored = run(WARM, tmp_path, shared=True)
    compiled, wanted = run(WARMED, tmp_path, shared=True)
    assert compiled == 0
    assert len(wanted) > 10
    assert set(wanted) <= set(stored)


def test_an_edit_in_another_file_is_noticed(tmp_path, monkeypatch):
    """Of a constant, of a step, and of a part that is kept on disk by itself; a second process compiles nothing."""
    monkeypatch.setattr(disk_cache, "folder", lambda: tmp_path / "cache" / "driftfit")
    monkeypatch.setattr(disk_cache, "folders", lambda: (disk_cache.folder(),))
    disk_cache.folder().mkdir(parents=True)
    parts = OWN_PARTS
    for edit, expected in (
        (("", ""), 0.75),
        (("GAIN = 0.5", "GAIN = 0.25"), 0.4375),
        (("s.ok[l]", "s.ok[l] * 2.0"), 0.75),
        (("2.0 * x", "1.0 * x"), 0.4375),
    ):
        parts = parts.replace(*edit)
        compiled, theta = run_here({"own_parts": parts, "own_tracker": OWN_FILE}, OWN_TRACKER, monkeypatch)
        assert (compiled > 0, theta) == (True, expected)
    (tmp_path / "own_parts.py").write_text(parts)
    (tmp_path / "own_tracker.py").write_text(OWN_FILE)
    assert run(OWN_TRACKER, tmp_path) == [0, expected]


def run_here(modules, code, monkeypatch):
    """What code finds in this process that imports modules of the given texts."""
    for name, text in modules.items():
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
        exec(text, vars(sys.modules[name]))
    names = {}
    try:
        exec(code, names)
    finally:
        names["event"].unregister("numba:compile", names["count"])
    return names["found"]


def test_a_function_whose_parts_are_defined_later_is_refused():
    """An edit of such a part would go unnoticed, and code on disk would be that before the edit."""
    names = {}
    exec("def whole(x):\n    return part(x)\n", names)
    with pytest.raises(TypeError, match="uses part, which is not defined above it"):
        kernel(names["whole"])

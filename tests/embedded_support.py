"""An exported tracker beside the stream that it must equal, bit for bit."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

from driftfit import Live
from driftfit.embedded import export_c, to_struct
from driftfit.embedded.project import record

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-ffp-contract=off"]
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc to compile the source")


class Step(ctypes.Structure):
    """tracker_step."""

    _fields_ = [*((name, ctypes.c_double) for name in ("y_hat", "e", "variance")), ("ok", ctypes.c_int)]


class Exported:
    """The tracker in a shared library, with a state of its own."""

    def __init__(self, folder, live, **options):
        target = folder / "tracker.so"
        command = ["gcc", *STRICT, "-O2", "-shared", "-fPIC", "-o", str(target), str(folder / "tracker.c"), "-lm"]
        subprocess.run(command, check=True)
        self.library = ctypes.CDLL(str(target))
        for name in ("tracker_update", "tracker_predict"):
            getattr(self.library, name).restype = Step
        self.size = len(to_struct(live, **options))
        self.buffer, self.scratch = ctypes.create_string_buffer(self.size), ctypes.create_string_buffer(self.size)
        self.library.tracker_init(self.buffer)

    def update(self, y, u):
        u = np.ascontiguousarray(u, dtype=float)
        return tuple_of(self.library.tracker_update(self.buffer, ctypes.c_double(y), ctypes.c_void_p(u.ctypes.data)))

    def predict(self, u):
        u = np.ascontiguousarray(u, dtype=float)
        return tuple_of(self.library.tracker_predict(self.buffer, self.scratch, ctypes.c_void_p(u.ctypes.data)))

    @property
    def state(self):
        return self.buffer.raw


def tuple_of(step):
    return [step.y_hat, step.e, step.variance, float(step.ok)]


def bits(values):
    return np.asarray(values, dtype=float).view(np.int64).tolist()


def same_numbers(one, other):
    """Bit for bit, but for the sign and payload of NaN, which processors choose."""
    one, other = (np.frombuffer(state, dtype=np.int64) for state in (one, other))
    nan = np.isnan(one.view(float)) & np.isnan(other.view(float))
    return bool(np.all((one == other) | nan))


def agree(folder, model, tracker, T, gate=None, **options):
    """Run both over a record with holes, an outage and inputs that fall silent, and compare every step and state."""
    export_c(model, tracker, folder, gate=gate, **options)
    live = Live(model, tracker, gate=gate)
    ours = Exported(folder, live, **options)
    assert same_numbers(ours.state, to_struct(live, **options))
    y, u = record(live.model, T, seed=3, codes=bool(gate))
    u[2 * T // 5 : 3 * T // 5] = 0.0
    steps, found = np.empty((T, 4)), np.empty((T, 4))
    for t in range(T):
        steps[t] = live.update(float(y[t]), u[t, : live.model.m])
        found[t] = ours.update(float(y[t]), u[t])
        assert t % 97 or same_numbers(ours.state, to_struct(live, **options)), t
    np.testing.assert_array_equal(found, steps)
    assert 0.5 * T < steps[:, 3].sum() < T
    return live, ours

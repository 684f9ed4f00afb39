"""Outlined steps: compiled once for each type of record, called by every driver, and found on disk with them."""

import numpy as np
import pytest
from support import arx_record

from driftfit import ARX, Regression
from driftfit.engine import disk_cache, kernel
from driftfit.engine import numba_internals as internals
from driftfit.engine.drivers import TrackerSteps, drivers
from driftfit.engine.kernel import machine
from driftfit.engine.outlined import PREFIX
from driftfit.engine.tiles import make_tile, output_type

pytestmark = pytest.mark.usefixtures("own_cache")


@kernel.kernel
def still(s, l):
    pass


@machine
def one(at):
    kernel.floats(at, 1, 1)[0, 0] = 1.0


@machine
def two(at):
    kernel.floats(at, 1, 1)[0, 0] = 2.0


@kernel.kernel
def called(s, l):
    one(s.theta.ctypes.data)
    s.y_hat[l] = s.theta[0, l]
    s.e[l], s.s[l], s.var[0, l] = s.y[l] - s.y_hat[l], 1.0, 0.0


STEPS = TrackerSteps(still, called, still, machines=(one, two), outlined=True)


def predictions(model, steps=STEPS, T=5):
    """The predictions of a record by drivers that nobody has used before."""
    tile = make_tile(model.n, model.m, model.memory(), [{"theta": np.zeros(model.n)}])
    out = np.empty(T, output_type(tile))
    y, u = arx_record(T, 1)
    known = np.ones((1, 3, 1))
    drivers.cache_clear()
    drivers(model.steps, steps).run(tile, y[:, None], np.repeat(u[:, None, None], model.m, axis=1), known, out)
    return out["y_hat"][-1].tolist()


@pytest.fixture
def compiled(monkeypatch):
    """The names of the functions that are compiled to object code."""
    names, emit = [], internals.emit

    def count(function, *more):
        names.append(function.__qualname__)
        return emit(function, *more)

    monkeypatch.setattr(internals, "emit", count)
    return names


def outlined(names):
    return sum(name.startswith(PREFIX.replace("-", "_")) for name in names)


def test_a_step_is_compiled_once_for_models_records_and_streams(compiled):
    model = Regression(1)
    assert predictions(model) == predictions(ARX(0, 1)) == [1.0]
    tile = make_tile(1, 1, model.memory(), [{"theta": np.zeros(1)}])
    update = drivers(model.steps, STEPS).updater(tile, 1)
    assert update(tile, 3.0, 1.0) == (1.0, 2.0, 1.0, True)
    assert (len(compiled), outlined(compiled)) == (4, 1)  # two loops over records, one sample, and the step


def test_both_are_found_on_disk_and_a_driver_whose_step_was_lost_is_compiled_again(compiled, monkeypatch):
    predictions(Regression(1))
    before = len(compiled)
    predictions(Regression(1))
    assert len(compiled) == before
    for path in disk_cache.folder().glob(f"{PREFIX}*"):
        path.unlink()
    for known in ("SOURCES", "LINKED"):  # as in a process that has compiled nothing
        monkeypatch.setattr(f"driftfit.engine.outlined.{known}", {})
    assert predictions(Regression(1)) == [1.0]
    assert [name.split("_")[0] for name in compiled[before:]] == ["run", "outlined"]


def test_machines_that_are_called_instead_of_others_are_called_by_the_step_too(compiled):
    other = STEPS._replace(instead=((one, two),))
    assert (predictions(Regression(1)), predictions(Regression(1), other)) == ([1.0], [2.0])
    assert predictions(Regression(1)) == [1.0]
    assert outlined(compiled) == 1

"""Outlined steps: compiled once for all sizes and models, called by every driver, and found on disk with them."""

import numpy as np
import pytest
from support import arx_record

from driftfit import ARX, Regression
from driftfit.engine import disk_cache, kernel
from driftfit.engine import numba_internals as internals
from driftfit.engine import outlined as outlining
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


@kernel.kernel
def called(s, l):
    one(s.theta.ctypes.data)
    s.y_hat[l] = s.theta[0, l]
    s.e[l], s.s[l], s.var[0, l] = s.y[l] - s.y_hat[l], 1.0, 0.0


STEPS = TrackerSteps(still, still, called, still, still, machines=(one,), outlined=True)


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
    assert (len(compiled), outlined(compiled)) == (5, 2)  # two loops over records, one sample, and two phases


def test_a_step_is_compiled_once_for_all_sizes(compiled):
    assert [predictions(Regression(n)) for n in (1, 3, 7)] == [[1.0]] * 3
    assert outlined(compiled) <= 2
    assert len(compiled) - outlined(compiled) == 3  # a loop over records for each size


def everything(s):
    """All that steps do with fields: entries from both ends, shapes, rows, slices and whole arrays."""
    rows, columns, lanes = s.a.shape
    for i in range(rows):
        for j in range(columns):
            s.a[i, j, 0] += i - 2.0 * j + s.b[-1, 0] * s.k[0]
            s.b[i, 0] = s.b[i, 0] + s.a[i, j, 0]
    s.a[-1, :, 0] = 3.0
    row, total = s.a[0, :, 0], 0.0
    for x in row:
        total += x
    s.k[0] = len(s.b) + s.a.ndim + lanes + rows * columns
    s.b[0, 0] = total + s.a.size + s.b.sum()


def test_fields_of_open_records_are_those_of_the_record(compiled):
    step = outlining.outlined(kernel.kernel(everything))

    def run(tile):
        step(tile[0])

    driver = kernel.Driver(run)
    for rows, columns in ((2, 3), (5, 1), (1, 4)):
        kind = [("theta", float, (1, 1)), ("a", float, (rows, columns, 1)), ("k", int, (1,)), ("b", float, (rows, 1))]
        tile = np.zeros(1, np.dtype(kind, align=True))
        tile["a"][0, ..., 0] = np.arange(rows * columns).reshape(rows, columns)
        tile["b"][0, :, 0], tile["k"][0, 0] = np.arange(rows) + 0.5, 7
        plain = tile.copy()
        driver(tile)
        everything(plain.view(np.recarray)[0])
        assert tile.tobytes() == plain.tobytes()
    assert (len(compiled), outlined(compiled)) == (4, 1)


def test_both_are_found_on_disk_and_a_driver_whose_step_was_lost_is_compiled_again(compiled, monkeypatch):
    predictions(Regression(1))
    before = len(compiled)
    predictions(Regression(1))
    assert len(compiled) == before
    for path in disk_cache.folder().glob(f"{PREFIX}*"):
        path.unlink()
    for known in ("SOURCES", "LINKED"):  # as in a process that has compiled nothing
        monkeypatch.setattr(f"driftfit.engine.outlined.{known}", {})
    monkeypatch.setattr(kernel, "MADE", {})
    assert predictions(Regression(1)) == [1.0]
    assert [name.split("_")[0] for name in compiled[before:]] == ["run", "outlined", "outlined"]

"""What Python users take for granted: text in a notebook, copies, other processes, messages that say what is wrong."""

import builtins
import copy
import pickle
import re
import subprocess
import sys

import numpy as np
import polars as pl
import pytest
import rich
from support import arx_record, same

from driftfit import (
    ARX,
    RLS,
    Kalman,
    Live,
    grid,
    select,
    track,
    tune,
)
from driftfit.judge.alarms.detect import detect
from driftfit.tune.frontier import frontier

K = Kalman(q=1e-3, r=0.01)
Y, U = arx_record(200, 1)
TWO = np.column_stack([Y, 0.5 * Y[::-1]])


@pytest.fixture(scope="module")
def run():
    return track(ARX(2, 2), K, Y, U)


@pytest.fixture(scope="module")
def fleet():
    return track(ARX(2, 2), K, np.stack([Y] * 12), np.stack([U] * 12), by="row")


@pytest.fixture
def notebook():
    """What rich takes for Jupyter."""

    class ZMQInteractiveShell:
        pass

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(builtins, "get_ipython", ZMQInteractiveShell, raising=False)
        rich.reconfigure()  # its console was made before, and stays when the notebook is gone
        yield
    rich.reconfigure()


def results(run, fleet):
    """Everything that rich draws."""
    yield run.summary()
    yield run.verdict()
    yield run.diagnose()
    yield run.detect(records=8)
    yield fleet.summary()
    yield fleet.verdict()
    yield fleet.diagnose()
    yield fleet.detect(records=8)
    yield select([ARX(2, 2), ARX(1, 1)], Y, U, tracker=RLS(1.0))


def test_text_is_the_same_in_a_notebook(run, fleet, notebook, monkeypatch, capsys):
    from rich.console import Console

    assert Console().is_jupyter
    with monkeypatch.context() as outside:
        outside.delattr(builtins, "get_ipython")
        expected = [str(one) for one in results(run, fleet)]
    with monkeypatch.context() as elsewhere:
        for name, value in (("FORCE_COLOR", "1"), ("TERM", "dumb"), ("COLUMNS", "40"), ("JUPYTER_COLUMNS", "40")):
            elsewhere.setenv(name, value)
        for one, text in zip(results(run, fleet), expected, strict=True):
            assert str(one) == text
            assert len(text) > 200
            assert max(map(len, text.splitlines())) <= 96
            shown = one._repr_mimebundle_([], [])
            assert f"{type(one).__name__}(" not in shown["text/plain"]
            assert "<pre" in shown["text/html"]
    assert capsys.readouterr().out == ""


WAYS = {"pickle": lambda one: pickle.loads(pickle.dumps(one)), "copy": copy.copy, "deepcopy": copy.deepcopy}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_a_copied_stream_continues_independently(way):
    for model, y, settings in ((ARX(2, 2), Y, {"lag": 3}), (ARX(2, 2), Y, {}), (ARX(1, 1, ny=2), TWO, {"lag": 3})):
        live = Live(model, K, **settings)
        for t in range(50):
            live.update(y[t], U[t], time=float(t))
        before, other = live.to_bytes(), way(live)
        assert type(other) is type(live)
        assert (other.lag, other.ignored, other.names) == (live.lag, live.ignored, live.names)
        for t in range(50, 60):
            other.update(y[t], U[t], time=float(t))
        assert live.to_bytes() == before  # nothing is shared
        for t in range(50, 60):
            live.update(y[t], U[t], time=float(t))
        assert live.to_bytes() == other.to_bytes()
        assert same(live.theta, other.theta)
        if settings:
            assert same(live.smooth().theta, other.smooth().theta)


def test_a_series_of_a_fleet_is_sent_alone(run, fleet):
    assert len(pickle.dumps(fleet[3])) < 2 * len(pickle.dumps(run))


MODEL, TRACKER = "ARX(na=2, nb=2)", "Kalman(q=0.001, r=0.01)"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: track(ARX, K, Y, U), "track: model is the class ARX itself; create an instance: ARX(na=...)."),
        (lambda: track(ARX(2, 2), Kalman, Y, U), "class Kalman itself; create an instance: Kalman(q=..., r=...)."),
        (lambda: track(ARX, Kalman, Y, U), "model is the class ARX itself"),
        (lambda: track(K, ARX(2, 2), Y, U), f"wrong order; the model comes first: track({MODEL}, {TRACKER}, ...)."),
        (lambda: track(Kalman, ARX, Y, U), "the model comes first: track(ARX(na=...), Kalman(q=..., r=...), ...)."),
        (lambda: track(ARX(2, 2), Y, U), "must be a tracker, such as AdaptiveKalman(); got an array of shape (200,)."),
        (lambda: track(ARX(2, 2), [K, Kalman], Y, U), "tracker is the class Kalman"),
        (lambda: track(ARX(2, 2), {"a": RLS}, "y", "u", data=pl.DataFrame(), by="k"), "tracker is the class RLS"),
        (lambda: track("ARX(2, 2)", K, Y, U), "such as ARX(2, 2) or Regression(3); got 'ARX(2, 2)' (str)."),
        (lambda: Live(ARX, Kalman), "Live: model is the class ARX itself"),
        (lambda: Live(K, ARX(2, 2)), f"the model comes first: Live({MODEL}, {TRACKER}, ...)."),
        (lambda: Live(ARX(2, 2)), "Live: tracker must be a tracker, such as AdaptiveKalman(); got None."),
        (lambda: Live(ARX(2, 2), [K]), "Live: tracker must be a tracker"),
        (lambda: tune(ARX(2, 2), Kalman, Y, U), "tune: tracker is the class Kalman itself"),
        (lambda: tune(Kalman(), ARX(2, 2), Y, U), f"the model comes first: tune({MODEL}, Kalman(), ...)."),
        (lambda: select(ARX, Y, U), "select: model is the class ARX itself"),
        (lambda: select([ARX(2, 2), K], Y, U), "model must be a model, such as ARX(2, 2) or Regression(3); got Kalman"),
        (lambda: select(ARX(2, 2), Y, U, tracker=RLS), "select: tracker is the class RLS itself"),
        (lambda: grid(ARX(2, 2), na=[1, 2]), "grid: give the class of the models"),
        (lambda: frontier(ARX, Y, U), "frontier: model is the class ARX itself"),
        (lambda: detect("band", Y), "detect: the run comes first, as in detect(run, 'band'); got 'band'."),
    ],
)  # fmt: skip
def test_classes_and_swapped_arguments_are_named(call, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        call()


def test_importing_the_package_loads_nothing_that_is_needed_later():
    later = (
        "matplotlib",
        "pandas",
        "scipy.linalg",
        "scipy.optimize",
        "scipy.signal",
        "scipy.special",
        "scipy.stats",
        "sklearn",
    )
    code = f"import sys, driftfit; print([name for name in {later} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"

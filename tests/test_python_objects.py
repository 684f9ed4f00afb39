"""Every public object can be copied, pickled, stored by joblib and sent to another process; settings can be pasted.

What is public and not in the lists below fails `test_nothing_public_is_left_out`.
"""

import copy
import inspect
import io
import pickle
from multiprocessing import get_context

import joblib
import numpy as np
import pytest
from support import arx_record, same

import driftfit
from driftfit import *  # noqa: F403
from driftfit import (
    ARX,
    RLS,
    Bank,
    HammersteinWiener,
    Kalman,
    Live,
    LiveSelection,
    Regression,
    Sensor,
    frontier,
    pool,
    select,
    track,
    tune,
)
from driftfit.engine.settings import Settings
from driftfit.systems import *  # noqa: F403

Y, U = arx_record(200, 1)
TWO = np.column_stack([Y, 0.5 * Y[::-1]])
K = Kalman(q=1e-3, r=0.01)


def values(x, p, out):
    """A function of a user's own."""
    out[0] = x * x


def slopes(x, p, out):
    out[0] = 2.0 * x


SETTINGS = """
ARX(2, 2)
ARX(2, [1, 2], nk=[0, 1], inputs=["flow", "head"], intercept=True)
ARX(1, 1, ny=["level", "temperature"])
ARMAX(2, 2, 1)
OE(2, 2)
BoxJenkins(2, 1, 1, 2)
PolynomialModel(1, 1, 1, 1, 1)
Equation("flow = theta.k * sqrt(p1 - p2) - theta.c")
StateSpace("x = x[-1] + theta.a * u\\n y = x", start={"a": 2.0})
JointKalman(q={"x": 1e-4}, r=0.1, p0=1.0)
Regression(3)
Regression(["income", "rate"], intercept=True)
Regression(2, ny=2, shared=True)
HammersteinWiener(2, 2)
HammersteinWiener(na=2, nb=2, input=DeadZone(0.2), output=BSpline(2, [-1, 0, 1]))
Polynomial(3)
Chebyshev(3, (-1, 1))
Legendre(3, (-1, 1))
DeadZone(0.2)
Saturation(1.0)
Sigmoid([0.0, 1.0], 2.0)
BSpline(2, [-1, 0, 1])
PiecewiseLinear([-1, 0, 1])
Functions(values, slopes)
Functions(values, slopes, numbers=[1.0, 2.0], labels=["square"])
Kalman()
Kalman(q=1e-4, r=0.1)
Kalman(q=np.array([1e-4, 0.0]), r=0.1, theta0=[1, 2], p0=np.eye(2), form="sqrt")
RLS(0.98)
RLS(0.9, p0=1.0, theta0=[1.0, np.pi])
Kalman(q=1e-4, r=0.1, laws={"theta1": Law.returns(50, 0.2), "theta2": Law.season(24, harmonics=2)})
Law.trend(1e-6)
FLS(mu=100.0)
AugmentedFLS(10.0)
DynamicGLM("poisson", q=1e-4, p0=1.0)
AdaptiveKalman()
ExtendedKalman(q=1e-4, r=0.1)
OutputError()
InstrumentalVariables(1.0)
Bank()
Bank(changes=[Change(q=0, prob=0.99), Change(q=0.5, prob=0.01)], sensors=[Sensor.nominal(r=0.1)], reduce=Beam(9))
Change(q=0.5, prob=0.1)
Sensor.nominal(r=0.1)
Beam(5)
Decide()
GPB(2)
IMM()
FirstFloor()
Hybrid()
""".strip().splitlines()
"""Expressions of models, trackers and their parts."""

LAWS = [
    "Constant(1.0)",
    "Ramp(1.0, np.float64(0.1))",
    "RandomWalk(0.0, 0.1, limits=(-1.0, 1.0))",
    "Jump(1.0, 0.5, 10)",
]


def made(expression):
    return eval(expression)


WAYS = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda one: pickle.loads(pickle.dumps(one)),
    "joblib": lambda one: through_file(one),
}


def through_file(one):
    file = io.BytesIO()
    joblib.dump(one, file)
    file.seek(0)
    return joblib.load(file)


@pytest.mark.parametrize("expression", SETTINGS + LAWS)
def test_settings_are_values(expression):
    one, two = made(expression), made(expression)
    assert one == two
    assert hash(one) == hash(two)
    assert made(repr(one)) == one, repr(one)
    assert repr(made(repr(one))) == repr(one)
    for name, way in WAYS.items():
        other = way(one)
        assert type(other) is type(one), name
        assert {one: name}[other] == name  # equal, and of one hash
    assert one != made("Regression(7)")
    assert joblib.hash(one) == joblib.hash(two)


def objects():
    """Every kind of result and stream, by name."""
    run = track(ARX(2, 2), K, Y, U)
    fleet = track(ARX(2, 2), K, np.stack([Y] * 3), np.stack([U] * 3), by="row")
    outputs = track(ARX(1, 1, ny=2), K, TWO, U)
    shared = track(Regression(1, ny=2, shared=True), K, TWO, np.stack([U, U], axis=1)[..., None])
    bank = track(ARX(2, 2), Bank(sensors=[Sensor.nominal(r=0.01)]), Y, U)
    found = {"Track": run, "Fleet": fleet, "Outputs": outputs, "Shared": shared, "Bank": bank}
    found |= {"Live": Live(ARX(2, 2), K), "LiveOutputs": Live(ARX(1, 1, ny=2), K)}
    found |= {"LiveSelection": LiveSelection([ARX(2, 2), ARX(1, 1)], tracker=RLS(1.0))}
    for t in range(30):
        found["Live"].update(Y[t], U[t])
        found["LiveSelection"].update(Y[t], U[t])
        found["LiveOutputs"].update(TWO[t], U[t])
    for name in ("Track", "Fleet", "Outputs", "Shared"):
        for verb in ("summary", "verdict", "diagnose"):
            found[f"{name}.{verb}"] = getattr(found[name], verb)()
    found |= {"Track.smooth": run.smooth(), "Bank.hypotheses": bank.hypotheses, "Bank.smooth": bank.smooth()}
    found |= {"Tuned": tune(ARX(2, 2), Kalman(), Y, U), "TunedOutputs": tune(ARX(1, 1, ny=2), Kalman(), TWO, U)}
    found |= {"Selection": select([ARX(2, 2), ARX(1, 1)], Y, U, tracker=RLS(1.0)), "Segmentation": run.segment()}
    found |= {"Frontier": frontier(ARX(2, 2), Y, U), "detect": run.detect("innovation")}
    found |= {"Forecast": run.forecast(2, U[:2]), "Prediction": run.ahead(2), "Response": run.step_response(5)}
    found["Constrained"] = run.constrain("a1 >= 0")
    found["Pooled"] = pool(track(Regression(1), Kalman(q=0.0, r=1.0), Y.reshape(10, 20), U.reshape(10, 20), by="row"))
    found["Blocks"] = track(HammersteinWiener(1, 1), RLS(1.0), Y, U).blocks()
    return found


@pytest.fixture(scope="module")
def everything():
    return objects()


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_results_and_streams_are_copied(everything, way):
    for name, one in everything.items():
        other = way(one)
        assert type(other) is type(one), name
        assert (str(other), repr(other)) == (str(one), repr(one)), name
        if hasattr(one, "theta"):
            assert same(other.theta, one.theta), name


def told(things):
    """What another process says of them."""
    return {name: (str(one), np.asarray(getattr(one, "theta", 0.0))) for name, one in things.items()}


def test_everything_goes_to_another_process_and_back(everything):
    settings = {text: made(text) for text in SETTINGS}
    with get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(told, (everything | settings,))
    for name, one in (everything | settings).items():
        assert elsewhere[name][0] == str(one), name
        assert same(elsewhere[name][1], np.asarray(getattr(one, "theta", 0.0))), name


def test_a_notebook_shows_what_a_result_is(everything):
    for name, one in everything.items():
        assert "object at 0x" not in repr(one), name
        if hasattr(one, "_repr_html_"):
            html = one._repr_html_()
            assert html.startswith("<pre"), name
            assert html.count("<span") == html.count("</span>"), name
    for name in ("Track", "Fleet", "Outputs", "Shared", "Tuned", "TunedOutputs", "Track.verdict", "Fleet.verdict"):
        assert hasattr(everything[name], "_repr_html_"), name
    html = everything["Fleet"]._repr_html_()
    for word in ("Fleet of 3 series", "a1", "b2", f"{everything['Fleet'][2].theta[-1, 3]:.4g}"):
        assert word in html


def test_nothing_public_is_left_out(everything):
    listed = {type(one) for one in everything.values()} | {type(made(text)) for text in SETTINGS}
    public = {one for name in driftfit.__all__ if inspect.isclass(one := getattr(driftfit, name))}
    assert {one for one in public - listed if not inspect.isabstract(one)} == {
        driftfit.DataWarning,
        driftfit.ConformalFactor,
    }
    assert all(issubclass(type(made(text)), Settings) for text in SETTINGS)

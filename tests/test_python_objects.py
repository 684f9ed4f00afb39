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
from every_result import every_result
from support import same

import driftfit
from driftfit import *  # noqa: F403
from driftfit.engine.settings import Settings
from driftfit.systems import *  # noqa: F403


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
ContinuousTransfer(2, 1, dt=0.1, inputs=["power"])
BoxJenkins(2, 1, 1, 2)
PolynomialModel(1, 1, 1, 1, 1)
Equation("flow = theta.k * sqrt(p1 - p2) - theta.c")
StateSpace("x = x[-1] + theta.a * u\\n y = x", start={"a": 2.0})
JointKalman(q={"x": 1e-4}, r=0.1, p0=1.0)
ParticleFilter(100, q={"x": 1e-4}, r=0.1, p0=1.0, sampled=["x"])
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
Gate(far=20.0)
Beam(5)
Decide()
GPB(2)
IMM()
FirstFloor()
Hybrid()
Resample(16)
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


@pytest.fixture(scope="module")
def everything():
    return every_result()


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_results_and_streams_are_copied(everything, way):
    for name, one in everything.items():
        other = way(one)
        assert type(other) is type(one), name
        assert (str(other), repr(other)) == (str(one), repr(one)), name
        if hasattr(one, "theta"):
            assert same(other.theta, one.theta), name


def described(things):
    """The text and theta of each, as another process finds them."""
    return {name: (str(one), np.asarray(getattr(one, "theta", 0.0))) for name, one in things.items()}


def test_everything_can_be_sent_to_another_process_and_back(everything):
    settings = {text: made(text) for text in SETTINGS}
    with get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(described, (everything | settings,))
    for name, one in (everything | settings).items():
        assert elsewhere[name][0] == str(one), name
        assert same(elsewhere[name][1], np.asarray(getattr(one, "theta", 0.0))), name


def test_a_notebook_shows_what_a_result_is(everything):
    for name, one in everything.items():
        assert not any(text in repr(one) for text in ("object at 0x", "array(")), name
        if hasattr(one, "_repr_html_"):
            html = one._repr_html_()
            assert repr(one) == str(one).strip("\n"), name  # not every field, at a prompt
            assert html.startswith("<pre"), name
            assert html.count("<span") == html.count("</span>"), name
    for name in ("Track", "Fleet", "Outputs", "Instants", "Tuned", "TunedOutputs", "Track.verdict", "Fleet.verdict"):
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

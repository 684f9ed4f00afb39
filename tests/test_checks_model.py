"""What a model declares of itself: kept by the models of the house, and each wrong declaration is named."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support import arx_record

import driftfit
from driftfit import (
    ARX,
    RLS,
    ContinuousTransfer,
    Equation,
    HammersteinWiener,
    JointKalman,
    Kalman,
    Model,
    PolynomialModel,
    Regression,
    StateSpace,
    select,
    track,
)
from driftfit.checks import check_model
from driftfit.checks.model import _shown, signals
from driftfit.models import found
from driftfit.models.base import Implicit
from driftfit.models.hammerstein_wiener.basis import Polynomial

CURVED = HammersteinWiener(1, 2, input=Polynomial(2), output=Polynomial(3), intercept=True, output_noise=0.1)
SYSTEM = (-0.3, 0.5, 0.2, 0.1, 0.2, 0.1, 0.04, -0.03, -0.06, 0.1)
SPACE = "x = x[-1] + dt * (theta.a * tanh(u) - theta.b * x[-1]) \n y = sqrt(1 + x * x) + 0.1 * u[-1]"
# of four parameters where they can, so that they share the compiled steps of the tracker
READY = {
    "ARX": (ARX(1, [1, 1], nk=[1, 2], intercept=True), None), "Regression": (Regression(3, intercept=True), None),
    "HammersteinWiener": (CURVED, SYSTEM),
    "PolynomialModel": (
        PolynomialModel(1, [1, 1], 1, 1, [1, 0], nk=[1, 2], offset=True), (0.5, 1.0, 0.5, 0.9, 0.7, 0.3, 3.0)
    ),
    "ContinuousTransfer": (ContinuousTransfer(2, 1, delay=1, dt=0.5, inputs=1), (1.5, 1.0, 0.5, 2.0)),
    "StateSpace": (StateSpace(SPACE), (0.5, 0.3, 0.2)),
    "Equation": (Equation("y = theta.g * tanh(theta.s * u[-1]) + theta.a * y[-1] + theta.c"), (1.0, 0.5, 0.4, 0.3)),
}  # fmt: skip


NAMED = {"ARMAX", "OE", "BoxJenkins"}  # polynomial models of some orders


@pytest.mark.parametrize("name", sorted(set(found()) - NAMED))
def test_models_that_keep_their_promises(name):
    assert {key for kind in NAMED for key in vars(found()[kind]) if key[0] != "_"} == {"na", "nc", "nd", "nf"}
    assert name in READY, f"{name}: give it orders, and a stable system, in READY"
    assert check_model(*READY[name]) == []


@dataclass(frozen=True)
class Short(ARX):
    reach = 1


class Proud(HammersteinWiener):
    def touched(self, t, signal):
        return range(t, t + 1) if signal == "u" else super().touched(t, signal)


@dataclass(frozen=True)
class Lagged(ARX):
    output_lags = 2


@dataclass(frozen=True)
class Delayed(ARX):
    @property
    def terms(self):
        return (*super().terms[:-1], ("u", 0, 4))


class Steep(ARX, Implicit):
    implicit = property(lambda self: self)

    def output_slope(self, theta, y):
        return np.full(len(y), 2.0)


@dataclass(frozen=True)
class Drawn(ARX):
    def play(self, theta, y, u, noise, span):
        return 1.1 * super().play(theta, y, u, noise, span)


@dataclass(frozen=True)
class Fickle(ARX):
    def follows(self, other):
        return False


@dataclass(frozen=True)
class Twice(ARX):
    @property
    def names(self):
        return ("a1", "b1", "b1", "b2")


@pytest.mark.parametrize(
    ("kind", "result"),
    [
        (Short, "reach is 1, but signals of sample 30 are in the regressors of sample 33"),
        (Proud, r"A missing u at sample 30 makes samples \[31, 32, 33\] unusable; declared: \[30\]"),
        (Lagged, "output_lags is 2, but regressor 1 is not the output 2 samples before"),
        (Delayed, r"terms declares regressor 3 as \('u', 0, 4\), but it has another value"),
        (Steep, "log_jacobian is not the logarithm of the slope of the innovation against y, which is 1"),
        (Drawn, "play gives"), (Fickle, "follows returns False"), (Twice, "names must be 4 different names"),
    ],
)  # fmt: skip
def test_wrong_declarations_are_reported(kind, result):
    broken = check_model(kind(1, 3))
    assert len(broken) == (2 if kind is Short else 1)  # without its whole reach it cannot be played either
    assert re.match(result, broken[0]), broken


def test_the_package_knows_of_hammerstein_wiener_models_only_what_models_declare():
    """No isinstance, hasattr or getattr on its class or its own attributes outside its folder and its verbs."""
    home = Path(driftfit.__file__).parent
    own = "log_jacobian|structure|output_noise|out"
    asks = re.compile(rf"isinstance\([^)]*HammersteinWiener|(has|get)attr\([^,]*(model, \"|, \"({own})\")")
    verbs = {"hammerstein_wiener", "blocks.py", "output_error.py"}
    outside = [path for path in home.rglob("*.py") if not verbs & {*path.parts}]
    assert [str(path) for path in outside if asks.search(path.read_text())] == []


def test_a_parameter_that_the_output_does_not_show_is_named():
    lost = StateSpace("x = 0.5 * x[-1] + theta.b * u \n other = theta.c * u \n y = x")
    run = track(lost, JointKalman(q=0.0, r=1.0, p0=1e-20, theta0=(0.3, 0.2, 0.0, 0.0)), *signals(1))
    assert list(_shown(lost, run.tracker, run)) == [
        "The output says nothing of c: no line leads from it to the output, or its effect vanishes here."
    ]


@dataclass(frozen=True)
class Declared(Model):
    """A model of one's own, which says what its regressors are; those of ARX(1, 3), as its steps."""

    m, reach, output_lags = 1, 3, 1

    @property
    def arx(self):
        return ARX(1, 3, inputs=1)

    def bind(self, inputs):
        return self

    def memory(self):
        return self.arx.memory()

    def noise_response(self, theta, h):
        return self.arx.noise_response(theta, h)

    names = property(lambda self: self.arx.names)
    steps = property(lambda self: self.arx.steps)
    terms = property(lambda self: self.arx.terms)


def test_declared_regressors_serve_simulation_prediction_selection_and_calibration():
    y, u = arx_record(300, 3)
    runs = [track(model, Kalman(q=1e-4, r=0.01), y, u) for model in (Declared(), ARX(1, 3))]
    for one, other in [
        *zip(*(run.simulate(u[:20])[:3] for run in runs), strict=True),
        *zip(*(run.ahead(3)[:3] for run in runs), strict=True),
    ]:
        np.testing.assert_array_equal(one, other)
    own, arx = (run.detect(every=200.0, reference=250, records=8).rule for run in runs)
    assert own == arx
    own, arx = select([Declared(), ARX(1, 3)], y, u, tracker=RLS(1.0)).rows
    assert own.loglik == arx.loglik

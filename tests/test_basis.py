"""Functions that the blocks of a Hammerstein-Wiener model are written in: values, derivatives, settings, one's own."""

import json

import numpy as np
import pytest
from numpy.polynomial import chebyshev, legendre
from scipy.interpolate import BSpline as ScipyBSpline

from driftfit import Kalman, Track, track
from driftfit.models.hammerstein_wiener.basis import (
    BSpline,
    Chebyshev,
    Functions,
    Legendre,
    PiecewiseLinear,
    Polynomial,
    Sigmoid,
    basis_of,
)
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.thresholds import DeadZone, Saturation
from driftfit.systems.hammerstein_wiener import simulate


def test_bases_are_what_they_say():
    x = np.linspace(-1.9, 3.2, 23)
    s = (x - 1.0) / 3.0
    np.testing.assert_allclose(Legendre(5, (-2, 4)).value(x), legendre.legvander(s, 5)[:, 1:], atol=1e-14)
    np.testing.assert_allclose(Chebyshev(5, (-2, 4)).value(x), chebyshev.chebvander(s, 5)[:, 1:], atol=1e-14)
    np.testing.assert_allclose(Polynomial(3).value(x), x[:, None] ** [1, 2, 3])
    bends = PiecewiseLinear([-1.0, 0.0, 2.0])
    np.testing.assert_allclose(bends.value([-3.0, 1.0, 5.0]), [[-3, -2, 0, 0], [1, 0, 1, 0], [5, 0, 5, 3]])
    for degree in (1, 2, 3):
        spline = BSpline(degree, [-2.0, -1.0, 0.5, 1.0, 3.3], anchor=0.3)
        ends = np.pad(spline.knots, degree, mode="edge")
        twin = [
            ScipyBSpline(ends, row, degree)(x) - ScipyBSpline(ends, row, degree)(0.3)
            for row in np.eye(len(ends) - degree - 1)[1:]
        ]
        np.testing.assert_allclose(spline.value(x), np.stack(twin, axis=1), atol=1e-14)
        assert spline.n == len(twin) == len(spline.names)
        assert np.isnan(spline.value(3.31)).all()
    zone, limited = (kind(3.0, start=0.7) for kind in (DeadZone, Saturation))
    np.testing.assert_allclose(zone.value([2.0, 0.5, -2.0]) @ [1.0, 0.7, -0.7], [1.3, 0.0, -1.3])
    np.testing.assert_allclose(limited.value(x) @ [1.0, 0.7, -0.7], np.clip(x, -0.7, 0.7))
    bent = np.tanh((x[:, None] - [-1.0, 0.5]) / 0.7) + np.tanh(np.array([-1.0, 0.5]) / 0.7)
    np.testing.assert_allclose(Sigmoid([-1.0, 0.5], 0.7).value(x), bent, atol=1e-15)
    assert np.isnan(Sigmoid([0.0], 1.0).value(np.nan)).all()
    assert basis_of(("sigmoid", 0.7, -1.0, 0.5)) == Sigmoid([-1.0, 0.5], 0.7)
    with pytest.raises(ValueError, match="centres must be at least 1 strictly increasing"):
        Sigmoid([1.0, 0.0], 1.0)


@pytest.mark.parametrize(
    "basis",
    [
        Polynomial(3), Legendre(4, (-2, 4)), Chebyshev(4, (-2, 4)), PiecewiseLinear([-1.0, 1.0]),
        BSpline(3, [-2.0, 0.0, 4.0]), DeadZone(3.0), Saturation(3.0), Sigmoid([-1.0, 0.5], 0.7),
    ],
    ids=repr,
)  # fmt: skip
def test_derivatives_and_settings_of_bases(basis):
    x = np.linspace(-1.93, 3.17, 19)
    numeric = (basis.value(x + 1e-6) - basis.value(x - 1e-6)) / 2e-6
    np.testing.assert_allclose(basis.derivative(x), numeric, atol=1e-7)
    assert basis_of(json.loads(json.dumps(basis.plain()))) == basis
    model = HammersteinWiener(1, 1, input=basis, intercept=True)
    again = HammersteinWiener.from_settings(json.loads(json.dumps(model.settings())))
    assert (again, hash(again), again.names) == (model, hash(model), model.names)


def swing(x, p, out):
    out[0] = x + p[0] * np.sin(x)
    out[1] = np.tanh(x)


def swing_slopes(x, p, out):
    out[0] = 1.0 + p[0] * np.cos(x)
    out[1] = 1.0 - np.tanh(x) ** 2


def test_functions_of_the_user(tmp_path):
    own = Functions(swing, swing_slopes, 2, (0.3,), ("sway", "bend"))
    np.testing.assert_allclose(own.value([0.5])[0], [0.5 + 0.3 * np.sin(0.5), np.tanh(0.5)])
    model = HammersteinWiener(1, 1, output=own)
    rng = np.random.default_rng(8)
    s = simulate(model, [-0.5], [0.5], d=[0.4], T=100, rng=rng)
    run = track(model, Kalman(q=0.0, r=1e-6, p0=1e6), s.y, s.u)
    np.testing.assert_allclose(run.theta[-1], s.theta[-1], atol=1e-3)
    run.save(tmp_path / "run")
    assert Track.load(tmp_path / "run", classes=[swing, swing_slopes]).model == run.model == model.bind(1)

"""The unit of y is the user's: with ranges, knots and noises in that unit, results are the same but for the unit."""

from __future__ import annotations

import numpy as np
import pytest

from driftfit import AdaptiveKalman, ExtendedKalman, HammersteinWiener, Kalman, Legendre, OutputError, track
from driftfit.models.hammerstein_wiener.basis import Functions, PiecewiseLinear

UNITS = (1e6, 1e-6)


def record():
    """A second-order curve on each side of a block of one lag; |y| is below 1.2."""
    rng = np.random.default_rng(1)
    u, w = rng.uniform(-1.0, 1.0, 400), np.zeros(400)
    v = u + 0.4 * u**2
    for t in range(2, 400):
        w[t] = 0.6 * w[t - 1] + (0.5 + 0.1 * (t > 200)) * v[t - 1] - 0.2 * v[t - 2]
    w += 0.01 * rng.normal(size=400)
    return np.sign(w) * (np.sqrt(1.0 + 2.0 * np.abs(w)) - 1.0), u


def curved(unit, noise=None):
    sigma = None if noise is None else noise * unit
    return HammersteinWiener(1, 2, input=Legendre(2, (-1, 1)), output=Legendre(2, (-1.2 * unit, 1.2 * unit)),
                             output_noise=sigma)  # fmt: skip


def without_unit(run, unit, of_b=1.0):
    """Results that do not depend on the unit of y; ``of_b`` is the unit of b, which is that of w."""
    units = np.array([of_b if name.startswith("b") else 1.0 for name in run.names])
    ahead = run.forecast(3, run.u[:3])
    return np.concatenate([
        (run.theta[50:] / units).ravel(), (run.std[50:] / units).ravel(), run.prediction[50:] / unit,
        ahead.y_hat / unit, ahead.y_std / unit, [run.loglik + np.isfinite(run.log_density).sum() * np.log(unit)],
    ])  # fmt: skip


TRACKERS = {
    "Kalman": lambda unit: (curved(unit), Kalman(q=1e-5, r=1e-4, p0=1e2, theta0=0.01)),
    "noise": lambda unit: (curved(unit, 0.01), Kalman(q=1e-6, r=1.0, p0=1e2, theta0=0.01)),
    "AdaptiveKalman": lambda unit: (curved(unit), AdaptiveKalman()),
    "ExtendedKalman": lambda unit: (curved(unit), ExtendedKalman(q=1e-6, r=1e-4, p0=0.5, theta0=0.1)),
    "OutputError": lambda unit: (curved(unit), OutputError(q=1e-6, r=1e-4 * unit**2, theta0=0.3)),
}


@pytest.mark.parametrize("first", [None, 0.0], ids=["", "begins with 0"])
@pytest.mark.parametrize("kind", TRACKERS)
def test_results_are_the_same_in_any_unit_of_y(kind, first):
    y, u = record()
    y[0] = y[0] if first is None else first
    expected = without_unit(track(*TRACKERS[kind](1.0), y, u), 1.0)
    assert np.isfinite(expected).all()
    for unit in UNITS:
        found = without_unit(track(*TRACKERS[kind](unit), y * unit, u), unit)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("output", [None, [-0.3, 0.3]])
def test_measurement_noise_has_the_unit_of_the_output(output):
    """w has the unit of y: 1e-4 was added to the variance of its error, whatever the unit."""
    y, u = record()

    def run(unit):
        b = np.array([1.0, unit, unit, unit, unit] + [1.0] * (0 if output is None else 4))
        bends = None if output is None else PiecewiseLinear([knot * unit for knot in output])
        model = HammersteinWiener(1, 2, input=Legendre(2, (-1, 1)), output=bends, output_noise=0.01 * unit)
        weights = np.concatenate([b[:3], b[5:7], b[3:5], b[7:]])
        return track(model, Kalman(q=1e-6 * weights**2, r=1.0, p0=1e2 * weights**2), y * unit, u)

    expected = without_unit(run(1.0), 1.0)
    for unit in UNITS:
        np.testing.assert_allclose(without_unit(run(unit), unit, of_b=unit), expected, rtol=1e-5, atol=1e-7)


def test_one_output_does_not_give_the_grid_its_scale():
    """A first output near 0 did: the slope of the curve was that of a narrow grid, and estimates stayed far away."""
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u, w, y = rng.normal(size=800), 0.0, np.zeros(800)
        for t in range(1, 800):
            w = 0.6 * w + u[t - 1]
            y[t] = 2.0 * np.arctan(0.5 * w) + 0.05 * rng.normal()
        model = HammersteinWiener(1, 1, output=Legendre(3, (-4.0, 4.0)))
        run = track(model, OutputError(q=1e-6, r=0.0025, theta0=0.3), y, u)
        errors.append(np.sqrt(np.mean(run.innovation[300:] ** 2)))
    assert max(errors) < 0.1  # .2 before


def values(x, p, out):
    out[0] = np.log(x)


def slopes(x, p, out):
    out[0] = 1.0 / x


def test_functions_that_are_not_defined_at_zero_have_a_scale():
    basis = Functions(values, slopes)
    assert (basis.height, basis.steepness) == (1.0, 1.0)
    assert Legendre(2, (-4.0, 4.0)).steepness == pytest.approx(1.5 / 4.0)

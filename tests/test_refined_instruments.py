"""Refined instrumental variables and estimation off line: a slow twin, the bound of Cramer and Rao, all modes."""

import numpy as np
import pytest
from scipy import signal
from support import same

from driftfit import ARX, OE, RLS, BoxJenkins, InstrumentalVariables, Live, PolynomialModel, track
from driftfit.run.parallel_lanes import FEWEST_LANES

BJ, THETA = BoxJenkins(1, 1, 1, 1), np.array([1.0, 0.5, 0.9, 0.8])  # b, c, d, f


def plant(T, seed, noise=0.5, theta=THETA, offset=0.0):
    b, c, d, f = theta
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=T), noise * rng.normal(size=T)
    return signal.lfilter([0.0, b], [1.0, -f], u) + signal.lfilter([1.0, c], [1.0, -d], e) + offset, u


def twin(y, u, point, p0):
    """One pass of the iterative method, for BJ linearised at a point, with signals that are 0 before the record."""
    b, c, d, f = point

    def prefiltered(x):
        return signal.lfilter([1.0, -d], np.convolve([1.0, c], [1.0, -f]), x)

    def late(x):
        return np.r_[0.0, x[:-1]]

    w = signal.lfilter([0.0, b], [1.0, -f], u)
    v = y - w
    e = signal.lfilter([1.0, -d], [1.0, c], v)
    of_noise = [late(signal.lfilter([1.0], [1.0, c], x)) for x in (e, v)]
    phi = np.column_stack([late(prefiltered(u)), *of_noise, late(prefiltered(y))])
    zeta = np.column_stack([late(prefiltered(u)), *of_noise, late(prefiltered(w))])
    target = prefiltered(y) + phi[:, 1:3] @ [c, d]
    phi, zeta, target = phi[1:], zeta[1:], target[1:]
    return np.linalg.solve(np.eye(4) / p0 + zeta.T @ phi, zeta.T @ target)


def test_a_pass_at_a_point_is_its_slow_twin():
    y, u = plant(800, 0)
    point = (0.8, 0.3, 0.7, 0.7)
    run = track(BJ.held_at(point), InstrumentalVariables(1.0, p0=100.0), y, u)
    np.testing.assert_allclose(run.theta[-1], twin(y, u, point, 100.0), rtol=1e-8)


@pytest.mark.parametrize("tracker", [RLS(1.0), InstrumentalVariables(1.0)], ids=["RLS", "instruments"])
def test_off_line_the_estimate_reaches_the_bound_of_cramer_and_rao(tracker):
    """40 records: scatter and reported deviation, compared with the bound from the gradient at the truth."""
    T = 800
    theta, std = [], []
    for seed in range(40):
        run = track(BJ, tracker, *plant(T, seed)).refine()
        theta.append(run.theta[-1])
        std.append(run.std[-1])
    rng = np.random.default_rng(0)
    b, c, d, f = THETA
    u, e = rng.normal(size=200_000), 0.5 * rng.normal(size=200_000)
    of_u = signal.lfilter([0.0, 1.0, -d], np.convolve([1.0, c], [1.0, -f]), u)
    of_f = signal.lfilter([0.0, b], [1.0, -f], of_u)
    psi = [of_u, signal.lfilter([0.0, 1.0], [1.0, c], e), signal.lfilter([0.0, 1.0], [1.0, -d], e), of_f]
    bound = np.sqrt(0.25 / T * np.diag(np.linalg.inv(np.cov(psi))))
    np.testing.assert_allclose(np.std(theta, axis=0), bound, rtol=0.3)
    np.testing.assert_allclose(np.median(std, axis=0), bound, rtol=0.1)
    assert (np.abs(np.mean(theta, axis=0) - THETA) < 3.0 * bound / np.sqrt(40)).all()


def test_a_wrong_model_of_the_noise_does_no_harm():
    """The noise resonates, for which the model has no order; ARX sends it through the plant."""
    errors, biased = [], []
    for seed in range(20):
        y, u = plant(1500, seed, noise=0.0)
        y += signal.lfilter([0.2], [1.0, -1.8, 0.9], np.random.default_rng(100 + seed).normal(size=1500))
        errors.append(track(BJ, InstrumentalVariables(1.0), y, u).theta[-1, 3] - 0.8)
        biased.append(track(ARX(1, 1), RLS(1.0), y, u).theta[-1, 0] - 0.8)
    assert abs(np.mean(errors)) < 2.0 * np.std(errors) / np.sqrt(20)
    assert np.std(errors) < 0.022
    assert abs(np.mean(biased)) > 0.03


def test_two_inputs_with_denominators_of_their_own_and_a_large_offset():
    rng = np.random.default_rng(4)
    u, e = rng.normal(size=(2500, 2)), 0.5 * rng.normal(size=2500)
    y = signal.lfilter([0.0, 1.0], [1.0, -0.8], u[:, 0]) + signal.lfilter([0.0, 0.5], [1.0, 0.5], u[:, 1]) + e
    run = track(OE((1, 1), (1, 1), offset=True), InstrumentalVariables(1.0), y + 100.0, u)
    assert (np.abs(run.theta[-1] - [1.0, 0.5, 0.8, -0.5, 100.0]) < 3.5 * run.std[-1]).all()
    assert run.std[-1].max() < 0.04


def test_live_lanes_and_a_saved_stream_give_the_bits_of_the_record(tmp_path):
    """With missing outputs and inputs, and a gain that changes, which forgetting follows."""
    y, u = plant(600, 5)
    y[300:] += signal.lfilter([0.0, 1.0], [1.0, -0.8], u)[300:]
    y[100:110], u[200], y[250] = np.nan, np.nan, np.inf
    tracker = InstrumentalVariables(0.99)
    run, live = track(BJ, tracker, y, u), Live(BJ, tracker)
    for t in range(600):
        if t == 350:
            live.save(tmp_path / "stream")
            live = Live.load(tmp_path / "stream")
        live.update(y[t], u[t])
        assert same(live.theta, run.theta[t]), t
    count = max(FEWEST_LANES, tracker.width) + 1
    fleet = track(BJ, tracker, np.stack([y] * count), np.stack([u] * count), by="row")
    assert same(fleet[count - 1].theta, run.theta)
    assert np.isfinite(run.theta).all()
    assert abs(run.theta[-1, 0] - 2.0) < 0.3


def test_what_cannot_be_refined_says_so():
    y, u = plant(200, 6)
    with pytest.raises(ValueError, match="refine: ARX is not linearised"):
        track(ARX(1, 1), RLS(1.0), y, u).refine()
    with pytest.raises(ValueError, match="refine: the record does not determine all parameters"):
        track(BJ, RLS(1.0), y, 0.0 * u).refine()
    with pytest.raises(ValueError, match="point must have 4 entries"):
        PolynomialModel(0, 1, 1, 1, 1, inputs=1, point=(0.5,))
    with pytest.warns(UserWarning, match="after 1 passes a parameter still moves"):
        track(BJ, RLS(1.0), y, u).refine(passes=1)


@pytest.mark.parametrize("tracker", [RLS(1.0), InstrumentalVariables(1.0)], ids=["RLS", "instruments"])
def test_on_line_the_noise_is_not_learned_from_the_errors_of_an_unknown_plant(tracker):
    """The Box-Jenkins system of MATLAB's page on bj, where errors of C and D had medians of .4 to 1."""
    theta = np.array([1.0, 0.5, -1.0, 0.2, -1.5, -0.7, 1.5, -0.7])
    error, inside = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u, e = rng.choice([-1.0, 1.0], 1000), np.sqrt(0.1) * rng.normal(size=1000)
        y = signal.lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u)
        run = track(BoxJenkins(2, 2, 2, 2), tracker, y + signal.lfilter([1.0, -1.0, 0.2], [1.0, 1.5, 0.7], e), u)
        error.append(np.abs(run.theta[-1] - theta))
        inside.append(error[-1] < 1.96 * run.std[-1])
    assert np.median(error, axis=0)[2:6].max() < 0.12
    assert np.mean(inside) > 0.85


def test_estimates_that_went_astray_are_not_silent():
    """A slow room with disturbances of its own, which an output error model takes for noise of the reading."""
    rng, T = np.random.default_rng(1), 800
    heat, out = np.repeat((rng.uniform(size=T // 8) < 0.4) * 60.0, 8), 7.0 + np.cumsum(0.3 * rng.normal(size=T))
    u, y = np.c_[heat, out], np.full(T, 18.0)
    for t in range(1, T):
        y[t] = 0.97 * y[t - 1] + 0.003 * u[t - 1, 0] + 0.005 * u[t - 1, 1] + 0.4 + 0.09 * rng.normal()
    with pytest.warns(UserWarning, match=r"the estimates went astray\. Disturbances that pass through the plant"):
        track(OE((1, 1), (1, 1)), InstrumentalVariables(0.995), y, u)
    track(ARX(1, (1, 1), intercept=True), InstrumentalVariables(0.995), y, u)  # and no warning

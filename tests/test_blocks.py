"""Separation: exact products, gauges, generalised least squares, and what the methods do when it becomes hard."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from support import same

from driftfit import AugmentedFLS, Kalman, Live, Regression, track
from driftfit.models.hammerstein_wiener.basis import Legendre, Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.separation import METHODS, LeastSquares, split
from driftfit.models.hammerstein_wiener.structure import Structure
from driftfit.systems.hammerstein_wiener import simulate

SMALL = HammersteinWiener(1, 2, input=Polynomial(2), output=Polynomial(2))
K = Kalman(q=1e-6, r=1e-4, p0=1e2, theta0=0.01)


def model_of(na, nb, n_in, n_out, intercept=False):
    return HammersteinWiener(
        na, nb, input=Legendre(n_in, (-1, 1)), output=Legendre(n_out, (-1, 1)), intercept=intercept
    )


def record(T=300, seed=0):
    rng = np.random.default_rng(seed)
    return simulate(
        SMALL, [-0.5], [0.5, -0.3], [0.3], [0.1], T=T, rng=rng, u=rng.uniform(-1, 1, T), equation_noise=0.01
    )


@given(
    na=st.integers(0, 4), nb=st.integers(1, 4), n_in=st.integers(1, 5), n_out=st.integers(1, 5), seed=st.integers(0, 99)
)
def test_exact_products_come_apart_exactly(na, nb, n_in, n_out, seed):
    """Item 5 of the specification."""
    model = model_of(na, nb, n_in, n_out)
    rng = np.random.default_rng(seed)
    xi = rng.uniform(0.2, 1.0, (3, model.structure.n_x)) * rng.choice([-1.0, 1.0], (3, model.structure.n_x))
    theta = model.structure.products(xi)
    for method in METHODS[:3]:
        a, b, c, d, quality = split(model, theta, method)
        if method == "svd" and na == 0:
            assert same(d[:, 1:], theta[:, nb : nb + n_out - 1])
        found = model.structure.minimal(a, b * c[:, :1], c / c[:, :1], d)
        assert_allclose(found, xi, rtol=1e-10, atol=1e-10)
        assert_allclose(np.linalg.norm(c, axis=1), 1.0, rtol=1e-14)
        assert (c @ model.rise >= 0.0).all()
        assert (d[:, 0] == 1.0).all()
        if method != "average":
            assert quality.max() < 1e-12


def test_the_joint_fit_is_the_least_squares_fit_with_a_known_corner():
    from scipy.optimize import minimize

    model = model_of(2, 1, 1, 3)
    theta = np.random.default_rng(3).normal(size=(1, model.n)) * 0.3
    a, _, _, d, _ = split(model, theta, "svd-joint")
    A = np.concatenate([theta[0, :2], theta[0, 5:9]]).reshape(3, 2).T
    target = np.vstack([[1.0, *theta[0, 3:5]], A])

    def off(x):
        return np.sum((np.outer([1.0, *x[:2]], [1.0, *x[2:]]) - target)[np.s_[:]] ** 2)

    found = minimize(off, np.concatenate([a[0], d[0, 1:]]), options={"gtol": 1e-12})
    assert_allclose(np.concatenate([a[0], d[0, 1:]]), found.x, atol=1e-5)
    assert off(np.concatenate([a[0], d[0, 1:]])) <= found.fun + 1e-12


@pytest.mark.parametrize("intercept", [False, True])
def test_the_jacobian_against_differences(intercept):
    """Item 6: central differences, and the compiled one."""
    structure = Structure(2, (3, 1), (3, 2), 4, intercept)
    xi = np.random.default_rng(1).normal(size=structure.n_x)
    J = structure.jacobian(xi)
    for x in range(structure.n_x):
        step = 1e-6 * (np.arange(structure.n_x) == x)
        numeric = (structure.products(xi + step) - structure.products(xi - step)) / 2e-6
        assert_allclose(J[:, x], numeric, atol=1e-7)
    a, b, c, d = structure.groups(xi)
    zeta = np.concatenate([a, b, c, d[1:], xi[structure.n_x - intercept :]])
    leads = len(a) + len(b) + structure.leads
    free = structure.jacobian(zeta)
    assert same(np.delete(free, leads, axis=1), J)
    assert_allclose(free[2:5, leads[0]], b[:3])  # what c_1 moves, which xi does not have
    assert_allclose(structure.products(zeta), structure.products(xi), atol=1e-15)


def test_generalised_least_squares():
    """Item 6: never worse than where it began, stationary, its covariance that of the delta method."""
    s = record()
    run = track(SMALL, K, s.y, s.u, keep="cov")
    joint, gls = run.blocks(), run.blocks("gls")
    structure = SMALL.structure
    for t in (20, 100, 299):
        W = np.linalg.inv(run.cov(t))

        def cost(xi, t=t, W=W):
            off = run.theta[t] - structure.products(xi)
            return off @ W @ off

        assert gls.cost[t] == pytest.approx(cost(gls.xi[t]), rel=1e-5)
        assert cost(gls.xi[t]) <= cost(joint.xi[t])
        J = structure.jacobian(gls.xi[t])
        slope = J.T @ W @ (run.theta[t] - structure.products(gls.xi[t]))
        assert np.abs(slope / np.sqrt(np.diag(J.T @ W @ J))).max() < 1e-3
        assert_allclose(gls.xi_cov[t], np.linalg.inv(J.T @ W @ J), rtol=1e-5, atol=1e-12)
        assert np.linalg.eigvalsh(gls.xi_cov[t]).min() > 0.0
        assert_allclose(gls.cov[t], gls.cov[t].T, rtol=1e-12, atol=1e-18)
        assert np.abs(gls.cov[t, 3:5, 3:5] @ gls.c[t]).max() < 1e-12  # |c| = 1 does not move
    replayed = track(SMALL, K, s.y, s.u).blocks("gls")
    assert_allclose(replayed.xi, gls.xi, rtol=1e-12, atol=1e-12)
    assert gls.gauge("c1").std.c[:, 0].max() < 1e-12 * gls.std.c[20:].min()
    zeta, cov, _ = LeastSquares(SMALL.structure).refine(np.ones((1, 7)), np.full((1, 7, 7), np.inf), np.ones((1, 6)))
    assert same(zeta, np.ones((1, 6)))
    assert np.isnan(cov).all()
    with pytest.raises(ValueError, match="carries none"):
        track(SMALL, AugmentedFLS(1.0), s.y, s.u).blocks("gls")


@pytest.mark.parametrize("method", ["svd-joint", "gls"])
def test_blocks_of_the_smoothed_path(method):
    """After the last sample smoothed and filtered estimates are one; without drift it is that of all samples."""
    s = record(200)
    run = track(SMALL, K, s.y, s.u)
    path, filtered = run.smooth().blocks(method), run.blocks(method)
    assert_allclose(path.xi[-1], filtered.xi[-1], rtol=1e-6)
    if method == "gls":
        assert_allclose(path.xi_cov[-1], filtered.xi_cov[-1], rtol=1e-4, atol=1e-12)
        assert (path.std.b[:150] < filtered.std.b[:150]).all()
    constant = track(SMALL, replace(K, q=0.0), s.y, s.u)
    assert_allclose(constant.smooth().blocks(method).xi, np.tile(constant.blocks(method).xi[-1], (200, 1)), rtol=1e-5)
    with pytest.raises(ValueError, match="has no blocks"):
        track(Regression(1), Kalman(q=0.0, r=1.0), s.y, s.u).smooth().blocks()


def test_gauges_describe_one_system():
    s = record()
    found = track(SMALL, K, s.y, s.u).blocks("gls")
    u, y = np.linspace(-1, 1, 4), np.linspace(-0.5, 0.5, 4)
    t = 200
    xi, cov, spread = found.xi[t], found.xi_cov[t], found.gauge("c1").std
    assert_allclose(np.sqrt(np.diag(cov)), np.r_[spread.a[t], spread.b[t], spread.c[t, 1], spread.d[t, 1]])
    choices = [(input, output) for input in ("unit", "c1", "b1") for output in ("d1", "unit", "slope")]
    for input, output in choices[1:]:
        other = found.gauge(input, output, at=0.2)
        scale = found.output_curve(y, t) / other.output_curve(y, t)
        assert_allclose(scale, scale[0])
        assert_allclose(
            np.outer(other.input_curve(u, t), other.b[t]) * scale[0], np.outer(found.input_curve(u, t), found.b[t])
        )
        assert same(other.a, found.a)
        if input == "b1":
            assert same(other.b[:, 0], np.ones(len(other)))
            assert other.std.b[t, 0] < 1e-9 * found.std.b[t, 0] + 1e-12
        fixed = {"slope": other.slope(0.2), "unit": np.linalg.norm(other.d, axis=1), "d1": other.d[:, 0]}[output]
        assert_allclose(fixed, 1.0, rtol=1e-14)
        rng = np.random.default_rng(0)  # the delta method against draws
        draws = rng.multivariate_normal(xi, cov * 1e-6, 20_000)
        _, b, c, d = SMALL.structure.groups(draws)
        level = {"slope": d @ SMALL.out.derivative(0.2), "unit": np.linalg.norm(d, axis=1), "d1": 1.0}[output]
        gain = {"b1": b[:, 0] / level, "unit": 1.0 / np.linalg.norm(c, axis=1), "c1": 1.0}[input]
        gain, level = np.broadcast_to(gain, len(b)), np.broadcast_to(level, len(b))
        for drawn, std in (
            (c[:, 1] * gain, other.std.c),
            (d[:, 1] / level, other.std.d),
            (b[:, 1] / level / gain, other.std.b),
        ):
            assert np.std(drawn) * 1e3 == pytest.approx(std[t, 1], rel=0.03, abs=1e-12)
        back = other.gauge()  # from anywhere to anywhere
        for part, whole in zip((*back.std, back.c, back.cov), (*found.std, found.c, found.cov), strict=True):
            assert_allclose(part, whole, rtol=1e-6, atol=1e-9)
        assert_allclose(other.xi, found.xi, rtol=1e-12)
    assert same(track(SMALL, K, s.y, s.u).blocks(input="b1").b[:, 0], found.gauge("b1").b[:, 0])


def test_a_vanishing_b_spikes_in_the_average_alone():
    theta = SMALL.structure.products(np.array([[-0.5, 1e-4, 0.6, 0.5, 0.2]]))
    theta[:, 4] += 0.01  # b_1 c_2
    exact = np.array([0.0001, 0.6])
    _, b, c, _, _ = split(SMALL, theta, "svd-joint")
    assert_allclose(b[0] * c[0, 0], exact, atol=0.02)
    _, _, c, _, _ = split(SMALL, theta, "average")
    assert np.abs(c[0, 1] / c[0, 0]) > 10.0
    s = simulate(SMALL, [-0.5], [0.001, 0.5], [0.3], [0.1], T=100, rng=np.random.default_rng(1))
    run = track(SMALL, K, s.y, s.u)
    with pytest.warns(UserWarning, match="spikes"):
        run.blocks("average")
    run.blocks("svd-joint")


def test_a_weak_first_function_warns_of_the_gauge():
    xi = np.repeat([[-0.5, 1e-5, 2e-5, 1e5, 0.2]], 3, axis=0)
    s = record(T=40)
    run = track(SMALL, K, s.y, s.u)
    run.theta[:] = SMALL.structure.products(xi[:1])
    with pytest.warns(UserWarning, match='bad gauge here.*use input="unit"'):
        run.blocks(input="c1")
    assert_allclose(run.blocks().c, [[1e-5, 1.0]] * 40, rtol=1e-9)  # without a warning


def test_what_is_undetermined_stays_finite():
    """All b near zero: c is undetermined, and the quality shows it."""
    model = model_of(1, 2, 3, 2)
    theta = np.zeros((2, model.n))
    theta[1] = 1e-9 * np.random.default_rng(2).normal(size=model.n)
    for method in METHODS[:3]:
        a, b, c, d, quality = split(model, theta, method)
        assert all(np.isfinite(part).all() for part in (a, b, c, d)), method
    assert quality[1, 0] > 0.01
    bad = split(model, np.full((1, model.n), np.nan), "svd-joint")
    assert np.isnan(bad[1]).all() or np.isnan(bad[4]).any()


def test_live_blocks_are_those_of_the_record():
    s = record(T=120)
    run, live = track(SMALL, K, s.y, s.u), Live(SMALL, K)
    found = {method: run.blocks(method) for method in METHODS[:3]}
    for t in range(120):
        live.update(float(s.y[t]), float(s.u[t]))
        for method, path in found.items():
            now = live.blocks(method)
            for part, whole in zip(now, (path.a, path.b, path.c, path.d), strict=True):
                assert same(part, whole[t])
    with pytest.raises(ValueError, match="'svd-joint'"):
        live.blocks("gls")


def test_names_and_refusals():
    s = record(T=60)
    run = track(SMALL, K, s.y, s.u)
    found = run.blocks()
    assert found.names == (("A1",), ("b1", "b2"), ("c1", "c2"), ("d1", "d2"))
    assert found.radius[-1] == pytest.approx(abs(found.a[-1, 0]))
    assert len(found) == 60
    assert np.isnan(found.std.b).all()
    with pytest.raises(ValueError, match="method must be one of"):
        run.blocks("pca")
    with pytest.raises(ValueError, match="Regression has no blocks"):
        track(Regression(1), AugmentedFLS(1.0), s.y, s.u).blocks()
    with pytest.raises(ValueError, match="output must be one of"):
        run.blocks(output="c1")


def test_the_picture_has_its_panels():
    s = record(T=120)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = track(SMALL, K, s.y, s.u).plot_blocks("gls", times=[50, -1])
    assert [axis.get_ylabel() for axis in figure.axes] == ["v", "y", "a", "b", "c", "d"]
    found = track(SMALL, K, s.y, s.u).blocks("gls")
    for line, other, t in zip(figure.axes[0].lines, figure.axes[1].lines, (50, -1), strict=True):
        assert_allclose(line.get_ydata(), found.input_curve(line.get_xdata(), t))
        assert_allclose(other.get_xdata(), found.output_curve(other.get_ydata(), t))
    for axis, group in zip(figure.axes[2:], (found.a, found.b, found.c, found.d[:, 1:]), strict=True):
        assert same(np.stack([line.get_ydata() for line in axis.lines], axis=1), group)


def test_every_input_has_a_panel():
    """The first was drawn alone."""
    rng = np.random.default_rng(3)
    u = rng.uniform(-1.0, 1.0, (120, 2))
    y = np.convolve(u[:, 0] + 0.5 * u[:, 0] ** 2 - u[:, 1], [0.0, 1.0, 0.5])[:120] + 0.01 * rng.normal(size=120)
    run = track(HammersteinWiener(1, 1, input=[Polynomial(2), None]), K, y, u)
    figure = run.plot_blocks(times=[-1])
    assert [axis.get_ylabel() for axis in figure.axes] == ["v", "v", "y", "a", "b", "c", "d"]
    assert [axis.get_title() for axis in figure.axes[:3]] == ["block of u1", "block of u2", "output block"]
    found = run.blocks()
    for i, axis in enumerate(figure.axes[:2]):
        (line,) = axis.lines
        assert_allclose(line.get_ydata(), found.input_curve(line.get_xdata(), -1, i))

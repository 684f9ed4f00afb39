"""The exact smoother in little memory: its solution takes the place of its problem, which can be collected again."""

import tracemalloc

import numpy as np
import pytest
from test_smoother_exact import record, walk

from driftfit import FLS, Regression, track
from driftfit.smooth import exact
from driftfit.smooth.problem import walk_of


def test_the_smoother_needs_little_memory_in_addition_to_its_result():
    phi, y = record(20_000, 4)
    run = track(Regression(4), FLS(30.0), y, phi)
    run.smooth()
    tracemalloc.start()
    smoothed = run.smooth()
    held, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert smoothed.method == "fast"
    output = 20_000 * 8 * 2 * 4
    assert held < 1.1 * output
    assert most < 1.2 * output


def test_the_problem_is_collected_again_where_it_is_asked_for():
    phi, y = record(200, 3)
    y[[3, 50]] = np.nan
    run = track(Regression(3), FLS(30.0), y, phi)
    smoothed, walk, kept = run.smooth(), walk_of(run), run.smooth("fit")
    for name in ("theta", "std", "residual", "loo", "leverage", "weight"):
        assert np.array_equal(getattr(smoothed, name), getattr(kept, name), equal_nan=True), name
    assert all(np.array_equal(a, b) for a, b in zip(smoothed.walk, walk, strict=True) if isinstance(a, np.ndarray))
    assert np.array_equal(smoothed.weight, walk.weight)
    fast = track(Regression(3), FLS(1e-4), y, phi)  # the fast method fails at the end
    assert np.array_equal(fast.smooth().theta, exact.smooth(walk_of(fast)).theta)
    kept = run.smooth("cov")
    for t in (0, 60, 199):
        np.testing.assert_allclose(smoothed.cov(t), kept.cov(t), rtol=1e-9)


@pytest.mark.parametrize(("n", "mu", "method"), [(1, 30.0, "fast"), (3, 30.0, "fast"), (3, 1e-4, "safe")])
def test_the_solution_may_take_the_place_of_the_problem(n, mu, method):
    """Also where the fast method finds out at the end that it failed, and the problem is needed again."""
    phi, y = record(200, n)
    problem, asked = walk(phi, y, mu), []
    expected = exact.smooth(problem)
    found = exact.smooth(problem._replace(phi=phi.copy()), "std", lambda: asked.append(1) or walk(phi, y, mu))
    assert (expected.method, found.method, len(asked)) == (method, method, 1 if method == "safe" else 0)
    assert np.array_equal(found.theta, expected.theta)
    assert np.array_equal(found.var, expected.var)
    assert (found.cost, found.measurement_cost, found.spread) == expected[4:7]
    assert expected.measurement_cost == pytest.approx(np.sum((expected.rho * expected.c) ** 2))
    assert expected.spread == pytest.approx(np.sum(1.0 - expected.c**2))

"""Parameters that one cause moves together: their direction is learned."""

import numpy as np
import pytest

from driftfit import AdaptiveKalman, Kalman, Live, Regression, track
from driftfit.trackers.parts.modes.drifts.one_direction import ASSUMED, STEPS, B, M
from driftfit.trackers.parts.modes.weights import ASSUMED as P
from driftfit.trackers.parts.modes.weights import BLOCK, FADE, PHI, PRECISION, SPAN, WINDOW, E

COMMON = np.array([1.0, 0.7, -0.5, 0.9])


def one_walk(seed, T=1000):
    """y, u and theta (T, 4), which follows one random walk."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=4) + np.cumsum(0.03 * rng.normal(size=T))[:, None] * COMMON
    u = rng.normal(size=(T, 4))
    return np.sum(u * theta, axis=1) + 0.3 * rng.normal(size=T), u, theta


def test_one_common_walk_is_followed_nearly_as_if_its_direction_were_known():
    over = []
    for seed in range(6):
        y, u, theta = one_walk(seed)
        known = Kalman(q=0.03**2 * np.outer(COMMON, COMMON), r=0.09)
        own, best = (track(Regression(4), one, y, u).theta for one in (AdaptiveKalman(), known))
        over.append(np.mean((own - theta)[200:] ** 2) / np.mean((best - theta)[200:] ** 2))
    assert np.sqrt(np.median(over)) < 1.3


def test_a_pass_against_matrices():
    """B, M and the direction after a pass in numpy, from the samples that are stored."""
    y, u, _ = one_walk(0)
    live, passes, after = Live(Regression(4), AdaptiveKalman()), 0, None
    for t in range(500):
        before, after = after, {name: np.array(value) for name, value in live.lane().items()}
        passes += before is not None and not np.array_equal(before["direction"], after["direction"])
        if passes == 3:
            break
        live.update(y[t], u[t])
    newest, v = int(before["remembered"]), before["direction"]
    r, N, moved, span, block = np.zeros(4), np.zeros((4, 4)), np.zeros((4, 4)), 0.0, np.zeros((4, 4))
    for back in range(WINDOW):
        sample, k = after["samples"][(newest - back) % WINDOW], after["gains"][(newest - back) % WINDOW]
        x = sample[PHI:]
        r = x * sample[E] + r - x * (k @ r)
        N = np.outer(x, x) * sample[PRECISION] + (np.eye(4) - np.outer(x, k)) @ N @ (np.eye(4) - np.outer(k, x))
        if back >= WINDOW - BLOCK:
            span += sample[SPAN]
            moved += sample[SPAN] * (np.outer(r, r) - N)
            block += sample[SPAN] * N
    assumed = np.diag(after["scores"][P]) + after["moments"][ASSUMED, 0] * np.outer(v, v)
    b = FADE * before["moments"][B::3] + moved + block @ assumed @ block / span
    m = FADE * before["moments"][M::3] + block
    np.testing.assert_allclose(after["moments"][B::3], b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
    np.testing.assert_allclose(after["moments"][M::3], m, rtol=1e-9, atol=1e-9 * np.abs(m).max())
    for _ in range(STEPS):
        v = np.linalg.solve(m, (b + m) @ v)
        v /= np.linalg.norm(v)
    np.testing.assert_allclose(after["direction"], v, rtol=1e-9)


def test_a_regressor_that_repeats_another_and_one_that_is_idle_leave_a_finite_direction():
    y, u, _ = one_walk(1, 400)
    u[:, 1], u[:, 3] = 2.0 * u[:, 0], 0.0
    with pytest.warns(UserWarning, match="could not be learned"):
        run = track(Regression(4), AdaptiveKalman(), y, u)
    direction = run.state["direction"]
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert direction[3] == 0.0
    assert np.isfinite(run.theta).all()

"""The parts of `AdaptiveKalman` against plain NumPy: a sample, the interaction, the pass of scores."""

import naive
import numpy as np
import pytest

from driftfit import ARX, AdaptiveKalman, Live, Regression, track
from driftfit.trackers.mixture.filters import ASSUMED, COMMON, DIRECTION, JUMPS, A, B, M, table
from driftfit.trackers.mixture.learned import BLOCK, FADE, PHI, PRECISION, WINDOW, E


def record(T=400, n=3, seed=0, walk=0.05):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, n)) + np.array([30.0, *np.zeros(n - 1)])
    theta = np.cumsum(walk * rng.normal(size=(T, 1)), axis=0) * np.arange(1.0, n + 1.0) + 1.0
    theta[T // 2 :, 0] += 2.0
    y = np.sum(u * theta, axis=1) + 5.0 + 0.3 * rng.normal(size=T)
    y[T // 3] += 30.0
    return y, u


def lanes(y, u, model, tracker, at):
    """Fields of a stream before and after the samples ``at``."""
    live, found = Live(model, tracker, gate=False), {}
    for t in range(len(y)):
        if t in at:
            found[t] = [{name: np.array(value) for name, value in live.lane().items()}]
        live.update(y[t], u[t])
        if t in at:
            found[t].append({name: np.array(value) for name, value in live.lane().items()})
    return found


@pytest.mark.parametrize("groups", [None, [[0, 2], [1]]])
def test_a_sample_and_the_interaction_against_matrices(groups):
    (y, u), model, leaps = record(walk=0.005), Regression(3, intercept=True), []
    for t, (one, two) in lanes(y, u, model, AdaptiveKalman(groups=groups), (40, 133, 134, 200, 201, 399)).items():
        phi, left = two["white"], y[t] - float(two["explained"])  # without the part of the noise that is known
        mu, m, C, joint = naive.sample(one, phi, left)
        assert two["s"] == pytest.approx(naive.expected(one, phi)[1], rel=1e-8)
        leaps.append((left - naive.expected(one, phi)[0]) ** 2 > JUMPS * one["r"])
        prior, mean, cov, T = naive.interaction(one, mu, m, C)
        np.testing.assert_allclose(two["mu"], prior, rtol=1e-6, atol=1e-12)
        size = np.sqrt(np.einsum("kii->ik", cov))
        np.testing.assert_allclose((two["m"] - mean) / size, 0.0, atol=1e-5)
        np.testing.assert_allclose(np.moveaxis(naive.full(two["C"]), -1, 0), cov, rtol=1e-5, atol=1e-7 * cov.max())
        # E(v^2 | y) of ordinary noise
        x, moved, before, v = naive.after_jump(one, phi, left)
        e2, h = (left - x @ moved) ** 2, np.einsum("i,kij,j->k", x, before, x)
        moment = sum((joint[j] * (v[j] * h / (h + v[j]) + (v[j] / (h + v[j])) ** 2 * e2)).sum() for j in (0, 1))
        step = (moment / one["r"] - joint[:2].sum()) / min(one["count"] + 2.0, 70.0)
        assert two["r"] == pytest.approx(one["r"] * np.exp(np.clip(step, -1.0, 1.0)), rel=1e-8)
        np.testing.assert_allclose(T.sum(axis=1), 1.0, rtol=1e-12)
    assert any(leaps)


def test_the_table_of_modes():
    modes = table(4, None)
    assert len(modes["ratio"]) == 15 + 4 * 4
    assert modes["start"].sum() == pytest.approx(1.0)
    assert modes["arrive"][modes["ratio"] >= 1.0].sum() == pytest.approx(2e-3)
    assert modes["alone"].tolist() == [[15, 19, 23, 27], [19, 23, 27, 31]]
    assert (modes["ratio"][: len(COMMON)] == COMMON).all()
    assert len(table(9, None)["ratio"]) == len(table(1, None)["ratio"]) == 15


def test_a_pass_of_scores_against_matrices():
    y, u = record(n=4)
    live, passes, after = Live(Regression(4), AdaptiveKalman()), 0, None
    for t in range(400):
        before, after = after, {name: np.array(value) for name, value in live.lane().items()}
        passes += before is not None and not np.array_equal(before["sums"][DIRECTION], after["sums"][DIRECTION])
        if passes == 3:
            break
        live.update(y[t], u[t])
    newest = int(before["remembered"])
    (r, right), (N, moved, block), squares = np.zeros((2, 4)), np.zeros((3, 4, 4)), 0
    p = after["sums"][ASSUMED]
    for back in range(WINDOW):
        one = after["samples"][(newest - back) % WINDOW]
        x, k = one[PHI:].reshape(2, 4)
        r = x * one[E] + r - x * (k @ r)
        N = np.outer(x, x) * one[PRECISION] + (np.eye(4) - np.outer(x, k)) @ N @ (np.eye(4) - np.outer(k, x))
        if back >= WINDOW - BLOCK:
            moved, block = moved + np.outer(r, r) - N, block + N
            right, squares = right + r**2 - np.diag(N) + N**2 @ p, squares + N**2
    b = FADE * before["sums"][B::6] + moved + block @ np.diag(p) @ block / BLOCK
    m = FADE * before["sums"][M::6] + block
    near = {"rtol": 1e-8, "atol": 1e-9 * np.abs(b).max()}
    np.testing.assert_allclose(after["sums"][B::6], b, **near)
    np.testing.assert_allclose(after["sums"][M::6], m, **near)
    np.testing.assert_allclose(after["sums"][A::6], FADE * before["sums"][A::6] + squares, **near)
    root = np.linalg.cholesky(m + np.diag(np.diag(m)) * 1e-6)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, b).T))
    a = np.linalg.solve(root.T, vectors[:, -1])
    a *= np.sqrt(values[-1] / values[values > 0.0].sum()) / np.abs(a).max()
    own = after["sums"][DIRECTION]
    np.testing.assert_allclose(own * np.sign(own @ a), a, rtol=1e-4, atol=1e-4)


def test_a_regressor_that_repeats_another_and_one_that_is_idle_leave_a_finite_drift():
    y, u = record(n=4)
    u[:, 1], u[:, 3] = 2.0 * u[:, 0], 0.0
    with pytest.warns(UserWarning, match="could not be learned"):
        run = track(Regression(4), AdaptiveKalman(), y, u)
    assert np.isfinite(run.state["sums"][DIRECTION]).all()
    assert np.isfinite(run.theta).all()


def test_rare_pulses_whose_gain_jumps_twice():
    """The second jump was forbidden for good by the first."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u = (rng.random(1500) < 0.02) * 1.0
        gain = np.repeat([5.0, 1.0, 4.0], 500)
        run = track(Regression(1), AdaptiveKalman(), gain * u + 0.1 * rng.normal(size=1500), u)
        last = np.flatnonzero(u)[-1]
        assert abs(run.theta[last, 0] - 4.0) < 4.0 * run.std[last, 0]
        assert run.std[last, 0] < 0.5
        assert np.mean(np.abs(run.theta[100:, 0] - gain[100:]) < 5.0 * run.std[100:, 0]) > 0.96  # pulses are rare


def test_a_plant_that_rests_first_in_hardly_any_noise():
    inside = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        std, u, y = np.where(np.arange(300) < 40, 0.001, 0.05), rng.normal(size=300), np.zeros(300)
        u[:40] = 0.0
        for t in range(1, 300):
            y[t] = 0.8 * y[t - 1] + 0.5 * u[t - 1] + std[t] * rng.normal()
        run = track(ARX(1, 1), AdaptiveKalman(), y, u)
        inside.append(np.abs(run.innovation[45:]) < 1.96 * run.innovation_std[45:])
    assert 0.91 < np.mean(inside) < 0.98  # was 0.61 to 0.73


@pytest.mark.parametrize("std", [0.15, 0.3, 0.6])
def test_readings_in_whole_numbers(std):
    """Least squares of an endless record are the truth; errors were up to fifty deviations."""
    rng = np.random.default_rng(1)
    x, e = np.zeros(40_000), std * rng.normal(size=40_000)
    for t in range(1, len(x)):
        x[t] = 0.9 * x[t - 1] + e[t]
    y = np.round(20.0 + x)
    truth = np.polyfit(y[:-1], y[1:], 1)
    run = track(ARX(1, 0, intercept=True), AdaptiveKalman(), y[:1000])
    off = run.theta[-1] - truth
    assert (np.abs(off) < 4.0 * run.std[-1]).all()
    assert abs(off[0]) < 0.15


def test_a_step_test_without_noise_and_levels_without_noise():
    u = (np.arange(200) > 100) * 1.0
    y = np.zeros(200)
    for t in range(2, 200):
        y[t] = 1.5 * y[t - 1] - 0.56 * y[t - 2] + 0.05 * u[t - 1] + 0.02 * u[t - 2]
    y += 1e-6 * np.random.default_rng(0).normal(size=200)
    run = track(ARX(2, 2), AdaptiveKalman(), y, u)
    np.testing.assert_allclose(run.theta[-1], [1.5, -0.56, 0.05, 0.02], atol=2e-3)  # was off by 0.03
    level, x = np.repeat([1.0, -2.0, 3.0, 0.5], 60), np.random.default_rng(2).normal(size=240)
    run = track(Regression(1, intercept=True), AdaptiveKalman(), level + x, x)
    np.testing.assert_allclose(run.theta[59::60, 1], [1.0, -2.0, 3.0, 0.5], atol=1e-4)

"""Local shrinkage: its steps against dense algebra, its draws against records drawn from its own model."""

import numpy as np
import pytest

from driftfit import FLS, Regression, local_shrinkage, track
from driftfit.smooth.local_shrinkage import Data, Scales, path_of, rescaled, sample
from driftfit.smooth.solvers.walk import NONE, Walk


def walk_of(phi, y, drift):
    signals = np.zeros((len(y), 3))
    signals[:, 0], signals[:, 1], signals[:, 2] = y, 1.0, drift
    return Walk(phi, signals, np.eye(2), np.zeros(2), None, None, NONE)


def drawn(rng, T=60, unit=1e-3):
    """A record of the model, with noise of variance 1."""
    sigma, tau = np.abs(rng.standard_cauchy((2, 2))) * unit**0.5
    jumps = tau * np.abs(rng.standard_cauchy((T, 1)) * rng.standard_cauchy((T, 2)))
    moves = np.hypot(sigma, jumps) * rng.standard_normal((T, 2))
    moves[0] = 0.0
    phi, theta = rng.standard_normal((T, 2)), np.cumsum(moves, axis=0)
    phi /= np.sqrt(np.mean(phi**2, axis=0))
    return phi, np.sum(phi * theta, axis=1) + rng.standard_normal(T), theta


def test_one_step_is_the_normal_distribution_of_the_dense_problem():
    """Rows that share an instant, intervals of different lengths, and both parts of the moves."""
    rng = np.random.default_rng(0)
    phi, y, _ = drawn(rng, 8)
    walk = walk_of(phi, y, np.array([0.0, 1.0, 0.0, 2.0, 1.0, 0.5, 0.0, 1.0]))
    data = Data.of(walk, phi, y)
    scales = Scales(*(rng.uniform(0.5, 2.0, shape) for shape in ((2, 2), (5, 1), (5, 2), (5, 1), (5, 2))))
    A = np.zeros((8, 6, 2))
    A[np.arange(8), data.at] = phi
    A = A.reshape(8, 12)
    D = np.diff(np.eye(12).reshape(12, 6, 2), axis=1).reshape(12, 10)
    variance = (scales.sizes[0] + scales.sizes[1] * scales.kappa * scales.lam) * np.array([[1, 2, 1, 0.5, 1]]).T
    P = A.T @ A / 0.3 + D / variance.ravel() @ D.T + np.diag(np.r_[np.full(2, data.weak), np.zeros(10)])
    paths = np.array([path_of(data, scales, 0.3, rng).ravel() for _ in range(4000)])
    error = np.linalg.cholesky(P).T @ (paths - np.linalg.solve(P, A.T @ y / 0.3)).T  # standard normal
    np.testing.assert_allclose(error @ error.T / 4000, np.eye(12), atol=0.1)
    np.testing.assert_allclose(error.mean(axis=1), 0.0, atol=0.07)
    path, jumps, after = rescaled(data, paths[0].reshape(6, 2), scales, 0.3, 1e-2, rng)
    share = (np.diff(path, axis=0) - jumps) / np.sqrt(after.sizes[0])  # a rescaled path keeps the shape of its parts
    again, more, later = rescaled(data, path, after._replace(lam=after.lam * 0.0), 0.3, 1e-2, rng)
    assert np.ptp(more) == 0.0, "where nothing can jump, all moves are those of the walk"
    whole = np.diff(path, axis=0) / np.sqrt(after.sizes[0])
    np.testing.assert_allclose(np.diff(again, axis=0) / np.sqrt(later.sizes[0]), whole * np.sign(np.sum(
        np.diff(again, axis=0) * whole, axis=0)), rtol=1e-9)  # fmt: skip
    assert np.isfinite(share).all()


def test_bands_cover_paths_that_are_drawn_from_the_model(monkeypatch):
    """Ranks of the truth among draws are uniform; so they were for 60 records: .947 and .503 of them."""
    ranks = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        phi, y, theta = drawn(rng)
        walk = walk_of(phi, y, np.r_[0.0, np.ones(59)])
        found = sample(walk, 200, 3, 300, rng, False)
        ranks.append(np.mean(found.theta < theta, axis=0))
    ranks = np.array(ranks)
    assert 0.9 < np.mean((ranks > 0.025) & (ranks < 0.975)) < 0.99
    assert 0.4 < np.mean((ranks > 0.25) & (ranks < 0.75)) < 0.6


@pytest.fixture(scope="module")
def jumping():
    """The gain jumps at 60 of 150 samples, the offset does not; ten readings are missing."""
    rng = np.random.default_rng(3)
    phi = np.column_stack([rng.standard_normal(150), np.ones(150)])
    theta = np.column_stack([np.where(np.arange(150) < 60, 1.0, 2.5), np.full(150, 5.0)])
    y = np.sum(phi * theta, axis=1) + 0.5 * rng.standard_normal(150)
    y[100:110] = np.nan
    return track(Regression(["gain", "offset"]), FLS(100.0), y, phi), theta


def test_a_jump_has_a_date_a_size_and_a_share(jumping):
    run, theta = jumping
    found = local_shrinkage(run, 300, burn_in=300)
    (event,) = found.events()
    assert (event.name, event.first <= 60 <= event.last, event.last - event.first < 8) == ("gain", True, True)
    assert abs(event.shift["gain"] - 1.5) < 3.0 * event.std["gain"]
    assert found.shares[:, 0].mean() > 0.9
    low, high = found.band()
    assert np.mean((low <= theta) & (theta <= high)) > 0.95
    assert np.sqrt(np.mean((found.theta - theta) ** 2)) < 0.5 * np.sqrt(np.mean((run.smooth().theta - theta) ** 2))
    assert str(event.date) in str(found)
    assert found.plot() is not None


def test_the_same_in_other_units(jumping):
    run, _ = jumping
    phi, y = np.array(run.record.u) * [1e3, 1.0], np.array(run.record.y) * 1e-4
    other = local_shrinkage(track(run.model, FLS(100.0), y, phi), 3, burn_in=3)
    np.testing.assert_allclose(other.theta * [1e7, 1e4], local_shrinkage(run, 3, burn_in=3).theta, rtol=1e-9)


@pytest.mark.parametrize("y", [np.full(20, np.nan), np.full(20, 7.0), np.arange(20.0), np.full(20, 1e30)])
def test_records_without_noise_or_samples(y):
    found = local_shrinkage(track(Regression(1), FLS(100.0), y, np.ones((20, 1))), 5, burn_in=5)
    assert np.isfinite(found.theta).all()


def test_settings(jumping):
    with pytest.raises(ValueError, match="draws"):
        local_shrinkage(jumping[0], 0)

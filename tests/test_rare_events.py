"""The verdict on rare events: constant rates are not said to move, and rates that change are found."""

import numpy as np
import pytest

from driftfit import RLS, Kalman, Regression, track
from driftfit.judge.statistics.constancy import constancy, full_rank


def rare(kind, seed, T=400):
    """Constant rates of rare events, beside an input, in ways that say the same."""
    rng = np.random.default_rng(seed)
    u, counts, sales = rng.normal(size=T), rng.poisson(0.13, T), rng.poisson(4.0, T) * (rng.random(T) < 0.4)
    y = {
        "counts": counts,
        "counts missed, of twenty": 20 - counts,
        "bursts": 0.01 * rng.normal(size=T) + (rng.random(T) < 0.12) * rng.exponential(3.0, T),
        "sales in proportion": sales * np.exp(0.5 * u),
    }[kind]
    return np.column_stack([u, np.ones(T)]), y.astype(float)


@pytest.mark.parametrize("kind", ["counts", "counts missed, of twenty", "bursts", "sales in proportion"])
def test_error_rate_of_rare_events(kind):
    """Of 100 constant records at most 11 % are rejected, three standard errors above 5 %."""
    p = np.array([constancy(*rare(kind, seed)).p_joint for seed in range(100)])
    assert np.mean(p < 0.05) <= 0.11


def test_rare_events_that_become_frequent_for_a_time_are_found():
    """Also if nearly all of y is rare events: the change of the rate is not taken for correlated noise."""
    for seed in range(10):
        phi, y = rare("counts", seed)
        y[220:330] += np.random.default_rng(seed).poisson(1.2, 110)
        test = constancy(phi, y)
        assert test.p_joint < 1e-3
        assert test.noise is not None
        assert len(test.noise.breaks) > 0


def pulses(seed, change=0.0, louder=1.0, T=600):
    """A response to pulses in one of twenty samples that changes half-way, in noise that may be louder in pulses."""
    rng = np.random.default_rng(seed)
    u = (rng.random(T) < 0.05) * 1.0
    gain = np.where(np.arange(T) < T // 2, 5.0, 5.0 + change)
    return np.column_stack([u, np.ones(T)]), gain * u + 0.3 * rng.normal(size=T) * np.where(u > 0.0, louder, 1.0)


@pytest.mark.parametrize("change", [1.0, 4.0, 40.0])
def test_the_response_to_rare_pulses_changes(change):
    """All residuals of pulses are clipped if the change is large: they still have information."""
    assert max(constancy(*pulses(seed, change)).p_own[0] for seed in range(10)) < 0.05


@pytest.mark.filterwarnings("ignore:.*fault code")
def test_noise_that_is_louder_in_rare_pulses():
    """Segments that hold one pulse fit it exactly, and rows of equal weight let pulses decide: of 100 constant records,
    57 were rejected."""
    runs = (track(Regression(1, intercept=True), RLS(1.0), y, phi[:, 0]) for phi, y in
            (pulses(seed, louder=10.0) for seed in range(60)))  # fmt: skip
    assert np.mean([bool(run.verdict().drifts) for run in runs]) < 0.2


@pytest.mark.parametrize("change", [0.0, 1.0])
def test_a_pulse_that_comes_once(change):
    """Its sample determines it, whatever the output is; nothing was said of the other parameters."""
    rng = np.random.default_rng(3)
    phi = np.column_stack([rng.normal(size=(300, 2)), np.ones(300)])
    y = phi @ [1.0, -0.5, 0.2] + rng.normal(size=300)
    y[150:] += change * phi[150:, 0]
    pulse = (np.arange(300) == 120) * 1.0
    result = track(Regression(4), Kalman(q=1e-3, r=1.0), y, np.column_stack([phi, pulse])).verdict()
    alone = track(Regression(3), Kalman(q=1e-3, r=1.0), np.delete(y, 120), np.delete(phi, 120, axis=0)).verdict()
    assert result.p == pytest.approx(alone.p, abs=0.02)
    assert result.moving == alone.moving == (("theta1",) if change else ())
    assert result.held == ("theta4",)
    assert "Nothing shows whether theta4 moved: its regressor is 0 in every sample but one at most." in result.sentences


def test_scores_that_are_dependent_but_for_rounding_judge_nothing():
    """A covariance of scores with an eigenvalue of -1e-15 passed for regular, and had no Cholesky factor."""
    assert not full_rank(np.array([[1.0, 1.0], [1.0, 1.0 - 1e-15]]))
    assert full_rank(np.array([[1.0, 1.0 - 1e-9], [1.0 - 1e-9, 1.0]]))

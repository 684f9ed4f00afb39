"""The verdict on rare events: constant rates are not said to move, and rates that change are found."""

import numpy as np
import pytest
from test_verdict import judged, p_of

from driftfit import RLS, Kalman, Regression, track


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
    """Of 40 constant records at most 15 % are rejected, three standard errors above 5 %."""
    found = [judged(*rare(kind, seed)) for seed in range(40)]
    assert np.mean([one is not None and one.test.p < 0.05 for one in found]) <= 0.15


def test_rare_events_that_become_frequent_for_a_time_are_found():
    """Also if nearly all of y is rare events: the change of the rate is not taken for correlated noise."""
    for seed in range(5):
        phi, y = rare("counts", seed)
        y[220:330] += np.random.default_rng(seed).poisson(1.2, 110)
        found = judged(phi, y)
        assert found.test.p < 1e-3
        assert len(found.found.breaks) > 0


def pulses(seed, change=0.0, louder=1.0, T=600):
    """A response to pulses in one of twenty samples that changes half-way, in noise that may be louder in pulses."""
    rng = np.random.default_rng(seed)
    u = (rng.random(T) < 0.05) * 1.0
    gain = np.where(np.arange(T) < T // 2, 5.0, 5.0 + change)
    return np.column_stack([u, np.ones(T)]), gain * u + 0.3 * rng.normal(size=T) * np.where(u > 0.0, louder, 1.0)


@pytest.mark.parametrize("change", [1.0, 4.0, 40.0])
def test_the_response_to_rare_pulses_changes(change):
    """All residuals of pulses are clipped if the change is large: they still have information."""
    assert max(p_of(*pulses(seed, change)) for seed in range(5)) < 0.05


@pytest.mark.filterwarnings("ignore:.*fault code")
def test_noise_that_is_louder_in_rare_pulses():
    """Segments that hold one pulse fit it exactly, and rows of equal weight let pulses decide: of 100 constant records,
    57 were rejected."""
    runs = (track(Regression(1, intercept=True), RLS(1.0), y, phi[:, 0]) for phi, y in
            (pulses(seed, louder=10.0) for seed in range(20)))  # fmt: skip
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

"""Structures that change: found where they do, dated with intervals that cover, and not found where they do not."""

import numpy as np
import pytest

from driftfit import ARX, OE, RLS, grid, select
from driftfit.judge.structures.switches import switches

DELAYS = grid(ARX, na=[1], nb=[1], nk=[1, 2, 3])


def record(seed, delays, T=500, noise=1.0):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(4, T):
        y[t] = 0.8 * y[t - 1] + u[t - delays[t]] + noise * rng.normal()
    return y, u


def test_a_delay_that_changes_is_dated():
    delays = np.where(np.arange(500) < 230, 1, 3)
    covered = []
    for seed in range(20):
        y, u = record(seed, delays)
        y[[100, 300]], u[150] = np.nan, np.nan
        (found,) = select(DELAYS, y, u, tracker=RLS(0.98)).switches()
        assert "nk=3" in found.after
        assert "nk" not in found.before  # 1 is the default
        assert abs(found.at - 230) < 30
        covered.append(found.earliest <= 230 <= found.latest)
    assert np.mean(covered) >= 0.85


def test_no_change_is_found_where_there_is_none():
    count = [len(select(DELAYS, *record(seed, np.full(500, 2)), tracker=RLS(0.98)).switches()) for seed in range(20)]
    assert sum(count) <= 1


def test_a_date_without_noise_is_exact_and_settings_are_checked():
    rng = np.random.default_rng(1)
    phi = rng.normal(size=(100, 2))
    y = np.where(np.arange(100) < 47, 2.0 * phi[:, 0], -phi[:, 1])
    ((*dates, _, _),) = switches("ab", y, phi, [[0], [1]], 0.05)
    assert dates == [47, 47, 47]
    found = select(DELAYS, *record(0, np.full(500, 1)), tracker=RLS(0.98))
    with pytest.raises(ValueError, match="between 0 and 1"):
        found.switches(5)
    with pytest.raises(ValueError, match="columns of one regression"):
        select([ARX(1, 1), OE(1, 1)], *record(0, np.full(500, 1)), tracker=RLS(0.98)).switches()

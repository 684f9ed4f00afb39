"""The wild bootstrap of the verdict: p-values that stop early keep their distribution where it matters."""

import numpy as np

from driftfit.judge.statistics.wild_bootstrap import ABOVE, DRAWS, wild_supremum

N = 300


def p_values(count, change=0.0):
    found = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        X, e = np.column_stack([rng.normal(size=N), np.ones(N)]), rng.normal(size=N)
        e[N // 2 :] += change
        found.append(wild_supremum(X, e - X @ np.linalg.lstsq(X, e, rcond=None)[0], np.ones(N)))
    return np.array(found)


def test_sizes_hold():
    p = p_values(600)
    for level in (0.02, 0.05, 0.1, 0.3, 0.6):
        assert abs(np.mean(p <= level) - level) < 4.0 * np.sqrt(level * (1.0 - level) / len(p))


def test_large_p_values_stop_early_and_small_ones_do_not():
    p = np.concatenate([p_values(60), p_values(60, change=0.4)])
    counts = p * (DRAWS + 1)
    small = p <= ABOVE / DRAWS
    np.testing.assert_allclose(counts[small], np.round(counts[small]), atol=1e-9)  # (above + 1) / (DRAWS + 1)
    stopped = ABOVE / p[~small]
    np.testing.assert_allclose(stopped, np.round(stopped), atol=1e-9)  # ABOVE / draws
    assert small.sum() > 20
    assert np.median(stopped) < DRAWS / 4

"""Limits of windowed sums for an exact rate of false alarms, counted by onsets.

A sum over the last W samples of g_t^2 (or of g_t), g_t ~ N(0, 1) and independent, begins to exceed a limit c if it
was below c one sample before. The two sums share W - 1 terms, X, and differ in one, so that

    P(begins) = E [ P(X + old <= c) P(X + new > c) ],     X ~ chi2(W - 1), old and new ~ chi2(1)

(for |sum g|: X ~ N(0, W - 1), old and new ~ N(0, 1)). A limit for one false alarm in N samples has P(begins) = 1 / N.
Counting samples above the limit instead, as if they were independent, is wrong by the length of an alarm.

The same for one Gaussian sequence z with variance 1 and correlation rho from one sample to the next:

    P(begins) = P(z_(t-1) <= c, z_t > c) = E [ 1(x <= c) P(rho x + sqrt(1 - rho^2) w > c) ],    x, w ~ N(0, 1)

The probability that any of J samples exceeds c is that the first does, or that an onset occurs later,

    1 - P(z_1 <= c) exp(-J P(begins)),

or less, because onsets over a limit occur in clusters (for sums of 20 squares: 15 % instead of 10 % of the records).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import scipy

from driftfit.engine.kernel import Array

NODES = 2001
STILL = 1.645
"""A normal variable exceeds this with a probability of 5 %."""


Rate = Callable[[float], float]
"""P(begins) of a limit."""


@lru_cache
def power_rate(W: int) -> tuple[Rate, float, float]:
    """(P(begins), lower end, upper end of the limits) for the sum of W squares, W at least 4."""
    top = W + 20.0 * np.sqrt(2.0 * W) + 60.0
    grid = np.linspace(0.0, top, NODES)
    weight = np.exp(scipy.special.xlogy(0.5 * (W - 1) - 1.0, grid / W) - 0.5 * (grid - W))
    weight /= weight.sum()

    def begins(c: float) -> float:
        above = np.where(grid >= c, 1.0, scipy.special.chdtrc(1, np.maximum(c - grid, 0.0)))
        return float(np.sum(weight * above * (1.0 - above)))

    return begins, float(W), top


@lru_cache
def mean_rate(W: int) -> tuple[Rate, float, float]:
    """The same for the absolute sum of W terms, W at least 2."""
    units = np.linspace(-10.0, 10.0, NODES)
    grid, weight = units * np.sqrt(W - 1), np.exp(-0.5 * units**2)
    weight /= weight.sum()

    def begins(c: float) -> float:
        inside = scipy.special.ndtr(c - grid) - scipy.special.ndtr(-c - grid)
        return float(np.sum(weight * inside * (1.0 - inside)))

    return begins, float(np.sqrt(W)), 12.0 * np.sqrt(W) + 12.0


def normal_rate(rho: float) -> tuple[Rate, float, float]:
    """The same for z of variance 1 whose neighbours have the correlation ``rho``, 0 <= rho < 1."""
    rho = min(rho, 1.0 - 1e-9)
    spread = np.sqrt(1.0 - rho * rho)

    def begins(c: float) -> float:
        # most values that are about to exceed the limit are within a few standard deviations of it
        x = np.unique(np.concatenate([np.linspace(-9.0, c, NODES), c - spread * np.linspace(0.0, 9.0, NODES)]))
        inside = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) * scipy.special.ndtr((rho * x - c) / spread)
        return float(np.trapezoid(inside, x))

    return begins, 0.0, 12.0


@lru_cache
def power_limit(W: int, every: float) -> float:
    """c for the sum of W squares, W at least 4."""
    return _solve(*power_rate(W), every)


@lru_cache
def mean_limit(W: int, every: float) -> float:
    """c for the absolute sum of W terms, W at least 2."""
    return _solve(*mean_rate(W), every)


def normal_limit(rho: float, every: float) -> float:
    """c for z of variance 1 whose neighbours have the correlation ``rho``, 0 <= rho < 1; at least `STILL`.

    An estimate that hardly moves seldom begins to exceed any limit, but may be beyond it from the first sample on.
    """
    return max(_solve(*normal_rate(rho), every), STILL)


def chance(rate: tuple[Rate, float, float], highest: float, beyond: float, J: int) -> float:
    """Probability that the highest of J samples is ``highest`` or more; ``beyond`` is that of one sample."""
    begins, start, _ = rate
    return float(1.0 - (1.0 - beyond) * np.exp(-J * begins(max(highest, start))))


def _solve(begins: Rate, start: float, high: float, every: float) -> float:
    """The larger c with this rate: between the most frequent onsets and the end of the range."""
    grid = np.linspace(start, high, 200)
    rates = np.array([begins(c) for c in grid])
    most = int(np.argmax(rates))
    if rates[most] <= 1.0 / every:
        return float(grid[most])
    from scipy import optimize  # a tenth of a second to import

    return float(optimize.brentq(lambda c: begins(c) - 1.0 / every, grid[most], high, xtol=1e-8))


def onsets(active: Array) -> Array:
    """Samples at which an alarm begins, from whether it is on (T,)."""
    before = np.concatenate([[False], active[:-1]])
    return np.flatnonzero(active & ~before)


def held(active: Array, hold: int) -> Array:
    """Keep alarms on for ``hold`` samples after their cause."""
    if hold == 0:
        return active
    last = np.maximum.accumulate(np.where(active, np.arange(len(active)), -hold - 1))
    return np.asarray(np.arange(len(active)) - last <= hold)

"""Scenarios: how parameters change, and what noise there is, one function each. Regressors are white unless stated."""

from __future__ import annotations

import numpy as np

from benchmarks.held_out.case import NOISE, Case, Generator, T, arx, only, regression, slow, walk
from driftfit.engine.kernel import Array


def constants(rng: Generator) -> Case:
    """Nothing changes."""
    return regression(rng, walk(rng, rng.normal(size=4), 0.0), kind="constant")


def common_walk(rng: Generator) -> Case:
    """Four parameters move along one direction."""
    way = rng.normal(size=4)
    path = walk(rng, [0.0], 0.04) * way + rng.normal(size=4)
    return regression(rng, path, moves=way[:, None])


def single_walk(rng: Generator) -> Case:
    """One of four walks."""
    return regression(rng, walk(rng, rng.normal(size=4), only(4, int(rng.integers(4)), 0.05)))


def slow_walk(rng: Generator) -> Case:
    """Three walk by a hundredth of the noise."""
    return regression(rng, walk(rng, rng.normal(size=3), 0.003, 3 * T), burn=300)


def fast_walk(rng: Generator) -> Case:
    """Three walk by two thirds of the noise."""
    return regression(rng, walk(rng, rng.normal(size=3), 0.2))


def jumping(rng: Generator, n: int, size: float, rate: float) -> Case:
    """All of n parameters jump by ``size``, at unknown times."""
    path = walk(rng, rng.normal(size=n), (rng.random(T) < rate)[:, None] * np.full(n, size))
    return regression(rng, path, kind="jumps", jumps=size**2 * np.eye(n)[None], rate=rate)


def small_jumps(rng: Generator) -> Case:
    """Jumps of the size of the noise."""
    return jumping(rng, 3, NOISE, 0.006)


def large_jumps(rng: Generator) -> Case:
    """Jumps of ten times the noise."""
    return jumping(rng, 3, 10.0 * NOISE, 0.004)


def each_alone(n: int, variance: float) -> Array:
    """(n, n, n): jumps of one parameter at a time."""
    return variance * np.eye(n)[:, :, None] * np.eye(n)[:, None, :]


def two_jumps(rng: Generator) -> Case:
    """One of four jumps, and again 25 samples later, twice."""
    std = np.zeros((T, 4))
    std[[400, 425, 700, 725], int(rng.integers(4))] = 1.0
    return regression(rng, walk(rng, rng.normal(size=4), std), kind="jumps", jumps=each_alone(4, 1.0), rate=0.001)


def jumps_at_rest(rng: Generator) -> Case:
    """Each parameter has jumped when its input moves again after a rest of 60 samples."""
    u, std = rng.normal(size=(T, 3)), np.zeros((T, 3))
    for start in range(200, T - 80, 160):
        which = int(rng.integers(3))
        u[start : start + 60, which] = 0.0
        std[start + 30, which] = 1.0
    path = walk(rng, rng.normal(size=3), std)
    return regression(rng, path, u=u, kind="jumps", jumps=each_alone(3, 1.0), rate=0.002)


def switches(rng: Generator) -> Case:
    """Two regimes, in which two of four parameters differ."""
    change = np.array([1.2, 0.0, -0.8, 0.0])
    regime = (np.cumsum(rng.random(T) < 0.012) % 2).astype(float)
    path = rng.normal(size=4) + regime[:, None] * change
    return regression(rng, path, kind="jumps", jumps=np.outer(change, change)[None], rate=0.012)


def ramps(rng: Generator) -> Case:
    """Pieces of straight lines with corners every 200 samples."""
    slope = np.repeat(rng.normal(size=(T // 200, 3)) * 0.008, 200, axis=0)
    return regression(rng, rng.normal(size=3) + np.cumsum(slope, axis=0), kind="slopes")


def slopes(rng: Generator) -> Case:
    """Integrated random walks."""
    return regression(rng, rng.normal(size=3) + np.cumsum(walk(rng, np.zeros(3), 5e-4), axis=0), kind="slopes")


def few_of_twelve(rng: Generator) -> Case:
    """Three of twelve walk, at different rates."""
    which = rng.permutation(12)[:3]
    std = only(12, which[0], 0.06) + only(12, which[1], 0.03) + only(12, which[2], 0.015)
    return regression(rng, walk(rng, rng.normal(size=12), std, 1500), burn=200)


def one_of_three(rng: Generator) -> Case:
    """One of three walks fast."""
    return regression(rng, walk(rng, rng.normal(size=3), only(3, int(rng.integers(3)), 0.12)))


def near_unit_root(rng: Generator) -> Case:
    """Poles at .99 and .6, and a gain that walks."""
    path = walk(rng, [1.59, -0.594, 0.5], [0.0, 0.0, 0.01])
    return arx(rng, path, (2, 1, 1), rng.normal(size=T))


def collinear(rng: Generator) -> Case:
    """Two inputs that correlate by .99; one of their gains walks, and so does a third."""
    u = rng.normal(size=(T, 3))
    u[:, 1] = 0.99 * u[:, 0] + np.sqrt(1.0 - 0.99**2) * u[:, 1]
    return regression(rng, walk(rng, rng.normal(size=3), [0.03, 0.0, 0.03]), u=u)


def offset(rng: Generator, far: float, inputs: int = 1) -> Case:
    """Inputs at ``far`` of their deviations from 0; gains walk about the operating point, and so does the level."""
    u = np.column_stack([rng.normal(size=(T, inputs)) + far, np.ones(T)])
    gains, level = walk(rng, 1.0 + rng.normal(size=inputs), 0.02), walk(rng, [0.0], 0.02)
    path = np.column_stack([gains, level - far * gains.sum(axis=1, keepdims=True)])
    moves = np.eye(inputs + 1)
    moves[-1, :-1] = -far
    return regression(rng, path, u=u, moves=moves)


def offset_30(rng: Generator) -> Case:
    """An input at 30 of its deviations."""
    return offset(rng, 30.0)


def offset_60(rng: Generator) -> Case:
    """Two inputs at 60 of their deviations."""
    return offset(rng, 60.0, 2)


def offset_3000(rng: Generator) -> Case:
    """An input at 3000 of its deviations."""
    return offset(rng, 3e3)


def offset_10000(rng: Generator) -> Case:
    """An input at 10000 of its deviations."""
    return offset(rng, 1e4)


def coloured_noise(rng: Generator) -> Case:
    """Noise is a first-order autoregression with .8, and gains walk."""
    v = rng.normal(size=T) * NOISE
    n = v.copy()
    for t in range(1, T):
        n[t] += 0.8 * n[t - 1]
    path = walk(rng, rng.normal(size=3), 0.03)
    return regression(rng, path, v=n, known=n - v)


def t3_noise(rng: Generator) -> Case:
    """Noise of Student's t with 3 degrees of freedom."""
    return regression(rng, walk(rng, rng.normal(size=3), 0.03), v=NOISE * rng.standard_t(3, T) / np.sqrt(3.0))


def bursts(rng: Generator) -> Case:
    """Noise is eight times as large for 25 samples, now and then."""
    std = np.full(T, NOISE)
    for start in range(150, T - 40, 170):
        start += int(rng.integers(0, 100))
        std[start : start + 25] *= 8.0
    return regression(rng, walk(rng, rng.normal(size=3), 0.03), noise=std)


def heteroscedastic(rng: Generator) -> Case:
    """The logarithm of the noise variance wanders slowly, by a factor of 20 and more."""
    std = NOISE * np.exp(0.5 * slow(rng, T, 0.98, 1.5))
    return regression(rng, walk(rng, rng.normal(size=3), 0.03), noise=std)


def low_noise(rng: Generator) -> Case:
    """In one sample parameters drift by 100 times the noise."""
    return regression(rng, walk(rng, rng.normal(size=3), 0.1), noise=0.001)


def noise_free_levels(rng: Generator) -> Case:
    """A level and a gain that jump, and no noise at all."""
    path = walk(rng, rng.normal(size=2), (rng.random(T) < 0.006)[:, None] * np.ones(2))
    u = np.column_stack([rng.normal(size=T), np.ones(T)])
    return regression(rng, path, 0.0, u, kind="jumps", jumps=np.eye(2)[None], rate=0.006, least=0.005)

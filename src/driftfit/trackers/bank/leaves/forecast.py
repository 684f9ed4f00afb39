"""The forecasts of the leaves for the next output, whether or not it is observed."""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, kernel, part, shared
from driftfit.engine.simd import WIDTH, fill, load, plus, store, sum_of, times
from driftfit.trackers.bank.leaves.leaves import WEIGHT, total

FACTOR, VALUE, FROZEN, STUCK, CLEANS, OWN = range(6)
"""Columns of the table of sensors; OWN is the number of the user's function (`own_sensor`), 0 for none."""


@shared
def expect(
    w: Array, L: int, y: Array, h: Array, factor: Array, prior: Array, sensors: Array, r: float, noise: float,
    last: float, X: Array,
) -> tuple[float, float]:  # fmt: skip
    """Mean and variance of the output under the mixture of leaves and sensors.

    ``y`` and ``h`` are z'm and z'Cz of every leaf, ``factor`` what h is in units of. A sensor that may be frozen says
    the last output, if there was one.
    """
    Hm = len(sensors)
    Hd = len(prior) // Hm
    mean, share = 0.0, X[0]
    for j in range(Hm):
        frozen = sensors[j, FROZEN] > 0.0
        possible = not frozen or abs(last) < np.inf
        for l in range(L):
            share[l] = 0.0
        if possible:
            for c in range(Hd):
                for l in range(L):
                    share[l] += prior[c * Hm + j, l]
        for l in range(L):
            X[1 + j, l] = w[l] * share[l]
        for l in range(L):
            share[l] = X[1 + j, l] * (last if frozen and possible else y[l] + sensors[j, VALUE])
        mean += total(share, L)
    variance, mass = 0.0, 0.0
    for j in range(Hm):
        mass += total(X[1 + j], L)
    mean = mean / mass if mass != 1.0 else mean
    for j in range(Hm):
        frozen = sensors[j, FROZEN] > 0.0 and abs(last) < np.inf
        if frozen:
            for l in range(L):
                wide = sensors[j, STUCK] if sensors[j, STUCK] > 0.0 else -sensors[j, STUCK] * r * factor[l]
                share[l] = X[1 + j, l] * (wide + (last - mean) ** 2)
        else:
            for l in range(L):
                scatter = y[l] + sensors[j, VALUE] - mean
                share[l] = X[1 + j, l] * ((h[l] + sensors[j, FACTOR] * r * noise) * factor[l] + scatter * scatter)
        variance += total(share, L)
    if mass != 1.0:
        variance /= mass
    return mean, variance if noise < np.inf else np.inf


@part
def expect_together(
    B: Array, L: int, X: Array, factor: int, prior: Array, alike: bool, phi: Array, theta: Array, P: Array, Q: Array,
    sensors: Array, r: float,
) -> tuple[float, float]:  # fmt: skip
    """The same where leaves have one regressor, from the mean and covariance of the mixture alone:

        y = z' mean,   s = z' (cov + sum_i f_i Q_i) z + sum_j f_j factor_j r,

    f being the probabilities of events, times what covariances are in units of, which is row ``factor`` of X; the row
    after it, and the last of Q, are overwritten.
    """
    n, Hm = len(phi), len(sensors)
    Hd, mixed = len(prior) // Hm, Q[len(Q) - 1]
    rest, unit = 0.0, weighted(B, L, X, factor) if alike else 0.0
    for at in range(0, Q.shape[1], WIDTH):
        store(Q, len(Q) - 1, at, fill(0.0))
    for i in range(Hd):
        share = 0.0
        for j in range(Hm):
            f = unit * prior[i * Hm + j, 0]
            if not alike:
                for l in range(0, L, WIDTH):
                    store(X, factor + 1, l, times(load(X, factor, l), load(prior, i * Hm + j, l)))
                f = weighted(B, L, X, factor + 1)
            share += f
            rest += f * sensors[j, FACTOR]
        for at in range(0, Q.shape[1], WIDTH):
            store(Q, len(Q) - 1, at, plus(load(Q, len(Q) - 1, at), times(fill(share), load(Q, i, at))))
    mean, wide = 0.0, 0.0
    for i in range(n):
        g, row = 0.0, i * (i + 1) // 2
        for j in range(i + 1):
            g += (P[i, j] + mixed[row + j]) * phi[j]
        for j in range(i + 1, n):
            g += (P[j, i] + mixed[j * (j + 1) // 2 + i]) * phi[j]
        mean += phi[i] * theta[i]
        wide += phi[i] * g
    return mean, wide + rest * r


@kernel
def weighted(B: Array, L: int, X: Array, row: int) -> float:
    """The sum over leaves of their weights times a row of X."""
    sums = fill(0.0)
    for l in range(0, L, WIDTH):
        sums = plus(sums, times(load(B, WEIGHT, l), load(X, row, l)))
    return float(sum_of(sums))

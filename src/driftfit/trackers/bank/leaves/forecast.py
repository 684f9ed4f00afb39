"""The forecasts of the leaves for the next output, whether or not it is observed."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, kernel, shared
from driftfit.engine.simd import WIDTH, fill, load, plus, store, sum_of, times
from driftfit.trackers.bank.leaves.leaf_matrix import WEIGHT, total

FACTOR, VALUE, FROZEN, STUCK, CLEANS, OWN = range(6)
"""Columns of the table of sensors; OWN is the number of the user's function (`own_sensor`), 0 for none."""


@shared
def expect(t: Any, L: int) -> tuple[float, float]:
    """Mean and variance of the output under the mixture of leaves and sensors.

    Row j of ``shares`` is w p(sensor j | leaf). A frozen sensor repeats the last output, if there was one.
    """
    w, h, y, factor = t.leaves[WEIGHT], t.expected[0], t.expected[1], t.scores[0]
    share, shares, prior, sensors, Hm, last = (
        t.spare[0],
        t.spare[1:],
        t.prior,
        t.sensors,
        len(t.sensors),
        t.last,
    )
    mean, variance, mass = 0.0, 0.0, 0.0
    for j in range(Hm):
        frozen = sensors[j, FROZEN] > 0.0
        possible = not frozen or abs(last) < np.inf
        # p(sensor j | leaf), summed over the changes
        for l in range(L):
            share[l] = 0.0
        if possible:
            for e in range(j, len(prior), Hm):
                for l in range(L):
                    share[l] += prior[e, l]
        for l in range(L):
            shares[j, l] = w[l] * share[l]
        # its contribution to the mean: z'm + offset, or the last output
        for l in range(L):
            share[l] = shares[j, l] * (last if frozen and possible else y[l] + sensors[j, VALUE])
        mean += total(share, L)
    for j in range(Hm):
        mass += total(shares[j], L)
    mean = mean / mass if mass != 1.0 else mean
    # second moment about the mean: the variance within each component, and the distance of its mean
    r, noise = t.r, t.noise
    for j in range(Hm):
        if sensors[j, FROZEN] > 0.0 and abs(last) < np.inf:
            for l in range(L):
                wide = sensors[j, STUCK] if sensors[j, STUCK] > 0.0 else -sensors[j, STUCK] * r * factor[l]
                share[l] = shares[j, l] * (wide + (last - mean) ** 2)
        else:
            for l in range(L):
                scatter = y[l] + sensors[j, VALUE] - mean
                share[l] = shares[j, l] * ((h[l] + sensors[j, FACTOR] * r * noise) * factor[l] + scatter * scatter)
        variance += total(share, L)
    if mass != 1.0:
        variance /= mass
    return mean, variance if noise < np.inf else np.inf


@kernel
def weighted(B: Array, L: int, X: Array, row: int) -> float:
    """The sum over leaves of their weights times a row of X."""
    sums = fill(0.0)
    for l in range(0, L, WIDTH):
        sums = plus(sums, times(load(B, WEIGHT, l), load(X, row, l)))
    return float(sum_of(sums))


@shared
def expect_together(t: Any, L: int) -> tuple[float, float]:
    """The same for leaves with one common regressor, from the mean and covariance of the mixture alone:

        y = z' mean,   s = z' (cov + sum_i f_i Q_i) z + sum_j f_j factor_j r,

    where f are the probabilities of events times the unit of covariances, which is the first row of `scores`; the next
    row, and the last of Q, are overwritten.
    """
    theta, P, phi, Q, prior, sensors, X = t.theta, t.cov, t.phi, t.Q, t.prior, t.sensors, t.scores
    alike, Hm = t.alike > 0, len(sensors)
    mixed, spare_row = Q[len(Q) - 1], len(Q) - 1
    rest, unit = 0.0, weighted(t.leaves, L, X, 0) if alike else 0.0
    for at in range(0, Q.shape[1], WIDTH):
        store(Q, spare_row, at, fill(0.0))
    for i in range(spare_row):
        share = 0.0
        for j in range(Hm):
            f = unit * prior[i * Hm + j, 0]
            if not alike:
                for l in range(0, L, WIDTH):
                    store(X, 1, l, times(load(X, 0, l), load(prior, i * Hm + j, l)))
                f = weighted(t.leaves, L, X, 1)
            share += f
            rest += f * sensors[j, FACTOR]
        for at in range(0, Q.shape[1], WIDTH):
            store(Q, spare_row, at, plus(load(Q, spare_row, at), times(fill(share), load(Q, i, at))))
    mean, wide = 0.0, 0.0
    for i in range(len(phi)):
        g, row = 0.0, i * (i + 1) // 2
        for j in range(i + 1):
            g += (P[i, j] + mixed[row + j]) * phi[j]
        for j in range(i + 1, len(phi)):
            g += (P[j, i] + mixed[j * (j + 1) // 2 + i]) * phi[j]
        mean += phi[i] * theta[i]
        wide += phi[i] * g
    return mean, wide + rest * (t.r * t.noise)

"""The forecasts of the leaves for the next output, whether or not it is observed."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.bank.leaves.leaf_matrix import WEIGHT
from driftfit.engine.kernel import Array, kernel, shared
from driftfit.engine.simd import WIDTH, fill, load, plus, store, sum_of, times

FACTOR, VALUE, FROZEN, STUCK, CLEANS, OWN = range(6)
"""Columns of the table of sensors; OWN is the number of the user's function (`own_sensor`), 0 for none."""


@shared
def expect(t: Any, L: int) -> tuple[float, float]:
    """Mean and variance of the output under the mixture of leaves and sensors.

    Row j of ``shares`` is w p(sensor j | leaf). A frozen sensor repeats the last output, if there was one.
    """
    w, h, y, factor, prior, sensors, shares = (
        t.leaves[WEIGHT], t.expected[0], t.expected[1], t.scores[0], t.prior, t.sensors, t.spare,
    )  # fmt: skip
    last, Hm, mean, variance, mass = t.last, len(t.sensors), 0.0, 0.0, 0.0
    for j in range(Hm):
        frozen = sensors[j, FROZEN] > 0.0
        for l in range(L):
            p = 0.0
            for e in range(j, len(prior), Hm):
                p += prior[e, l]
            shares[j, l] = w[l] * p if not frozen or abs(last) < np.inf else 0.0
            mass += shares[j, l]
            mean += shares[j, l] * (last if frozen and shares[j, l] > 0.0 else y[l] + sensors[j, VALUE])
    mean /= mass
    # second moment about the mean: the variance within each component, and the distance of its mean
    for j in range(Hm):
        stuck = sensors[j, STUCK]
        for l in range(L):
            if sensors[j, FROZEN] == 0.0:
                wide = (h[l] + sensors[j, FACTOR] * t.r * t.noise) * factor[l]
                variance += shares[j, l] * (wide + (y[l] + sensors[j, VALUE] - mean) ** 2)
            elif shares[j, l] > 0.0:
                wide = stuck if stuck > 0.0 else -stuck * t.r * factor[l]
                variance += shares[j, l] * (wide + (last - mean) ** 2)
    return mean, variance / mass if t.noise < np.inf else np.inf


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

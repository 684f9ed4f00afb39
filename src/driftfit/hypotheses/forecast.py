"""What the leaves expect of the next output, whether it comes or not."""

from __future__ import annotations

import numpy as np

from driftfit.hypotheses.leaves import total
from driftfit.kernel import Array, core, part

FACTOR, VALUE, FROZEN, WIDTH, CLEANS = range(5)
"""Columns of the table of sensors."""


@core
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
                wide = sensors[j, WIDTH] if sensors[j, WIDTH] > 0.0 else -sensors[j, WIDTH] * r * factor[l]
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
    w: Array, L: int, factor: Array, prior: Array, alike: bool, phi: Array, theta: Array, P: Array, Q: Array,
    mixed: Array, sensors: Array, r: float, X: Array,
) -> tuple[float, float]:  # fmt: skip
    """The same where leaves have one regressor, from the mean and covariance of the mixture alone:

        y = z' mean,   s = z' (cov + sum_i f_i Q_i) z + sum_j f_j factor_j r,

    f being the probabilities of events, times what covariances are in units of. ``mixed`` takes sum_i f_i Q_i.
    """
    n, Hm = len(phi), len(sensors)
    Hd, part, share = len(prior) // Hm, X[0], X[1]
    rest = 0.0
    for i in range(Hd):
        share[i] = 0.0
    unit = 0.0
    if alike:
        for l in range(L):
            part[l] = w[l] * factor[l]
        unit = total(part, L)
    for i in range(Hd):
        for j in range(Hm):
            f = unit * prior[i * Hm + j, 0]
            if not alike:
                for l in range(L):
                    part[l] = w[l] * (factor[l] * prior[i * Hm + j, l])
                f = total(part, L)
            share[i] += f
            rest += f * sensors[j, FACTOR]
    for at in range(len(mixed)):
        mixed[at] = share[0] * Q[0, at]
    for k in range(1, Hd):
        for at in range(len(mixed)):
            mixed[at] += share[k] * Q[k, at]
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

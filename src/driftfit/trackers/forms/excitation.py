"""Excitation: scales of the regressors, and a windowed Gram matrix that shows which parameters are being learned.

    c_i <- mean of phi_i^2 / noise over the last samples on which regressor i did anything
    G   <- fade G + D phi phi' D / noise,   D = diag(c)^(-1/2)

noise is the factor of the noise variance of a sample, 1 / weight, so that the unit of the weights does not matter.

A regressor without excitation keeps its scale, since a mean square that decays to 0 would inflate any drift measured in
it. That is one far smaller than it was, unless its share of the output, theta_i phi_i, is still larger than five
standard deviations of the innovation: an input may move less from now on, and its parameter still be followed. A scale
from fewer than `MEMORY` samples is lost again after many times as many small ones, because those may have been fault
codes. The scale of y is kept likewise, and with it the noise variance of a failed sensor.

Parameter i is being learned while 1 / (G^-1)_ii, the information that no other parameter can explain, is above that of
one sample, or is more than a tenth of what as many samples carried on average until now, 1 / var_i from all of them.
The second holds for regressors far from zero beside an intercept, about which one sample never says much.

Cost per sample: O(n^2); the flag inverts G when it is requested.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel
from driftfit.readings.repeats import measured

MEMORY = 50.0
"""Memory of the mean square of a regressor, in samples."""
DULL = 1e-4
"""A square below this share of the mean square counts as no excitation, if its share of the output is small too."""

LITTLE = 0.1
"""Share of the average information below which a parameter is not being learned."""

FIRST = 10.0
"""Number of first squares that are taken as they are, for comparison with later ones."""

LARGE = 25.0
"""A square above this multiple of the mean square counts as this multiple."""

LOST = 1e-14
"""A square below this share of the mean square never counts: variances in the old unit would be rounding in its own."""

DOUBT = 0.05
"""Samples of excitation that a sample without it cancels while the scale rests on few."""


def window(n: int) -> int:
    """Number of samples in the window of G."""
    return max(int(MEMORY), 10 * n)


def no_excitation(n: int) -> dict[str, Any]:
    """Fields before the first sample."""
    return {
        "power_samples": 0.0,
        "power": 0.0,
        "c": np.zeros(n),
        "active": np.zeros(n),
        "information": np.zeros((n, n)),
    }


@kernel
def bounded(square: float, mean: float, count: float) -> float:
    """A square, bounded for a mean square of ``count`` others: a fault code must not become the scale."""
    return min(square, LARGE * mean) if count >= FIRST else square


@kernel
def learn_scales(s: State, l: int) -> None:
    """Update the mean squares of the regressors, over excited samples, and of y, in units of the noise factor."""
    s.power_samples[l] += s.ok[l]
    y = measured(s, l)
    square = bounded(y * y / s.noise[l], s.power[l], s.power_samples[l])
    active = s.ok[l] if square > DULL * s.power[l] else 0.0
    s.power[l] += active * (square - s.power[l]) / min(max(s.power_samples[l], 1.0), MEMORY)
    for i in range(s.theta.shape[0]):
        square = bounded(s.phi[i, l] * s.phi[i, l] / s.noise[l], s.c[i, l], s.active[i, l])
        share = s.theta[i, l] * s.phi[i, l]
        matters = (s.active[i, l] <= 0.0) | (share * share > LARGE * s.s[l])
        active = s.ok[l] if square > (LOST if matters else DULL) * s.c[i, l] else 0.0
        dull = s.ok[l] - active if (square > 0.0) & (s.active[i, l] < MEMORY) else 0.0
        s.active[i, l] = max(s.active[i, l] + active - DOUBT * dull, 0.0)
        s.c[i, l] += active * (square - s.c[i, l]) / min(max(s.active[i, l], 1.0), MEMORY)


@kernel
def learn_information(s: State, noise: float, l: int) -> None:
    """Windowed Gram matrix of the regressors in units of their scale, of samples whose noise variance has the factor
    ``noise``: those that the guard against constant inputs examines.
    """
    n = s.theta.shape[0]
    fade = 1.0 - 1.0 / max(MEMORY, 10.0 * s.parameters[l])
    for i in range(n):
        for j in range(i + 1):
            unit = s.c[i, l] * s.c[j, l]
            fresh = s.phi[i, l] * s.phi[j, l] / np.sqrt(unit) if unit > 0.0 else 0.0
            fresh *= s.ok[l] / noise
            s.information[i, j, l] = fade * s.information[i, j, l] + fresh


def learned(lane: Mapping[str, Array]) -> Array:
    """Which parameters the regressors of the window distinguish from all others, (n,) bool."""
    lower, n = np.tril(lane["information"]), len(lane["c"])
    G = lower + np.tril(lower, -1).T
    own: Array = 1.0 / np.diag(np.linalg.inv(G + 1e-9 * np.eye(n)))
    var, noise = np.where(np.isfinite(lane["var"]), lane["var"], 0.0), float(lane["r"])
    share = window(n) / max(float(lane["power_samples"]), window(n))
    return (own > 1.0) | (var * own * lane["c"] > LITTLE * share * noise)

"""What a sample counts for beside all samples so far: mean and spread of the readings, and the leverage of a regressor.

With m and v the mean and variance of the readings so far, the factor p, ``widening``, is 1 and doubles with every
consecutive outlier: outliers that keep coming are a change of level. A regressor out of proportion to its mean square c
may be a test or a flood, and so contain the most information. It counts as at most LEVERAGE ordinary samples: the noise
variance of its sample is multiplied by

    max(1, max_i phi_i^2 / (LEVERAGE c_i))

Source: bounded leverage is Mallows's, see Hampel, Ronchetti, Rousseeuw and Stahel, Robust Statistics (1986), section
6.3; the factor p is ours. Cost per sample: O(n).
"""

from __future__ import annotations

from typing import Any

from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.coarse.resolution import reading

LEVERAGE = 100.0
"""Largest weight of one regressor, in ordinary samples."""
FIRST = 10.0
"""Number of first readings that are accepted without a check, for comparison with later ones; half of them where the
regressors are ordinary and the prediction is contradicted."""
SURE = 5.0
"""Standard deviations of the prediction from which on a sample contradicts it."""
MEMORY = 1000.0
"""Memory of the mean and variance of the readings, and of other means with which samples are compared, in samples."""
LONGEST = 1e12
"""Upper bound of the factor p."""


def no_proportion() -> dict[str, Any]:
    """Fields before the first reading."""
    return {
        "middle": 0.0, "spread": 0.0, "readings": 0.0, "widening": 1.0, "leverage": 1.0,
    }  # fmt: skip


@kernel
def learn_proportion(s: State, l: int, outlier: float) -> None:
    """Update mean and variance of the accepted readings, and the factor p, given the probability of an outlier.

    A reading that repeats the last one has nothing new: a plant at standstill keeps its scale.
    """
    if s.observed[l] > 0.0:
        s.widening[l] = min(1.0 + outlier * (2.0 * s.widening[l] - 1.0), LONGEST)
    if s.observed[l] > 0.0 and (s.fresh[l] > 0.0 or s.readings[l] < 1.0):
        s.readings[l] += 1.0
        share = 1.0 / min(s.readings[l], MEMORY)
        away = reading(s, l) - s.middle[l]
        s.middle[l] += share * away
        s.spread[l] += share * ((1.0 - share) * away * away - s.spread[l])


@kernel
def bound_leverage(s: State, l: int) -> None:
    """The factor of the noise variance."""
    most = 1.0
    for i in range(s.theta.shape[0]):
        square = s.phi[i, l] * s.phi[i, l] / s.noise[l]
        most = max(most, square / (LEVERAGE * s.c[i, l])) if s.c[i, l] > 0.0 else most
    s.leverage[l] = most * (1.0 + s.vague[l] / (s.r[l] * s.noise[l]))

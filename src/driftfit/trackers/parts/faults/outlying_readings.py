"""Readings and regressors far outside the range of earlier ones: fault codes, spikes, wrong units.

A reading of 9999 where the output is near 10 carries no information about the system, and it does harm in three ways:
as an output, as a lag in the regressors of later samples, and in every scale that is estimated from the data. With m
and v the mean and variance of the readings so far and e the innovation, it is left out (not used, and its lag is that
of a missing output) if

    (y - m)^2 > (REACH p)^2 v    and    e^2 > (REACH p)^2 v    and    e^2 > SURE^2 s

with s the variance of e: never if the model predicted it, or could predict nothing, as where a regressor that was 0 so
far moves for the first time. A reading in a new direction is the response to a rare pulse, or a fault code by
coincidence. It is learned from with noise variance e^2: the estimate follows at once, with a band as wide as itself,
and the next pulse confirms or replaces it. Where a prediction is beyond RARELY v^(1/2) from m, as that of a rare pulse
is, its distance takes the place of v^(1/2): a response may be up to REACH times as large as predicted. The factor p,
``widening``, is 1, and doubles with every consecutive sample that is so far off or an outlier: persistent readings are
a change of level, and are accepted. A change of level by a factor of 1000 costs seven samples.

A regressor out of proportion to its mean square c is not left out, because it may be a test or a flood, and so contain
the most information. It counts as at most LEVERAGE ordinary samples: the noise variance of its sample is multiplied by

    max(1, max_i phi_i^2 / (LEVERAGE c_i))

Source: bounded leverage is Mallows's, see Hampel, Ronchetti, Rousseeuw and Stahel, Robust Statistics (1986), section
6.3; the factor p is ours. Cost per sample: O(n).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.coarse.resolution import reading

REACH = 10.0
"""Standard deviations of the readings beyond which one is an outlier."""
LEVERAGE = 100.0
"""Largest weight of one regressor, in ordinary samples."""
FIRST = 10.0
"""Number of first readings that are accepted without a check, for comparison with later ones; half of them where the
regressors are ordinary and the prediction is contradicted."""
SURE = 5.0
"""Standard deviations of the prediction from which on a sample contradicts it."""
RARELY = 3.0
"""Standard deviations of the readings beyond which a prediction is the response to something rare, as a pulse."""
MEMORY = 1000.0
"""Memory of the mean and variance of the readings, and of other means with which samples are compared, in samples."""
LONGEST = 1e12
"""Upper bound of the factor p."""


def no_proportion() -> dict[str, Any]:
    """Fields before the first reading."""
    return {
        "middle": 0.0, "spread": 0.0, "readings": 0.0, "widening": 1.0, "strange": 0.0, "leverage": 1.0,
    }  # fmt: skip


@kernel
def leave_out(s: State, l: int) -> None:
    """Leave out a reading far outside the usual range; s.y_hat and s.s must be known, s.s inf in a new direction, in
    which the reading is a response that nothing confirms yet.
    """
    away, e = (reading(s, l) - s.middle[l]) ** 2, (s.y[l] - s.y_hat[l]) ** 2
    predicted = s.valid[l] > 0.0
    expected = (reading(s, l) - s.middle[l] - (s.y[l] - s.y_hat[l])) ** 2 if predicted else 0.0
    e = e if predicted else away
    reach = REACH * REACH * (expected if expected > RARELY * RARELY * s.spread[l] else s.spread[l])
    limit = reach * s.widening[l] * s.widening[l]
    new = predicted & (s.s[l] == np.inf)
    contradicted = (not predicted) | (e > SURE * SURE * s.s[l])
    few = predicted & contradicted & (s.leverage[l] <= 1.0)
    judged = (s.observed[l] > 0.0) & (s.readings[l] >= (0.5 * FIRST if few else FIRST))
    strange = judged & (away > reach) & (e > reach)
    out = strange & contradicted & (away > limit) & (e > limit)
    if strange & new:
        s.leverage[l] = max(s.leverage[l], e / (s.r[l] * s.noise[l]))
    s.strange[l] = 1.0 if strange & contradicted else 0.0
    s.left_out[l] += 1.0 if out else 0.0
    s.ok[l] = 0.0 if out else s.ok[l]
    s.observed[l] = 0.0 if out else s.observed[l]


@kernel
def learn_proportion(s: State, l: int, outlier: float) -> None:
    """Update mean and variance of the accepted readings, and the factor p, given the probability of an outlier.

    A reading that repeats the last one has nothing new: a plant at standstill keeps its scale.
    """
    probable = max(s.strange[l], outlier)
    if s.observed[l] > 0.0 or probable > 0.0:
        s.widening[l] = min(1.0 + probable * (2.0 * s.widening[l] - 1.0), LONGEST)
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

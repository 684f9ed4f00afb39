"""The score CUSUM of a frozen reference model.

    C <- max(0, C + log likelihood ratio of a shift by SHIFT standard deviations of the noise)

for each parameter and both signs, and for the variance of the noise. Where a regressor is centred, its parameter also
has sums for a step of the slope through zero, unless that is hardly more than one of the level. Reported is the larger
of them as sqrt(2 C), a deviate. Above TOP the sum forgets exponentially: it would otherwise grow for as long as a fault
lasts, and the alarm would stay on for up to nine times as long after it. The column with the largest drift still has
the largest sum. Source: Page (1954). Cost per sample: O(n).
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, part
from driftfit.run.live.frozen.reference_model import (
    BOUND,
    CONSTANT,
    KAPPA,
    LITTLE,
    SAME,
    SHIFT,
    TOP,
    Frozen,
    K,
    V,
    through_zero,
)

LASTING = 0.98
"""What is kept, per sample, of the excess of a sum over the largest that counts."""


@part
def climb(cusum: Array, z: float, mean: float, var: float, power: float, most: float) -> None:
    """One step of a CUSUM up and of one down, which forget what they are above ``most``."""
    for side in range(2):
        step = (mean * z if side == 0 else -mean * z) - 0.5 * mean * mean * power
        value = max(0.0, cusum[side] + step / var)
        cusum[side] = most + LASTING * (value - most) if value > most else value


@part
def idle(j: int, frozen: Frozen) -> bool:
    """Whether regressor j was always 0 in the reference, or constant and is centred, so that it has no unit there."""
    share = 0.0
    for m in range(frozen.unseen.shape[0]):
        share += frozen.unseen[m, j] * frozen.unseen[m, j]
    return share > 1.0 - SAME


@part
def accumulate(phi: Array, g: float, noise: bool, frozen: Frozen, cusum: Array) -> None:
    """One step of the CUSUM of every parameter, of the noise, and of slopes through zero; columns are up and down."""
    n = frozen.theta.shape[0]
    k, v, kappa = frozen.numbers[K], frozen.numbers[V], frozen.numbers[KAPPA]
    most = 0.5 * frozen.numbers[TOP] ** 2 if frozen.numbers[TOP] > 0.0 else np.inf
    for j in range(n):
        own = np.sign(phi[j]) if idle(j, frozen) else min(BOUND, max(-BOUND, phi[j]))
        climb(cusum[j], own * g, SHIFT * k, v, own * own, most)
    if noise:
        climb(cusum[n], g * g - v, SHIFT * v, kappa, 1.0, most)
    constant = int(frozen.numbers[CONSTANT]) if frozen.mean.shape[0] > 0 else 0
    for j in range(frozen.mean.shape[0]):
        a, b = through_zero(frozen, j, constant) if frozen.mean[j] != 0.0 else (0.0, 0.0)
        if a > LITTLE and not idle(j, frozen):
            own = min(BOUND, max(-BOUND, a * phi[j] + b * phi[constant]))
            climb(cusum[n + 1 + j], own * g, SHIFT * k, v, own * own, most)


@part
def report(cusum: Array, frozen: Frozen, deviates: Array) -> None:
    """sqrt(2 C) of the parameters and of the noise into deviates (n + 1,)."""
    n = frozen.theta.shape[0]
    for j in range(n + 1):
        highest = max(cusum[j, 0], cusum[j, 1])
        if j < frozen.mean.shape[0]:
            highest = max(highest, cusum[n + 1 + j, 0], cusum[n + 1 + j, 1])
        deviates[j] = np.sqrt(2.0 * highest)

"""What the readings of a coarse meter have in common: a variance of theta that more readings do not reduce.

The error of rounding is a function of the exact value. Where the inputs are held, it is the same for many readings;
where they move by less than a quantum, it is nearly so. Least squares takes it for independent noise, and its variances
shrink as 1/T. Noise of standard deviation S before the rounding averages the error, and leaves a mean square of about

    g(S^2) = quantum^2 / 12 exp(-4 pi^2 S^2 / quantum^2)

(exact for the first harmonic). Per reading the errors in common have the variance

    c = max( g(variance of the readings - f),  g(sigma^2 - f / levels^(1/2)) / levels ),    f = 2 m quantum^2 / 12

since readings that spread over more than a quantum share nothing, and each level at which the prediction stayed has an
error of its own; quantum^2 / 12 itself is subtracted from both variances too. f is for meters so coarse that the
readings alternate between two values: they do so with a variance of up to 3 quantum^2 / 12 without any noise, and tell
only that there is less of it than a quantum. m is 1 then, and WIDER over the share of the steps that are wider than the
quantum otherwise.

A variance of theta from N readings is multiplied by fold = 1 + N c / r. N and levels are those of the tracker's memory:
both are forgotten at the rate h / n, with the leverage h = 1 - noise / s, which is about 1 - lambda with forgetting and
1 / T without. Where several filters share the work, n r / N is the mean of phi' P phi. theta and P do not change, nor
do predictions.

Source: Widrow and Kollar, Quantization Noise (2008), for the characteristic function of rounding; the rest is ours.
Departure: exp(-x) is bounded by 1 / (1 + x + x^2/2 + x^3/6), which takes a tenth of the time. Cost per sample: O(n),
O(n^2) for several filters.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.coarse.resolution import lasting

RATE = 4.0 * np.pi**2
WIDER = 0.01
"""Share of wider steps from which on readings count as more than two values."""
MOVED = 0.25
"""A prediction that moves by this share of the quantum has another error of rounding."""
RECENT = 100.0
"""Samples of the mean of phi' P phi."""


def nothing_shared_among_filters() -> dict[str, Any]:
    """Fields before the first reading of a mixture, which has the mean and variance of readings already."""
    return {"fold": 1.0, "common": 0.0, "undecided": 0.0, "levels": 1.0, "stayed": np.nan}


@kernel
def averaged(variance: float, quantum: float) -> float:
    """At least exp(-4 pi^2 variance / quantum^2)."""
    x = RATE * max(variance, 0.0) / (quantum * quantum)
    share: float = 1.0 / (1.0 + x * (1.0 + x * (0.5 + x * 0.16666666666666666)))
    return share


@kernel
def count_levels(s: State, kept: float, known: bool, l: int) -> None:
    """The number of levels of the prediction in the tracker's memory, of which the share ``kept`` remains.

    Until the quantum is accepted, its present candidate counts, which has the unit of y as well.
    """
    ok = s.ok[l]
    y_hat = s.y_hat[l] + s.shift[l]
    step = abs(y_hat - s.stayed[l]) / (MOVED * s.quantum[l])  # NaN at the first sample
    moved = min(step * step, 1.0) if (step > 0.0) & known else 0.0
    s.levels[l] = max(kept * s.levels[l] + ok * moved, 1.0)
    s.stayed[l] = y_hat if ok > 0.0 else s.stayed[l]


@kernel
def in_common(s: State, noise: float, l: int) -> float:
    """The variance c per reading; ``noise`` is the noise variance of the tracker, rounding included."""
    coarse, quantum = s.coarse[l], s.quantum[l] if s.coarse[l] > 0.0 else 1.0
    two = 2.0 * min(1.0, WIDER * s.steps[l] / max(s.steps[l] - s.smallest[l], WIDER))
    spread = averaged(s.spread[l] - coarse * (1.0 + two), quantum)
    held = averaged(noise - coarse * (1.0 + two / np.sqrt(s.levels[l])), quantum) / s.levels[l]
    return coarse * max(spread, held)  # type: ignore[no-any-return]


@kernel
def share_among_filters(s: State, l: int) -> None:
    """Take in a sample after the correction of filters with covariance s.P, of which means are known."""
    n, h = s.theta.shape[0] - s.absent[l], 0.0
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            h += s.white[i, l] * s.white[j, l] * s.P[i, j, l] * (1.0 if i == j else 2.0)
    h = max(h, 0.0)
    s.undecided[l] += s.ok[l] * (h - s.undecided[l]) / min(s.count[l] + 1.0, RECENT)
    count_levels(s, 1.0 - s.ok[l] * h / (h + s.r[l] * s.noise[l] + lasting(s, l)) / n, s.count[l] > 2.0 * n, l)
    mean = s.undecided[l]
    s.common[l] = in_common(s, s.r[l] / s.mean_weight[l], l) if (s.coarse[l] > 0.0) & (mean > 0.0) else 0.0
    s.fold[l] = 1.0 + n * s.common[l] / mean if s.common[l] > 0.0 else 1.0
    for i in range(s.theta.shape[0]):
        s.var[i, l] *= s.fold[l]

"""What the readings of a coarse meter have in common: a variance of theta that more readings do not reduce.

The error of rounding is a function of the exact value. Where the inputs are held, it is the same for many readings;
where they move by less than a quantum, it is nearly so. Least squares takes it for independent noise, and its variances
shrink as 1/T. Noise of standard deviation S before the rounding averages the error, and leaves a mean square of about

    g(S^2) = quantum^2 / 12 exp(-4 pi^2 S^2 / quantum^2)

(exact for the first harmonic). Per reading the errors in common have the variance

    c = max( g(variance of the readings),  g(sigma^2) / levels )

since readings that spread over more than a quantum share nothing, and each level at which the prediction stayed has an
error of its own. A variance of theta from N readings is therefore multiplied by fold = 1 + N c / r. N and levels are
those of the tracker's memory: both are forgotten at the rate h / n, with the leverage h = 1 - noise / s, which is about
1 - lambda with forgetting and 1 / T without. theta and P do not change, nor do predictions.

Source: Widrow and Kollar, Quantization Noise (2008), for the characteristic function of rounding; the rest is ours.
Departure: exp(-x) is bounded by 1 / (1 + x + x^2/2 + x^3/6), which takes a tenth of the time. Cost per sample: O(n).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.drivers import diagonal
from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.diffuse import spanned_variance

RATE = 4.0 * np.pi**2
MOVED = 0.25
"""A prediction that moves by this share of the quantum has another error of rounding."""


def nothing_shared() -> dict[str, Any]:
    """Fields before the first reading."""
    return {"fold": 1.0, "readings_in": 0.0, "levels": 1.0, "middle": 0.0, "spread": 0.0, "stayed": np.nan}


@kernel
def averaged(variance: float, quantum: float) -> float:
    """At least exp(-4 pi^2 variance / quantum^2)."""
    x = RATE * max(variance, 0.0) / (quantum * quantum)
    share: float = 1.0 / (1.0 + x * (1.0 + x * (0.5 + x * 0.16666666666666666)))
    return share


@kernel
def share_rounding(s: State, per_noise: float, l: int) -> None:
    """Take in a sample after its correction; ``per_noise`` is s.s in units of the noise variance, s.scale."""
    n, ok = s.theta.shape[0], s.ok[l]
    quantum = s.quantum[l] if s.coarse[l] > 0.0 else 1.0
    kept = 1.0 - ok * max(1.0 - s.noise[l] / per_noise, 0.0) / n
    N = kept * s.readings_in[l] + ok
    weight = ok / max(N, 1.0)
    off = s.y[l] - s.middle[l]
    step = abs(s.y_hat[l] - s.stayed[l]) / (MOVED * quantum)  # NaN at the first sample
    known = s.count[l] > 2.0 * n
    moved = min(step * step, 1.0) if (step > 0.0) & known else 0.0
    s.middle[l] = s.middle[l] + weight * off
    s.spread[l] = (1.0 - weight) * (s.spread[l] + weight * off * off)
    s.levels[l] = max(kept * s.levels[l] + ok * moved, 1.0)
    s.readings_in[l] = N
    s.stayed[l] = s.y_hat[l] if ok > 0.0 else s.stayed[l]
    coarse, scale = s.coarse[l], s.scale[l]
    spread = averaged(s.spread[l] - coarse, quantum)
    held = averaged(scale - coarse, quantum) / s.levels[l]
    s.fold[l] = 1.0 + N * coarse * max(spread, held) / scale if (coarse > 0.0) & (scale > 0.0) else 1.0


@kernel
def folded(s: State, l: int) -> None:
    """Report the diagonal of P, times the noise variance and the fold."""
    diagonal(s, l)
    for i in range(s.theta.shape[0]):
        s.var[i, l] *= s.fold[l]


@kernel
def spanned_folded(s: State, l: int) -> None:
    """The same while the state is in square-root form."""
    spanned_variance(s, l)
    for i in range(s.theta.shape[0]):
        s.var[i, l] *= s.fold[l]

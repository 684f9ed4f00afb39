"""Bands that are widened until outputs are within them as often as promised: an adaptive conformal factor.

Before sample t, y is expected within y_hat +- z f_t s_t^(1/2), with z the normal quantile of the level 1 - alpha, and

    f_1 = 1,    log f_(t+1) = log f_t + STEP (1[|e_t| > z f_t s_t^(1/2)] - alpha)

within 1 / F and F = LARGEST_FACTOR. The share of outputs outside is then alpha to within log F / (STEP T) in any record
of T used samples, for every distribution of the noise: f corrects the width of bands that rest on a wrong noise or a
wrong model. It only scales a band, and does not correct a lasting bias. Parameters are scaled by the same
factor, which is a heuristic: their errors are not observed.

f^2 changes by two constant factors, so a stream and a record have the same bits. Samples that are not used change
nothing.

Source: Gibbs and Candes, Adaptive conformal inference under distribution shift (2021), eq. 2, as a step of log f
instead of alpha, as in Angelopoulos, Candes and Tibshirani, Conformal PID control for time series prediction (2023),
section 2.
Cost per sample: a few operations.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import exp, isfinite
from statistics import NormalDist

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import warn

STEP = 0.05
"""Change of log f for one output outside its band: the rest of the change is alpha times as large, down."""
LARGEST_FACTOR = 100.0
"""Largest factor, and the inverse of the least."""
WARNED_FACTOR = 2.0
"""A warning is issued for a factor above this."""


def quantile(level: float, name: str = "band") -> float:
    """The normal quantile z of a two-sided band; ValueError unless the level is between 0 and 1."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"{name}: level must be between 0 and 1, such as 0.95; got {level!r}.")
    return NormalDist().inv_cdf(0.5 + level / 2.0)


@dataclass
class ConformalFactor:
    """The factor of the bands of a stream, for one level.

        factor = ConformalFactor(0.95)
        y_hat, e, s, ok = live.update(y, u)
        factor.update(e, s)             # the next output is expected within y_hat +- factor.z factor.value s^(1/2)

    Parameters
    ----------
    level : float
        Share of outputs that bands are to contain.

    Attributes
    ----------
    value : float
        The factor after the last sample; 1 at first.
    z : float
        The normal quantile.
    """

    level: float = 0.95
    square: float = 1.0
    z: float = field(init=False)

    def __post_init__(self) -> None:
        self.z = quantile(self.level, "ConformalFactor")
        self._up, self._down = exp(2.0 * STEP * self.level), exp(-2.0 * STEP * (1.0 - self.level))

    @property
    def value(self) -> float:
        return float(self.square**0.5)

    def update(self, e: float, s: float) -> float:
        """Update by an innovation and its variance, NaN for a sample that was not used; returns the factor."""
        if isfinite(e) and isfinite(s):
            outside = e * e > self.z * self.z * self.square * s
            square = self.square * (self._up if outside else self._down)
            self.square = min(max(square, 1.0 / LARGEST_FACTOR**2), LARGEST_FACTOR**2)
        return self.value


def factors(e: Array, s: Array, level: float) -> Array:
    """(T + 1,): the factor before each sample of a record, and after the last."""
    factor = ConformalFactor(level)
    return np.array([1.0, *(factor.update(*sample) for sample in zip(e.tolist(), s.tolist(), strict=True))])


def widened(e: Array, s: Array, level: float, name: str) -> Array:
    """`factors`, with a warning where one is above `WARNED_FACTOR`."""
    found = factors(e, s, level)
    if found.max() > WARNED_FACTOR:
        t = int(np.argmax(found > WARNED_FACTOR))
        warn(
            f"{name}: outputs are outside their {level:.0%} bands so often that the bands are widened by a factor "
            f"above {WARNED_FACTOR:g} after {t} samples, and up to {found.max():.1f}: the model or the noise is not "
            "what the tracker assumes; run.diagnose() shows which.",
            UserWarning,
        )
    return found

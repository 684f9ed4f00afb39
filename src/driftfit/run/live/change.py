"""A change that an alarm with a frozen reference model found: what changed, by how much and since when."""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.live.frozen.reference_model import NOISE_WINDOW, RATIO, RAW, SCALE, SIZE, SPREAD, STD, WHICH, WINDOW
from driftfit.run.live.rule import AlarmRule

SURE = NormalDist().inv_cdf(0.975)


class Change(NamedTuple):
    """A change in the window with the largest likelihood ratio, with a band of 95 %.

    Of a parameter, ``size`` is the difference from its value in the reference; of the noise, the factor of its standard
    deviation; it is NaN where the window with the largest likelihood ratio names another cause. ``since`` is the first
    of the used samples in that window. At the onset of an alarm the size is somewhat too large, because the noise of a
    window that is beyond its limit tends to be on its side.
    """

    name: str
    size: float
    low: float
    high: float
    since: int


def change_of(rule: AlarmRule, findings: Array, t: int) -> Change:
    """The change that the statistics ``findings`` of sample t show."""
    model = rule.reference
    cause = rule.names[rule.cause(findings[rule.entries])]
    if cause == "noise" and np.isfinite(findings[RATIO]):
        L = findings[NOISE_WINDOW]
        error = 0.5 * np.sqrt(model.numbers[SPREAD] / L) / model.numbers[RAW]
        size, half = findings[RATIO], SURE * findings[RATIO] * error
    elif np.isfinite(findings[WHICH]) and (
        rule.kind == "glr" or cause in ("noise", rule.parameters[int(findings[WHICH])])
    ):
        which, L = int(findings[WHICH]), findings[WINDOW]
        unit = model.numbers[SCALE] / model.unit[which]
        cause, size, half = rule.parameters[which], findings[SIZE] * unit, SURE * findings[STD] * unit
    else:
        return Change(cause, np.nan, np.nan, np.nan, t)
    return Change(cause, float(size), float(size - half), float(size + half), max(t + 1 - int(L), 0))

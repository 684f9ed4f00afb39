"""Values out of all proportion to the others of their signal, found in a whole record: for warnings and searches.

In a run readings are judged by a gate (`driftfit.readings.gate`), one after the other.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array

ABSURD, GAP, FEWEST = 300.0, 10.0, 20
"""Usual deviations from the median beyond which a value may be a fault code, how many times further than the others it
must then be, and the number of values that this judgement needs."""


def absurd(x: Array) -> Array:
    """The values of a signal (T,) that are `ABSURD` times its usual deviation from its median, by sample; often empty.

    The usual deviation is the median one of those that are not zero, so that a signal may rest most of the time. That
    of rain is some tenths of a millimetre, so a storm is as far as a code; but only a code is `GAP` times further than
    whatever is nearer than it.
    """
    known = np.isfinite(x)
    away = np.abs(np.where(known, x, np.nan) - (np.median(x[known]) if known.any() else 0.0))
    moving = np.sort(away[known & (away > 0.0)])
    if len(moving) < FEWEST:
        return np.empty(0, int)
    beyond = moving[1:][(moving[1:] > ABSURD * float(np.median(moving))) & (moving[1:] > GAP * moving[:-1])]
    return np.flatnonzero(known & (away >= beyond.min(initial=np.inf)))

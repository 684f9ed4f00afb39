"""Recursive least squares at its best forgetting factor, for banks to be compared with.

It is tuned for the root mean square error of all parameters on records of the same kind that are not those of the
table, which favours it: banks are not tuned.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from driftfit.trackers.rls import RLS
from driftfit.tracking import track
from lab.jumps import MODEL, SIGMA, START, jumping

RECORDS, P0 = 20, 2.0
FORGETTING = (0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.93, 0.96, 0.98, 0.99)


@cache
def tuned(fault: str, offset: int) -> RLS:
    """The best RLS on records from ``offset`` on."""
    records = [jumping(seed, 600, fault) for seed in range(offset, offset + RECORDS)]

    def error(tracker: RLS) -> float:
        paths = [track(MODEL, tracker, record.y, record.u).theta - record.theta for record in records]
        return float(np.mean([np.sum(path[START:] ** 2) for path in paths]))

    return min((RLS(one, p0=P0 / SIGMA**2) for one in FORGETTING), key=error)

"""What banks are compared with: RLS and a Kalman filter, each at its best setting of a grid.

They are tuned for the root mean square error of all parameters on records of the same kind that are not those of the
table, which favours them: banks are not tuned.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from driftfit.systems.jumps import MODEL, SIGMA, START, jumping
from driftfit.track import track
from driftfit.trackers.base import Tracker
from driftfit.trackers.kalman import Kalman
from driftfit.trackers.rls import RLS

RECORDS, P0, R = 20, 2.0, SIGMA**2
FORGETTING = (0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.93, 0.96, 0.98, 0.99)
DRIFTS = (0.000125, 0.00025, 0.0005, 0.001, 0.002, 0.004, 0.008)
NOISES = (1.0, 2.0, 4.0, 8.0, 12.0)
SHAPES = ((1.0, 1.0, 1.0), (1.0, 1.0, 10.0))


@cache
def rivals(fault: str, offset: int) -> dict[str, Tracker]:
    """The best RLS and the best Kalman filter on records from ``offset`` on, by what they are called in a table."""
    records = [jumping(seed, 600, fault) for seed in range(offset, offset + RECORDS)]

    def error(tracker: Tracker) -> float:
        paths = [track(MODEL, tracker, record.y, record.u).theta - record.theta for record in records]
        return float(np.mean([np.sum(path[START:] ** 2) for path in paths]))

    faded = min((RLS(one, p0=P0 / R) for one in FORGETTING), key=error)
    walks = [
        (Kalman(tuple(d * s for s in shape), factor * R, p0=P0), d, shape, factor)
        for d in DRIFTS for shape in SHAPES for factor in NOISES
    ]  # fmt: skip
    walk, d, shape, factor = min(walks, key=lambda one: error(one[0]))
    where = f"{d:g} I" if shape[2] == 1.0 else f"{d:g} diag(1,1,10)"
    return {f"RLS {faded.forgetting:g}, tuned": faded, f"KF {where}, {factor:g} r, tuned": walk}

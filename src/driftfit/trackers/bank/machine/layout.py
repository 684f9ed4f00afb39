"""The table of a bank: where its arrays lie, and what its counters and the numbers of a sample are called.

A machine behind a symbol takes addresses only. This one takes the address of a table, whose rows say where everything
else is; every part of the machine asks it for what it needs.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

from driftfit.engine.kernel import Array, floats, kernel, wholes

(
    LEAVES, PARENTS, GROUPS, FLOORS, HELD, EXPANDED, CLOCK, IMPOSSIBLE, STORED, SETTLED, REPORTED_TO, FLIPPED, OPEN,
    REFUSED, FAULTS, AGAIN, TAKEN, COUNT,
) = range(18)  # fmt: skip
"""Counters of a bank; COUNT is how many there are. SETTLED is 1 once the tree grows, WAITING before, READY where
it begins with the next sample. OPEN floors have passed since the last used sample
(`driftfit.trackers.bank.machine.gaps`); REFUSED samples in a row were too far from what was expected, FAULTS in all;
AGAIN says that the present one was just refused; TAKEN steps of its interval are in the table of a gap already.
"""
WAITING, READY = 0, -1
(
    IN_Y, IN_NOISE, IN_DT, IN_TIME, IN_OK, IN_SEEN, R, FADE, LEAST, LAST, Y_HAT, S2, EVIDENCE, WINDOW, KEPT,
    SQUARES, TIMES, LIMIT, ELAPSED, MOST, SIZE,
) = range(21)  # fmt: skip
"""Numbers of the present sample: what comes in, and what goes out. MOST is the largest mean square that a leaf's own
prediction may have in its output lags (`driftfit.trackers.bank.leaves.lags`).
"""
NEVER = 1e9
"""Floors since the last change of a leaf that has none, or more."""
HEAD = 4
"""Entries of the report before its arrays: evidence, probability of a change in the window, mass kept, leaves."""
BESIDE = 3
"""Entries of a remembered sample before its probabilities: that of a change in the window, whether it was used, and how
many nominal intervals had passed.
"""
TOLD = 8
"""Floors that a report tells of: all, or where more are remembered the newest and the oldest."""
PACKED = (
    "A", "B", "T", "T2", "X", "links", "group", "slots", "prior", "Q", "fixed", "sizes", "factors", "maps", "theta0",
    "sensors", "chain", "initial", "given", "loss", "knobs", "bases", "stamps", "parts", "root", "samples", "Qt",
    "ring", "news", "gap", "moving", "path", "lag_prob", "brief", "decided",
)  # fmt: skip
"""Arrays of a bank that lie one after the other in the field `memory`, the last two in `report`, so that banks of many
shapes have one type of record and one driver. Row k of the table says where, in bytes, and rows and columns.
"""
AT: Any = namedtuple("AT", PACKED)(*range(len(PACKED)))
"""Rows of the table by the names of the arrays, for the machine."""
GIVEN, FACTORS = AT.given, AT.factors
PLACES, ADDRESSES, REPORTED = len(PACKED), 9, PACKED[-2:]
BASE, REPORT, PHI, POWERS, THETA, COV, MANY, NOW, OWNERS, FLAGS, PLAIN, ROWS = range(PLACES, PLACES + 12)
"""Further rows of the table, whose first entry is an address, OWNERS that of the user's own likelihoods; of FLAGS the
output lags that leaves have of their own, and whether the noise is unknown and events are independent; of PLAIN whether
all leaves have one regressor, all changes are walks and all sensors differ in their noise alone, whether all changes
are walks, and whether what may have happened since the last used sample is one floor; and how many rows there are.
"""


@kernel
def packed(t: Array, k: int) -> Any:
    """One of the packed arrays, of floats."""
    return floats(t[BASE if k < PLACES - 2 else REPORT, 0] + t[k, 0], t[k, 1], t[k, 2])


@kernel
def whole(t: Array, k: int) -> Any:
    """One of the packed arrays, of whole numbers."""
    return wholes(t[BASE, 0] + t[k, 0], t[k, 1], t[k, 2])

"""The table of a bank: the places of its arrays, and the names of its counters and of the numbers of a sample.

Every part of the compiled routine is given the table alone (`driftfit.trackers.bank.table`) and reads from it by name.
Rows of leaves, events of all tables, and parameters are counted as in `driftfit.trackers.bank.leaves.leaf_matrix`.
With n parameters, tri = n (n + 1) / 2 and H joint events, H_d changes and H_m sensors, the fields are

    parents, leaves         the leaves before and after the tree has grown, one a column
    history, history_2      what leaves remember of their events, one a row (`machine.ancestry`); the counter FLIPPED
                            says which of the two is valid
    parent, event           of every leaf: the column it came from, and the joint event that made it
    group, start, order     which leaves become one: a number for every leaf, members in the order of their groups
    slots                   a table of hashes for numbering groups
    prior                   p(next joint event | leaf), (H, leaves)
    walks, relative_walks   covariances that changes add in a nominal sample; in units of r / (mean square of phi_i)
    fixed_walks             the first of these for theta, where `machine.framed` writes them in other coordinates
    drift                   factors of the drift of every change at this sample
    Q                       covariances that changes add in this interval, and a spare row
    maps, maps_nominal      changes that forget (`leaves.forget`), for this interval and for a nominal one
    places                  theta0 and what else changes need to know (`leaves.forget`)
    sensors                 the columns of `leaves.forecast`, a row for every sensor
    transition, initial     the Markov chain of joint events, from a row to a column; the distribution of the first
    given, given_chain      what the user says of this sample: prior of the joint events; chain of the changes
    chain, row              of this sample: the chain, and the prior of the events that all leaves have in common
    loss, reduction, bases  losses of decisions; settings of the reduction; limits of the codes of leaves
    stamps, decided         when the undecided events were; what was decided at this sample
    components              of the predictive density (`reducing.lookahead`)
    root, samples           for growing the tree again (`reducing.refilter`)
    ring                    recent samples for events of a stream
    new_events              what an event adds to a history
    gap, path               what may have happened since the last used sample (`machine.gaps`)
    lag_prob, newest        marginals of the events of all levels; of those that are reported
    C, m, z, g              of the columns that a sample meets: covariance, mean, regressor, C z
    expected                their z'C z and z'm
    scores                  their unit of covariance or log density; then two rows to spare
    scratch, from_g, spare  rows to work in: all of them, those from g on, and those that hold none of the above
    said                    what a likelihood of the user's own says of each leaf (`leaves.own_sensor`)
    spare_lags, narrow      spare rows, as many as output lags; spare rows of eight columns
"""

from __future__ import annotations

from typing import Any

from driftfit.engine.kernel import kernel
from driftfit.engine.tracker_part import open_at
from driftfit.trackers.bank.table import COUNTS, MATRIX, NUMBER, VECTOR, Table

(
    LEAVES, PARENTS, GROUPS, TREE_LEVELS, HELD, EXPANDED, CLOCK, IMPOSSIBLE, STORED, SETTLED, REPORTED_TO, FLIPPED,
    OPEN, REFUSED, FAULTS, AGAIN, TAKEN, CHAINED, ALIKE, WIDE, PARTED, COUNT,
) = range(22)  # fmt: skip
"""Counters of a bank; COUNT is how many there are. SETTLED is 1 once the tree grows, WAITING before, READY where
it begins with the next sample. OPEN levels have passed since the last used sample
(`driftfit.trackers.bank.machine.gaps`); REFUSED samples in a row were too far from what was expected, FAULTS in all;
AGAIN says that the present one was just refused; TAKEN steps of its interval are in the table of a gap already. Of the
present sample: CHAINED that the user gave a chain of changes, ALIKE that all leaves have one prior, WIDE that its level
is another than that of one nominal interval, PARTED that leaves are continued as two (`machine.gaps.chain_gap`).
"""
WAITING, READY = 0, -1
(
    IN_Y, IN_NOISE, IN_DT, IN_TIME, IN_OK, IN_SEEN, R, FADE, LEAST, LAST, Y_HAT, S2, EVIDENCE, WINDOW, KEPT,
    SQUARES, TIMES, LIMIT, ELAPSED, MOST, FREEDOM, SHIFT, READING, LOWEST, HIGHEST, DOUBTS, ENTERS, SIZE,
) = range(28)  # fmt: skip
"""Numbers of the present sample: what comes in, and what goes out. MOST is the largest mean square that a leaf's own
prediction may have in its output lags (`driftfit.trackers.bank.leaves.lags`). FREEDOM is that of an estimated noise
variance before the tree grows: the residuals until then; inf for a variance that is given. The reading is y + SHIFT
(`driftfit.trackers.parts.resolution`). READING is the last one that counted, LAST the same less the present shift;
LOWEST and HIGHEST are the limits of all that counted. DOUBTS is the recent number of refused samples within them.
ENTERS is not 0 if the regressor is the first along a direction (`machine.late_direction`): its length along it.
"""
NEVER = 1e9
"""Levels since the last change of a leaf that has none, or more."""
HEAD = 4
"""Entries of the report before its arrays: evidence, probability of a change in the window, mass kept, leaves."""
SAMPLE_HEAD = 3
"""Entries of a remembered sample before its probabilities: that of a change in the window, whether it was used, and how
many nominal intervals had passed.
"""
MOST_REPORTED = 8
"""Levels in a report: all, or where more are remembered the newest and the oldest."""

MATRICES = (
    "parents", "leaves", "history", "history_2", "prior", "walks", "fixed_walks", "relative_walks", "maps",
    "maps_nominal", "places", "sensors", "transition", "loss", "components", "root", "samples", "Q", "ring",
    "new_events", "gap", "path", "chain", "lag_prob", "scratch",
)  # fmt: skip
VECTORS = ("drift", "initial", "row", "given", "given_chain", "reduction", "bases", "stamps")
WHOLE = ("parent", "event", "start", "order", "group", "slots")
"""Arrays of whole numbers."""
REPORTED = ("newest", "decided")
"""Arrays that are part of the report."""
WINDOWS = ("C", "m", "z", "g", "from_g", "expected", "scores", "spare", "spare_lags", "narrow", "said")
"""Rows of the scratch that have names."""
OUTSIDE = {
    "report": VECTOR, "phi": VECTOR, "powers": VECTOR, "theta": VECTOR, "cov": MATRIX, "counters": COUNTS,
    "sample": VECTOR,
}  # fmt: skip
"""Arrays that are fields of the state themselves."""
NUMBERS = ("n", "output_lags", "unknown", "independent", "plain", "walks_only", "apart", "own_likelihoods")
"""n; the number of separate output lags of leaves; whether the noise is unknown, events are independent; whether all
leaves have one regressor, all changes are walks and all sensors differ in their noise alone; whether all changes are
walks; whether what may have happened since the last used sample is one level; and the address of the user's own
likelihoods, while the compiled routine runs.
"""
BASES = ("memory", *(f"{name}_at" for name in OUTSIDE))
"""Rows with addresses: of the field `memory`, in which most arrays lie one after the other, so that banks of all
shapes have one driver; and of the other arrays. In those of `memory` and `report` the last column is their length.
"""
PACKED = (*MATRICES, *VECTORS, *WHOLE, *REPORTED)
TABLE = Table(
    "bank",
    {name: MATRIX for name in (*MATRICES, *REPORTED, *WINDOWS)}
    | {name: VECTOR for name in VECTORS} | {name: COUNTS for name in WHOLE} | OUTSIDE
    | {name: NUMBER for name in NUMBERS},
    BASES,
    {name: f"{name}_at" for name in OUTSIDE} | {name: "report_at" for name in REPORTED},
)  # fmt: skip
ROW, ROWS = TABLE.row, len(TABLE.row)
"""Rows of the table by the names of fields and bases, and how many there are."""
MEMORY_AT, REPORT_AT, PHI_AT, POWERS_AT, THETA_AT, COV_AT, COUNTERS_AT, SAMPLE_AT = (ROW[name] for name in BASES)
table_at = TABLE.at
"""The table at an address, for compiled code."""


@kernel
def report_at(s: Any) -> int:
    """Where the field `report` begins, the first of those whose length is no part of the compiled type."""
    return open_at(s)  # type: ignore[no-any-return]


@kernel
def memory_at(s: Any) -> int:
    """Where the field `memory` begins, behind the report."""
    return open_at(s) + 8 * s.theta.shape[1] * s.table[REPORT_AT, 2, 0]  # type: ignore[no-any-return]


@kernel
def first(t: Any) -> bool:
    """Whether this is the first level of the tree."""
    return t.counters[TREE_LEVELS] == 0  # type: ignore[no-any-return]


@kernel
def flip(t: Any) -> None:
    """The two tables of histories change places."""
    t.counters[FLIPPED] = 1 - t.counters[FLIPPED]

"""The table of a bank: the places of its arrays, and the names of its counters and of the numbers of a sample.

Every part of the compiled routine is given the table alone (`driftfit.bank.table`) and reads from it by name.
Rows of leaves, events of all tables, and parameters are counted as in `driftfit.bank.leaves.leaf_matrix`.
With n parameters, tri = n (n + 1) / 2 and H joint events, H_d changes and H_m sensors, the fields are

    parents, leaves         the leaves before and after the tree has grown, one per column
    history, history_2      the events of every leaf, one leaf per row (`machine.ancestry`); ``flipped`` says
                            which of the two is valid
    parent, event           for every leaf the column of its parent, and the joint event that created it
    group, start, order     the leaves that are merged: a group number for every leaf, members in the order of groups
    slots                   a hash table for numbering groups
    prior                   p(next joint event | leaf), (H, leaves)
    walks, relative_walks   covariances that changes add in a nominal sample; in units of r / (mean square of phi_i)
    packed                  W as one row
    fixed_walks             `walks` for theta, where `machine.framed` writes `walks` in other coordinates
    fixed_places            `places` likewise
    lag_rows                for each output lag its coefficients as a function of z, and its value in the record
    drift                   factors of the drift of every change at this sample
    Q                       covariances that changes add in this interval, and a spare row
    maps, maps_nominal      changes that forget (`leaves.forget`), for this interval and for a nominal one
    places                  theta0 and the other vectors that changes need (`leaves.forget`)
    sensors                 the columns of `leaves.forecast`, one row per sensor
    transition, initial     Markov chain of the joint events, from row to column; distribution of the first event
    given, given_chain      the user's prior of the joint events at this sample, and the user's chain of the changes
    chain, row              the chain at this sample, and the prior of the events that all leaves have in common
    counts                  changes that are expected to have happened, before the record and until now; no rows if
                            their probabilities are given
    loss, reduction, bases  losses of decisions; settings of the reduction; limits of the codes of leaves
    stamps, decided         times of the undecided events; the decisions made at this sample
    components              components of the predictive density (`reducing.lookahead`)
    root, samples           the start and the samples from which the tree is grown again (`reducing.refilter`)
    ring                    recent samples, for the events of a stream
    new_events              the entries that an event adds to a history
    gap, path               changes that may have happened since the last used sample (`machine.gap`)
    lag_prob, newest        marginals of the events of all levels; of the levels that are reported
    C, m, z, g              for the columns that a sample updates: covariance, mean, regressor, C z
    expected                z'C z and z'm of these columns
    scores                  the unit of their covariance, or their log density; then two spare rows
    scratch, spare          scratch rows: all of them, and those that contain none of the above
    from_C, from_g          those from C on, which are all but z, and from g on
    answers                 results of a user's own likelihood for each leaf (`leaves.own_sensor`)
    spare_lags              spare rows, as many as output lags; `spare_square` as many as entries of a matrix
    lag_coefficients        the coefficients of the output lags
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np
from numba import types

from driftfit.bank.table import COUNTS, MATRIX, NUMBER, VECTOR, TableType
from driftfit.bank.table import table_at as at
from driftfit.engine.kernel import Array, kernel

_Counters = namedtuple(
    "_Counters",
    "many_leaves settled open phase held clock impossible reported_to many_parents groups levels expanded stored "
    "flipped taken chained alike wide parted looked framed",
)
COUNTER = _Counters(*range(21))
"""Whole numbers of a bank. ``settled`` is 1 once the tree grows, `WAITING` before, `READY` if it begins with the next
sample; ``levels`` counts those of the tree. ``open`` levels have passed since the last used sample (`machine.gap`),
``taken`` steps of its interval are already in the table of a gap. Flags of the present sample: ``chained`` if the user
gave a chain of changes, ``alike`` if all leaves have the same prior, ``wide`` if its level is not that of one nominal
interval, ``parted`` if leaves are continued as two (`machine.markov_gap`), ``expanded`` if histories are those of the
leaves and not of their parents. ``phase`` says what the routine is called for, ``looked`` for which kind of sample its
forecast was. ``framed`` is 1 in the coordinates of `machine.framed`.
"""
WAITING, READY = 0, -1
LEARN, FORECAST, ENTER, ENTER_NEW = range(4)
"""Phases. A sample with which a coordinate enters is learned by all leaves, its coordinate known before or `NEW`."""
_Sample = namedtuple(
    "_Sample",
    "y noise dt time ok observed r fade least most y_hat s squares times elapsed freedom shift reading unit last "
    "evidence window kept",
)
SAMPLE = _Sample(*range(23))
"""Numbers of the present sample: inputs and results. ``most`` is the largest mean square that a leaf's own prediction
may have in its output lags (`leaves.lags`), ``least`` the smallest noise variance. Before the tree grows ``freedom`` is
that of an estimated noise variance, inf for one that is given. ``reading`` is y + ``shift`` of the last accepted sample
(`driftfit.readings.repeats`), ``last`` the same minus the present shift. ``unit`` is the mean unit of
the covariances of leaves: 1, or the noise variance where it is unknown.
"""
NEVER = 1e9
"""The number of levels since the last change, for a leaf without a change."""
HEAD, SAMPLE_HEAD = 4, 3
"""Entries before the arrays of a report: evidence, probability of a change in the window, mass kept, leaves; and before
the probabilities of a remembered sample: that of such a change, whether it was used, how many intervals had passed.
"""
MOST_REPORTED = 8
"""Largest number of levels in a report; if more are remembered, it holds the newest and the oldest."""

MATRICES = (
    "parents", "leaves", "history", "history_2", "prior", "walks", "fixed_walks", "relative_walks", "maps",
    "maps_nominal", "places", "fixed_places", "lag_rows", "spare_square",
    "sensors", "transition", "loss", "components", "root", "samples", "Q", "ring",
    "new_events", "gap", "path", "chain", "counts", "lag_prob", "scratch",
)  # fmt: skip
VECTORS = ("drift", "initial", "row", "given", "given_chain", "reduction", "bases", "stamps")
WHOLE, REPORTED = ("parent", "event", "start", "order", "group", "slots"), ("newest", "decided")
"""Arrays of whole numbers, and those that are part of the report."""
WINDOWS = (
    "z", "from_C", "C", "m", "g", "from_g", "expected", "scores", "spare", "spare_lags", "lag_coefficients", "answers",
)  # fmt: skip
"""Rows of the scratch that have names."""
OUTSIDE = {"report": VECTOR, "phi": VECTOR, "c": VECTOR, "theta": VECTOR, "cov": MATRIX, "S": MATRIX, "R": MATRIX}
OUTSIDE |= {"H": MATRIX, "W": MATRIX, "work": MATRIX, "at_start": VECTOR}
"""Arrays that are fields of the state themselves: the report, the sample, the mean squares of its regressors, the
mixture, and those of the coordinates of the start (`driftfit.trackers.forms.coordinates`).
"""
VARIABLES = {"counters_at": (types.int64, COUNTER._fields), "sample_at": (types.float64, SAMPLE._fields)}
"""Names of single numbers, by the base of the field in which they lie."""
NUMBERS = (
    "n", "output_lags", "unknown", "independent", "plain", "walks_only", "apart", "own_likelihoods",
)  # fmt: skip
"""n; the number of separate output lags of leaves; whether the noise is unknown, and whether events are independent;
whether all leaves have one regressor, all changes are walks and all sensors differ in their noise alone; whether all
changes are walks; whether what may have happened since the last used sample is one level; and the address of the user's
own likelihoods, during a sample.
"""
BASES = ("memory", *(f"{name}_at" for name in OUTSIDE), *VARIABLES)
"""Rows with addresses: of the field `memory`, in which most arrays lie one after the other, so that banks of all
shapes have one driver; and of the other arrays. In those of `memory` and `report` the last column is their length.
"""
PACKED = (*MATRICES, *VECTORS, *WHOLE, *REPORTED)
_FIELDS = {name: MATRIX for name in (*MATRICES, *REPORTED, *WINDOWS)} | {name: VECTOR for name in VECTORS}
_FIELDS |= {name: COUNTS for name in WHOLE} | {name: NUMBER for name in NUMBERS} | OUTSIDE | {"packed": VECTOR}
_BASED = {name: f"{name}_at" for name in OUTSIDE} | {name: "report_at" for name in REPORTED} | {"packed": "W_at"}
ROW = {field: row for row, field in enumerate((*_FIELDS, *BASES))}
ROWS = len(ROW)
"""Rows of the table by the names of fields and bases, and how many there are."""
MEMORY_AT, REPORT_AT, OUTPUT_LAGS = ROW["memory"], ROW["report_at"], ROW["output_lags"]
table_at = at(TableType(
    {name: (ROW[name], kind, ROW[_BASED.get(name, "memory")]) for name, kind in _FIELDS.items()},
    {one: (ROW[base], kind, k) for base, (kind, names) in VARIABLES.items() for k, one in enumerate(names)},
))  # fmt: skip
"""The table at an address, for compiled code."""


@kernel
def report_at(s: Any) -> int:
    """Where the field `report` begins, the first of those whose length is not part of the compiled type."""
    return s.end.ctypes.data + np.int64(s.end[0, 0])  # type: ignore[no-any-return]


@kernel
def memory_at(s: Any) -> int:
    """Where the field `memory` begins, behind the report."""
    return report_at(s) + 8 * s.theta.shape[1] * s.table[REPORT_AT, 2, 0]  # type: ignore[no-any-return]


@kernel
def tables(t: Any) -> tuple[Array, Array]:
    """The table of histories that is valid, and the other one."""
    return (t.history_2, t.history) if t.flipped > 0 else (t.history, t.history_2)


@kernel
def flip(t: Any) -> None:
    """The two tables of histories change places."""
    t.flipped = 1 - t.flipped

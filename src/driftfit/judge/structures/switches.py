"""When did the structure change? A delay that drifts, an order that a new load requires, with dates.

Structures that are columns of one regression differ by which of its coefficients are 0, so a switch from one to another
is a change of these coefficients. Their dates, with 95 % intervals, are those of `driftfit.judge.changes` for the
regression on all columns. Between two dates the structure is that of least BIC. A date on whose sides it is the same is
a change of parameters, and no switch.

Source: Bai and Perron (1998) for the dates; Schwarz (1978). Cost: a verdict on the union of the columns, and O(N n^2)
for each structure.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.fit import left
from driftfit.judge.evidence import judged_rows
from driftfit.judge.regressors import Rows


class Switch(NamedTuple):
    """A change of structure: ``at`` is the first sample of the new one, within [earliest, latest] with 95 %."""

    at: int
    earliest: int
    latest: int
    before: str
    after: str


def switches(names: Sequence[str], y: Array, phi: Array, columns: Sequence[list[int]], level: float) -> list[Switch]:
    """The switches between structures, from outputs (T,) and the regressors (T, n) of their union; ``level`` is the
    probability that one is found where nothing changes."""
    at = np.flatnonzero(np.isfinite(phi).all(axis=1) & np.isfinite(y))
    found = judged_rows(Rows(at, phi[at], y[at]), level)
    if found is None or not found.rejected:
        return []
    breaks, spans, best = found.found.breaks.tolist(), at[found.found.spans].tolist(), []
    for first, last in pairwise([0, *breaks, len(at)]):
        rows, N = at[first:last], last - first
        own = [N * np.log(left(phi[rows][:, one], y[rows])) + len(one) * np.log(N) for one in columns]
        best.append(names[int(np.argmin(own))])
    each = zip(at[breaks].tolist(), spans, pairwise(best), strict=True)
    return [Switch(date, first, last, one, other) for date, (first, last), (one, other) in each if one != other]

"""The record of a run without what its tracker left out, so that others learn from the same readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.run.result import Track, burn_in
from driftfit.smooth.problem import blocks

STARTED = 2
"""The samples of a start are among the first used ones, of which there are so many times those that are not scored."""
LEAST_RUN, CHANCE, MOVING = 10, 1e-6, 0.5
"""Repeats of a run that may be those of a stuck sensor; the probability of one by chance; and the share of steps at
which every input moves meanwhile."""


def without_left_out(run: Track) -> Record:
    """The record of a run without what its tracker left out.

    Readings that it took for faults are missing, as outputs and as lags. Other samples that it left out, because their
    regressors are to blame, keep their readings and have no weight. Readings of a sensor that is stuck (`stuck`) are
    missing, too.
    """
    y, known = run.y, run.known
    given = (np.abs(y) < LARGEST) & (known.noise < np.inf)
    refused, unused = stuck(y, run.u), np.zeros(len(y), bool)
    if any(run.ended_with(name) for name in ("left_out", "refused", "inputs_out")):
        out, unused = _left_out(run)
        refused |= out
    elif not refused.any():
        return run.record
    refused, unused = given & refused, given & unused
    if run.model.implicit:  # the reading is in the regressor, too
        refused |= unused
    noise = np.where(unused, np.inf, known.noise)
    return replace(run.record, y=np.where(refused, np.nan, y), known=known.changed(noise=noise))


def stuck(y: Array, u: Array) -> Array:
    """Which readings (T,) repeat the one before in a run that is too long for chance, while all inputs u (T, m) move.

    With p the share of repeated readings in the rest of the record, a run of k repeats is too long if T p^k is below
    `CHANCE`. Runs at the least or the largest reading are those of a plant at rest, or of a range that ends.
    """
    found = np.zeros(len(y), bool)
    known = np.flatnonzero(np.abs(y) < LARGEST)
    if len(known) <= LEAST_RUN or y.ndim > 1:
        return found
    same = np.concatenate([[False], y[known[1:]] == y[known[:-1]], [False]])
    begins, ends = np.flatnonzero(~same[:-1] & same[1:]), np.flatnonzero(same[:-1] & ~same[1:])
    ends[:] = np.where(ends > len(known), len(known), ends + 1)
    steps, repeats = len(known) - 1, int(same.sum())
    low, high = float(y[known].min()), float(y[known].max())
    for first, last in zip(begins, ends, strict=True):
        k, at = last - first - 1, known[first:last]
        p = (repeats - k + 1.0) / (steps - k + 2.0)
        moves = np.mean(np.diff(u[at], axis=0) != 0.0, axis=0) if k > 0 else np.zeros(u.shape[1])
        inside = low < y[at[0]] < high
        if k >= LEAST_RUN and inside and u.shape[1] and moves.min() > MOVING and len(y) * p**k < CHANCE:
            found[at[1:]] = True
    return found


def _left_out(run: Track) -> tuple[Array, Array]:
    """Samples (T,) with a reading that counted as missing, and those that were not used although they were complete."""
    refused, unused = np.zeros((2, len(run)), bool)
    start: list[Array] = []
    used = 0
    for first, rows in blocks(run):
        part = slice(first, first + len(rows))
        ok = rows["ok"][:, 0] > 0.0
        refused[part], unused[part] = rows["observed"][:, 0] == 0.0, (rows["valid"][:, 0] > 0.0) & ~ok
        if used < STARTED * burn_in(run.model.n) and run.start is None:
            start.append(rows.copy())
            used += int(ok.sum())
    if start:
        _left_out_later(run, np.concatenate(start), refused, unused)
    return refused, unused


def _left_out_later(run: Track, rows: Array, refused: Array, unused: Array) -> None:
    """Add those of the start (N,) that were left out once later samples contradicted them.

    A reading is to blame where it is beyond all that were used by more than their range.
    """
    fields = {name: rows[name][..., 0] for name in rows.dtype.names or ()}
    tracker, ok, y = run.tracker, fields["ok"] > 0.0, run.y[: len(rows)]
    field = fields.__getitem__ if tracker.smoother_fields else run.ended_with
    left = tracker.left_out(field, fields["phi"], fields["y"], ok)
    kept = y[ok & ~left]
    if left.any():
        unused[: len(rows)] |= left
        refused[: len(rows)] |= left & (np.abs(y - 0.5 * (kept.min() + kept.max())) > 1.5 * np.ptp(kept))

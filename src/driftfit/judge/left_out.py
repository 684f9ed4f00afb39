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


def without_left_out(run: Track) -> Record:
    """The record of a run without what its tracker left out.

    Readings that it took for faults are missing, as outputs and as lags. Other samples that it left out, because their
    regressors are to blame, keep their readings and have no weight.
    """
    if not any(run.ended_with(name) for name in ("left_out", "refused", "inputs_out")):
        return run.record
    refused, unused = _left_out(run)
    y, known = run.y, run.known
    given = (np.abs(y) < LARGEST) & (known.noise < np.inf)
    refused, unused = given & refused, given & unused
    if run.model.implicit:  # the reading is in the regressor, too
        refused |= unused
    noise = np.where(unused, np.inf, known.noise)
    return replace(run.record, y=np.where(refused, np.nan, y), known=known.changed(noise=noise))


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

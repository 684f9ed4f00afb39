"""Which gate stands before a tracker, and what it found among the first samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.kernel import Array
from driftfit.readings.first_samples import READING, TIMES
from driftfit.readings.gate import Gate
from driftfit.trackers.base import Tracker


def gate_of(tracker: Tracker, gate: Gate | bool | None) -> Gate | None:
    """The gate before a tracker: one with its settings, True for the usual one, False for none; None: as it asks."""
    if isinstance(gate, Gate):
        return gate
    if gate is not None and not isinstance(gate, bool):
        raise ValueError(f"gate must be True, False, None or a Gate; got {gate!r}.")
    return Gate() if (tracker.gated if gate is None else gate) else None


def without_start(gate: Gate | None) -> Gate | None:
    """A gate that does not judge first samples together: those of several outputs cannot be run again alone."""
    return None if gate is None else replace(gate, first=0)


class AtStart(NamedTuple):
    """Codes that were found among the first samples."""

    ago: Array
    """How many samples (k,) ago: 0 for the last."""
    intervals: Array
    """How many nominal intervals (k,) ago."""
    value: Array
    """The readings (k,) of y."""
    codes: Array
    """Which signals (k, 1 + m), the output first, were codes."""


def readings_of(lane: Mapping[str, Array]) -> Array:
    """The readings of the first samples that a gate remembers, as they were given."""
    rows = lane["gate_first"][: int(lane["gate_kept"])]
    return np.array(np.repeat(rows[:, READING], rows[:, TIMES].astype(int)))


def without_codes(record: Record, last: int, start: AtStart) -> Record:
    """A record without the codes that were found among its first samples, at sample ``last``."""
    (y, u), at = (record.y.copy(), record.u.copy()), last - start.ago
    y[at[start.codes[:, 0]]] = np.nan
    u[at] = np.where(start.codes[:, 1:], np.nan, u[at])
    return replace(record, y=y, u=u)

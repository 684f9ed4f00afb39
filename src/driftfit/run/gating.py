"""Which gate stands before a tracker, and what it found among the first samples."""

from __future__ import annotations

from dataclasses import replace

from driftfit.data.record import Record
from driftfit.readings.first_samples import First
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


def without_codes(record: Record, last: int, first: First) -> Record:
    """A record without the codes that were found among its first samples, at sample ``last``."""
    count = min(last + 1, len(first.y))
    part = slice(last + 1 - count, last + 1)
    y, u = record.y.copy(), record.u.copy()
    y[part], u[part] = (signal[-count:] for signal in first.without_codes())
    return replace(record, y=y, u=u)

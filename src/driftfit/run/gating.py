"""Which gate stands before a tracker, and what it found among the first samples."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.kernel import Array
from driftfit.readings.first_samples import First
from driftfit.readings.gate import AT_START, SIGNAL, Gate
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
    """What was decided of the first samples, which were judged together, and of some of them once more one by one."""

    ago: Array
    """How many samples (k,) ago: 0 for the last."""
    intervals: Array
    """How many nominal intervals (k,) ago."""
    value: Array
    """The readings (k,) of y."""
    codes: Array
    """Which signals (k, 1 + m), the output first, were codes."""
    decided: Array
    """The decisions (k,) as a gate stores them."""


def at_start(first: First, reason: Array) -> AtStart:
    """What was decided, given the first samples and the decisions (k,) when they were taken in again."""
    decided = np.where(first.codes.any(axis=1), AT_START + SIGNAL * np.argmax(first.codes, axis=1), reason)
    at = np.append(np.arange(-first.dropped, 0), np.flatnonzero(decided))
    row, dt = np.maximum(at, 0), first.known[:, 0]
    intervals = (np.cumsum(dt[::-1])[::-1] - dt)[row] + (row - at) * dt[0]
    return AtStart(len(dt) - 1 - at, intervals, first.readings[row], first.codes[row], decided[row])


def without_codes(record: Record, last: int, start: AtStart) -> Record:
    """A record without the codes that were found among its first samples, at sample ``last``."""
    (y, u), at = (record.y.copy(), record.u.copy()), last - start.ago
    codes, at = start.codes[at >= 0], at[at >= 0]
    y[at[codes[:, 0]]] = np.nan
    u[at] = np.where(codes[:, 1:], np.nan, u[at])
    return replace(record, y=y, u=u)

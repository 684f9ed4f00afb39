"""Samples by topic, decoded from JSON.

A payload is an object of numbers (one sample), an object of lists of equal length (many samples; numbers beside them
are repeated), or a list of objects:

    {"ts": 12.0, "flow": 3.1}      {"ts": [12.0, 13.0], "flow": [3.1, 3.2]}      [{"ts": 12.0, "flow": 3.1}, ...]

Anything else raises ValueError, which the caller counts. Decoding an object takes less than a microsecond.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, NamedTuple

import msgspec
import numpy as np

from driftfit.engine.kernel import Array

MESSAGE_SAMPLES = 10_000
"""Samples of one message."""
MESSAGE_FIELDS = 256
"""Fields of one message."""
MESSAGE_BYTES = 4 << 20
"""Bytes of one message."""

Cell = float | int | bool | str | None
_DECODE = msgspec.json.Decoder(dict[str, Cell | list[Cell]] | list[dict[str, Cell]])

NAMED_SAMPLES = 20
"""Samples of a message that an answer names."""

TOO_MANY_NEW = "too many new units"
NO_SIGNAL = "no signal"
"""Why a unit that reads a topic took no sample of it."""


class Samples(NamedTuple):
    """Samples of one topic."""

    topic: str
    length: int
    columns: Mapping[str, Any]
    """A list of ``length`` values, or one value for all of them, by name of the field."""


@dataclass
class Receipt:
    """What becomes of a batch, for a sender that waits for an answer."""

    offered: int = 0
    """Samples times the units that read their topic."""
    left_out: Counter[str] = field(default_factory=Counter)
    """How many of these the units did not take, by reason."""
    missing: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """By topic and signal: how many samples have no finite number for it, and the first of them."""

    def note_missing(self, samples: Samples, names: Iterable[str]) -> None:
        """Note the samples of a message without a finite number for one of the signals ``names``."""
        for name in names:
            cells = samples.columns.get(name)
            if isinstance(cells, list):
                places = np.flatnonzero(~np.isfinite(numbers_of(cells))).tolist()
            else:
                places = [] if math.isfinite(number(cells)) else list(range(samples.length))
            if places:
                signals = self.missing.setdefault(samples.topic, {})
                signals[name] = {"count": len(places), "first": places[:NAMED_SAMPLES]}


class ShapeError(ValueError):
    """A message in JSON that holds no samples: lists of different lengths, too many of them, or none."""


def decode(topic: str, payload: bytes | str) -> Samples:
    """The samples of one message; ValueError if it is not one of the three forms."""
    if len(payload) > MESSAGE_BYTES:
        raise ValueError(f"a message of {len(payload)} bytes; at most {MESSAGE_BYTES} are read.")
    try:
        data = _DECODE.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        data = _with_nan(payload)
    if isinstance(data, list):
        return _bounded_rows(topic, data)
    if len(data) > MESSAGE_FIELDS:
        raise ShapeError(f"{len(data)} fields; at most {MESSAGE_FIELDS} are read.")
    sizes = {name: len(value) for name, value in data.items() if isinstance(value, list)}
    lengths = set(sizes.values())
    if len(lengths) > 1:
        found = ", ".join(f"{name[:50]} {size}" for name, size in list(sizes.items())[:8])
        raise ShapeError(f"lists of different lengths ({found}); give one number per sample in each, null if missing.")
    return Samples(topic, bounded(lengths.pop() if lengths else 1), data)


def _with_nan(payload: bytes | str) -> Any:
    """JSON with NaN or Infinity, which Python's own encoder writes."""
    raw = payload if isinstance(payload, str) else payload.decode("utf-8", "replace")
    if "NaN" not in raw and "Infinity" not in raw:
        raise ValueError("not an object of numbers, an object of lists, or a list of objects in JSON.")
    try:
        return msgspec.convert(json.loads(raw), dict[str, Cell | list[Cell]] | list[dict[str, Cell]])
    except (ValueError, msgspec.ValidationError, RecursionError):
        raise ValueError("not JSON.") from None


def _bounded_rows(topic: str, rows: list[dict[str, Cell]]) -> Samples:
    bounded(len(rows))
    found = of_rows(topic, rows)
    if len(found.columns) > MESSAGE_FIELDS:
        raise ShapeError(f"{len(found.columns)} fields; at most {MESSAGE_FIELDS} are read.")
    return found


def of_rows(topic: str, rows: list[dict[str, Any]]) -> Samples:
    """A sample for each row, missing where it has no cell."""
    names = dict.fromkeys(name for row in rows for name in row)
    return Samples(topic, len(rows), {name: [row.get(name) for row in rows] for name in names})


def by_topic(rows: Iterable[tuple[str, dict[str, Any]]]) -> list[Samples]:
    """The samples of each topic, from rows with their topics."""
    found: dict[str, list[dict[str, Any]]] = {}
    for topic, row in rows:
        found.setdefault(topic, []).append(row)
    return [of_rows(topic, own) for topic, own in found.items()]


def bounded(count: int) -> int:
    """A number of samples that one message may have; ValueError for another."""
    if not 0 < count <= MESSAGE_SAMPLES:
        raise ShapeError(f"{count} samples in one message; 1 to {MESSAGE_SAMPLES} are read.")
    return count


def number(cell: Any) -> float:
    """A cell as a number; NaN if it is none."""
    if type(cell) is float:
        return cell
    if cell is None or isinstance(cell, bool):
        return math.nan if cell is None else float(cell)
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def seconds(cell: Any, scale: float) -> float:
    """A time as seconds: a number in units of ``scale`` seconds, or a date in ISO 8601, in UTC unless it has a zone."""
    if isinstance(cell, str):
        try:
            date = datetime.fromisoformat(cell)
        except ValueError:
            return number(cell) * scale
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    return number(cell) * scale


def numbers_of(cells: list[Any]) -> Array:
    try:
        found = np.array(cells, float)
        return found if found.ndim == 1 else np.array([number(cell) for cell in cells])
    except (TypeError, ValueError, OverflowError):
        return np.array([number(cell) for cell in cells])


def seconds_of(cells: list[Any], scale: float) -> Array:
    if str in set(map(type, cells)):
        return np.array([seconds(cell, scale) for cell in cells])
    return numbers_of(cells) * scale

"""Sparkplug B (Eclipse, version 3.0) as the payload of MQTT: its protobuf messages, read without a library.

    spBv1.0/GROUP/DDATA/NODE/DEVICE        NBIRTH, DBIRTH, NDATA and DDATA carry metrics; others are not samples

The topic of the samples is that without the type of the message, spBv1.0/GROUP/NODE/DEVICE, and the fields are the
names of the metrics and ``timestamp`` in milliseconds. A birth declares the metrics, with numbers (aliases) that later
messages use for their names. A node reports a metric when it has changed, so one that a message leaves out keeps its
last value; a null is missing. Metrics of one message at different times are samples of their own, and historical ones
change no last value.

Departures: data sets, templates and files are left out, and sequence numbers are not checked, because samples that come
twice or late are recognised by their times.
"""

from __future__ import annotations

from collections.abc import Iterator
from struct import unpack_from
from typing import Any

from driftfit.service.connect.samples import MESSAGE_BYTES, MESSAGE_FIELDS, Samples, bounded, of_rows

PREFIX = "spBv1.0"
BIRTHS, DATA = ("NBIRTH", "DBIRTH"), ("NDATA", "DDATA")
KNOWN_NODES = 100_000
"""Nodes and devices whose metrics are known."""
METRICS, TIMESTAMP = 2, 1
"""Fields of a payload."""
NAME, ALIAS, WHEN, TYPE, HISTORICAL, NULL = 1, 2, 3, 4, 5, 7
INT, LONG, FLOAT, DOUBLE, BOOLEAN, STRING = 10, 11, 12, 13, 14, 15
"""Fields of a metric."""
SIGNED = {1: 8, 2: 16, 3: 32, 4: 64}
"""Bits of the signed types of data, which are sent as unsigned numbers."""
REBIRTH = b"\x12\x1a\n\x14Node Control/Rebirth \x0bp\x01"
"""The payload of a command to a node: declare your metrics again."""


class UnknownAliasError(ValueError):
    """A number of a metric that no birth has declared."""


class Sparkplug:
    """What is known of nodes and devices; `decode` takes their messages in the order in which they come."""

    def __init__(self) -> None:
        self._names: dict[tuple[str, str], dict[int, str]] = {}
        """By node: the names of its metrics and of those of its devices, by alias."""
        self._last: dict[str, dict[str, Any]] = {}
        """By topic: the last value of each metric."""

    def decode(self, topic: str, payload: bytes) -> Samples | None:
        """The samples of a message; None if it has none. ValueError if it cannot be read."""
        kind, group, node, device = parts_of(topic)
        if kind not in (*BIRTHS, *DATA):
            return None
        if len(payload) > MESSAGE_BYTES:
            raise ValueError(f"a message of {len(payload)} bytes; at most {MESSAGE_BYTES} are read.")
        where = "/".join(filter(None, (PREFIX, group, node, device)))
        names = self._names.get((group, node), {})
        born = kind in BIRTHS
        metrics, when = _metrics(payload)
        if kind == "NBIRTH":
            names = {}
        names = names | {one[ALIAS]: one[NAME] for one in metrics if born and ALIAS in one and NAME in one}
        rows: dict[int, dict[str, Any]] = {}
        last = {} if born else dict(self._last.get(where, {}))
        for one in metrics:
            name = one.get(NAME) or names.get(one.get(ALIAS, -1))
            if name is None:
                raise UnknownAliasError(f"the alias {one.get(ALIAS)} was declared by no birth of {group}/{node}.")
            rows.setdefault(one.get(WHEN, when), {})[name] = value_of(one)
            if not one.get(HISTORICAL):
                last[name] = value_of(one)
        if len(last) > MESSAGE_FIELDS or (len(self._last) >= KNOWN_NODES and where not in self._last):
            raise ValueError(f"more than {MESSAGE_FIELDS} metrics, or {KNOWN_NODES} nodes and devices.")
        before = {} if born else self._last.get(where, {})
        if born:
            self._names[group, node] = names
        self._last[where] = last
        return _samples(where, rows, before) if rows else None


def parts_of(topic: str) -> tuple[str, str, str, str]:
    """(type of the message, group, node, device) of a topic; empty texts for others."""
    parts = topic.split("/")
    if len(parts) not in (4, 5) or parts[0] != PREFIX:
        return "", "", "", ""
    return parts[2], parts[1], parts[3], parts[4] if len(parts) == 5 else ""


def rebirth_topic(topic: str) -> str:
    """Where a node takes commands, from the topic of one of its messages."""
    _, group, node, _ = parts_of(topic)
    return f"{PREFIX}/{group}/NCMD/{node}"


def _samples(topic: str, rows: dict[int, dict[str, Any]], before: dict[str, Any]) -> Samples:
    """A sample for each time, with the values of before where it has none."""
    known, filled = dict(before), []
    for time in sorted(rows):
        known |= rows[time]
        filled.append(known | {"timestamp": time})
    bounded(len(filled))
    return of_rows(topic, filled)


def value_of(metric: dict[int, Any]) -> Any:
    """The value of a metric as a number or text; None if it is null or of another type."""
    if metric.get(NULL):
        return None
    for field in (DOUBLE, FLOAT, INT, LONG):
        if field in metric:
            value, bits = metric[field], SIGNED.get(metric.get(TYPE, 0))
            return value - (1 << bits) if bits and field in (INT, LONG) and value >> (bits - 1) & 1 else value
    return bool(metric[BOOLEAN]) if BOOLEAN in metric else metric.get(STRING)


def _metrics(payload: bytes) -> tuple[list[dict[int, Any]], int]:
    """(the metrics by field, the time of the message)."""
    found, when = [], 0
    for field, value in _fields(payload):
        if field == METRICS and isinstance(value, bytes):
            found.append(_metric(value))
        elif field == TIMESTAMP and isinstance(value, int):
            when = value
    return found, when


def _metric(data: bytes) -> dict[int, Any]:
    metric: dict[int, Any] = {}
    for field, value in _fields(data):
        if field in (NAME, STRING):
            if not isinstance(value, bytes):
                raise ValueError("a name or text of Sparkplug that is sent as a number.")
            metric[field] = value.decode("utf-8")
        elif field in (FLOAT, DOUBLE):
            if not isinstance(value, bytes) or len(value) != (4 if field == FLOAT else 8):
                raise ValueError("a number of Sparkplug with the wrong number of bytes.")
            (metric[field],) = unpack_from("<f" if field == FLOAT else "<d", value)
        elif isinstance(value, int):  # the others are data sets, templates, properties
            metric[field] = value
    return metric


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """(number, value) of the fields of a protobuf message: whole numbers, and bytes for all else."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        field, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(data, at)
            yield field, value
            continue
        if wire == 2:
            size, at = _varint(data, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise ValueError(f"not protobuf: a field of wire type {wire}.")
        if at + size > len(data):
            raise ValueError("a message of Sparkplug that is cut off.")
        yield field, data[at : at + size]
        at += size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """(a whole number, where the next field begins)."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise ValueError("a message of Sparkplug that is cut off.")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, at
    raise ValueError("not protobuf: a number of more than ten bytes.")

"""MQTT, by paho-mqtt. The source has a persistent session, acknowledged by hand after the samples are in the journal.

With ``qos = 1`` (the default) and ``time`` in the units, nothing is lost while the service or the broker is away, and
samples that the broker sends again are recognised by their time. A retained message is a sample like any other.

While the service is held back, the queue of messages is full: the thread of the client waits, and messages stay at the
broker. The sink publishes

    topic            {"unit": ..., "number": ..., "time": ..., "y": ..., "y_hat": ..., "e": ..., "s": ..., "ok": ...,
                      "alarm": ..., "theta": {"a1": ...}, "std": {"a1": ...}}
    topic/event      events
    status           "online" or "offline", retained, with a last will

Sparkplug B (Eclipse, version 3.0) as the payload of MQTT: its protobuf messages.

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

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, ClassVar, Literal
from urllib.parse import urlsplit

import msgspec

from driftfit.service.connect.base import (
    ANSWER_SECONDS,
    MESSAGE_BYTES,
    MESSAGE_FIELDS,
    Batch,
    Connector,
    Outcome,
    QueueReader,
    Reader,
    Samples,
    Sink,
    Source,
    Writer,
    bounded,
    decode,
    of_rows,
)
from driftfit.service.options import Pattern, Secret

PREFIX = "spBv1.0"
BIRTHS, DATA = ("NBIRTH", "DBIRTH"), ("NDATA", "DDATA")
KNOWN_NODES = 100_000
"""Nodes and devices whose metrics are known."""
METRIC = (
    "string name 1, uint64 alias 2, uint64 timestamp 3, uint32 datatype 4, bool is_historical 5, bool is_null 7, "
    "uint32 int_value 10, uint64 long_value 11, float float_value 12, double double_value 13, bool boolean_value 14, "
    "string string_value 15"
)
"""Fields of a metric, with one value at most. Those that are left out are data sets, templates and properties."""
REBIRTH = b"\x12\x1a\n\x14Node Control/Rebirth \x0bp\x01"
"""The payload of a command to a node: declare your metrics again."""


class UnknownAliasError(ValueError):
    """A number of a metric that no birth has declared."""


@cache
def _message() -> Any:
    """The class of payloads of Sparkplug."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="sparkplug_b")
    payload, metric = (file.message_type.add(name=name) for name in ("Payload", "Metric"))
    kind = descriptor_pb2.FieldDescriptorProto
    payload.field.add(name="timestamp", number=1, type=kind.TYPE_UINT64, label=kind.LABEL_OPTIONAL)
    many = {"type": kind.TYPE_MESSAGE, "label": kind.LABEL_REPEATED, "type_name": ".Metric"}
    payload.field.add(name="metrics", number=2, **many)
    metric.oneof_decl.add(name="value")
    for one in METRIC.split(", "):
        of, name, number = one.split()
        own = {"oneof_index": 0} if name.endswith("_value") else {}
        own |= {"number": int(number), "type": kind.Type.Value(f"TYPE_{of.upper()}"), "label": kind.LABEL_OPTIONAL}
        metric.field.add(name=name, **own)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("Payload"))


class Sparkplug:
    """What is known of nodes and devices; `decode` takes their messages in the order in which they come."""

    def __init__(self) -> None:
        self._names: dict[tuple[str, str], dict[int, str]] = {}
        """By node: the names of its metrics and of those of its devices, by alias."""
        self._last: dict[str, dict[str, Any]] = {}
        """By topic: the last value of each metric."""

    def decode(self, topic: str, payload: bytes) -> Samples | None:
        """The samples of a message; None if it has none. ValueError if it cannot be read."""
        from google.protobuf.message import DecodeError

        kind, group, node, device = parts_of(topic)
        if kind not in (*BIRTHS, *DATA):
            return None
        if len(payload) > MESSAGE_BYTES:
            raise ValueError(f"a message of {len(payload)} bytes; at most {MESSAGE_BYTES} are read.")
        where = "/".join(filter(None, (PREFIX, group, node, device)))
        names = self._names.get((group, node), {})
        born = kind in BIRTHS
        try:
            read = _message().FromString(payload)
        except DecodeError as error:
            raise ValueError(f"not a message of Sparkplug: {error}") from None
        if kind == "NBIRTH":
            names = {}
        names = names | {
            one.alias: one.name for one in read.metrics if born and one.HasField("alias") and one.HasField("name")
        }
        rows: dict[int, dict[str, Any]] = {}
        last = {} if born else dict(self._last.get(where, {}))
        for one in read.metrics:
            name = one.name or names.get(one.alias if one.HasField("alias") else -1)
            if name is None:
                raise UnknownAliasError(f"the alias {one.alias} was declared by no birth of {group}/{node}.")
            rows.setdefault(one.timestamp if one.HasField("timestamp") else read.timestamp, {})[name] = value_of(one)
            if not one.is_historical:
                last[name] = value_of(one)
        if len(last) > MESSAGE_FIELDS or (len(self._last) >= KNOWN_NODES and where not in self._last):
            raise ValueError(f"more than {MESSAGE_FIELDS} metrics, or {KNOWN_NODES} nodes and devices.")
        known = {} if born else dict(self._last.get(where, {}))
        if born:
            self._names[group, node] = names
        self._last[where] = last
        filled = []  # a sample for each time, with the values of before where it has none
        for when in sorted(rows):
            known |= rows[when]
            filled.append(known | {"timestamp": when})
        return of_rows(where, filled[: bounded(len(filled))]) if rows else None


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


def value_of(metric: Any) -> Any:
    """The value of a metric as a number or text; None if it is null or of another type."""
    kind = metric.WhichOneof("value")
    if metric.is_null or kind is None:
        return None
    value, signed = getattr(metric, kind), metric.datatype in (1, 2, 3, 4)  # of 8 to 64 bits, sent as unsigned numbers
    half = 1 << (4 << metric.datatype) - 1 if signed else 0
    return (value + half) % (2 * half) - half if half and kind in ("int_value", "long_value") else value


CLOSE_SECONDS = 1.0
"""For this time a reader that is closed waits for acknowledgements."""
REBIRTH_SECONDS = 30.0
"""Time between two commands to a node to declare its metrics again."""


@dataclass(frozen=True, kw_only=True)
class _Broker(Connector):
    """A broker, and how to log in there."""

    needs: ClassVar = ("paho.mqtt.client", "paho-mqtt", "serve")
    url: str
    """mqtt://host:port or mqtts://host:port"""
    qos: int = 1
    user: str = ""
    password: Secret | None = None
    client: str = ""
    """Name of the session at the broker; empty: driftfit- and the name of the source, or of the sink and -sink."""
    authority: str = ""
    """File of the certificate authority, if it is not one of the system's."""

    def check(self) -> None:
        super().check()
        _ = self.address

    @property
    def address(self) -> tuple[str, int]:
        """(host, port); ValueError for another address."""
        parts = urlsplit(self.url)
        if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or parts.password:
            raise ValueError(
                f"url must be mqtt://host:port or mqtts://host:port, without a password; got {self.url!r}."
            )
        return parts.hostname, parts.port or (8883 if parts.scheme == "mqtts" else 1883)

    def session(self, name: str, **more: Any) -> Any:
        """A client of the broker, with name, password and TLS."""
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        client = Client(CallbackAPIVersion.VERSION2, self.client or name, **more)
        if self.user:
            client.username_pw_set(self.user, self.password.value if self.password else None)
        if self.url.startswith("mqtts"):
            client.tls_set(ca_certs=self.authority or None)
        return client

    def begin(self, client: Any) -> None:
        """Connect, and start the client's thread."""
        client.connect(*self.address, keepalive=30)
        client.loop_start()


@dataclass(frozen=True, kw_only=True)
class MqttSource(_Broker, Source):
    """Topics of a broker."""

    topic: str
    """Filter with the wildcards + and #; several are separated by spaces."""
    payload: Literal["json", "sparkplug"] = "json"
    """Of Sparkplug B: `driftfit.service.connect.mqtt`."""

    def check(self) -> None:
        super().check()
        if self.qos not in (0, 1):
            raise ValueError(f"mqtt: qos must be 0 or 1; got {self.qos}.")

    def open(self, position: Any) -> Reader:
        return _Reader(self)


class _Reader(QueueReader):
    def __init__(self, options: MqttSource) -> None:
        super().__init__()
        self.options = options
        self.sparkplug = Sparkplug() if options.payload == "sparkplug" else None
        self.asked: dict[str, float] = {}
        """When nodes were last asked to declare their metrics again."""
        self.unconfirmed = 0
        """Messages passed on that are not yet acknowledged to the broker."""
        more = {"clean_session": False, "manual_ack": True, "reconnect_on_failure": False}
        self.client = options.session(f"driftfit-{options.name}", **more)
        self.client.on_message = lambda client, user, message: self.arrived.put(message)
        self.client.on_connect = self._subscribe
        self.client.on_disconnect = self._lost
        options.begin(self.client)

    def _subscribe(self, client: Any, user: Any, flags: Any, reason: Any, properties: Any) -> None:
        if not reason.is_failure:
            client.subscribe([(topic, self.options.qos) for topic in self.options.topic.split()])

    def _lost(self, client: Any, user: Any, flags: Any, reason: Any, properties: Any) -> None:
        self.error = ConnectionError(f"{self.options.url}: {reason}")

    def batch(self, found: list[Any]) -> Batch:
        """Decode messages; what cannot be read is acknowledged like any other: sent again it would not be better."""
        samples, refused = [], 0
        for message in found:
            try:
                read = self._decode(message.topic, message.payload)
            except ValueError:
                refused += 1
            else:
                samples += [] if read is None else [read]
        identifiers = [one.mid for one in found if one.qos]
        self.unconfirmed += len(identifiers)
        return Batch(samples, partial(self._confirm, identifiers), refused=refused, arrived=time.monotonic())

    def _decode(self, topic: str, payload: bytes) -> Samples | None:
        """The samples of a message; None if it has none."""
        if self.sparkplug is None:
            return decode(topic, payload)
        try:
            return self.sparkplug.decode(topic, payload)
        except UnknownAliasError:  # the birth was before this process
            command, now = rebirth_topic(topic), time.monotonic()
            if now - self.asked.get(command, -REBIRTH_SECONDS) >= REBIRTH_SECONDS:
                self.asked[command] = now
                self.client.publish(command, REBIRTH)
            raise

    def _confirm(self, identifiers: list[int]) -> None:
        """Acknowledge messages that are in the journal, from its thread."""
        for one in identifiers:
            self.client.ack(one, 1)
        self.unconfirmed -= len(identifiers)

    def close(self) -> None:
        """Disconnect, once what was passed on is acknowledged; the session stays at the broker."""
        self.client.on_message = None
        self.drain()  # the client's thread may wait for room
        until = time.monotonic() + CLOSE_SECONDS
        while self.unconfirmed and self.client.is_connected() and time.monotonic() < until:
            time.sleep(0.01)
        end(self.client)


@dataclass(frozen=True, kw_only=True)
class MqttSink(_Broker, Sink):
    """Topics of a broker."""

    topic: str = "driftfit/{unit}"
    """With {unit}, and the names in braces of the unit's pattern."""
    status: str = "driftfit/status"
    every_result: bool = True
    """Whether every result is sent, or only the last result of each unit in a batch."""

    def check(self) -> None:
        super().check()
        Pattern(self.topic)

    def open(self) -> Writer:
        return _Writer(self)


class _Writer(Writer):
    def __init__(self, options: MqttSink) -> None:
        self.options = options
        self.client = options.session(f"driftfit-{options.name}-sink")
        self.client.max_inflight_messages_set(1000)
        self.client.will_set(options.status, "offline", qos=1, retain=True)
        self.client.on_connect = lambda client, *_: client.publish(options.status, "online", qos=1, retain=True)
        options.begin(self.client)

    def write(self, batch: Outcome) -> None:
        until = time.monotonic() + ANSWER_SECONDS
        options, sent = self.options, []
        for unit, is_event, body in messages(batch, options.every_result):
            topic = topic_of(options.topic, batch, unit) + "/event" * is_event
            sent.append(self.client.publish(topic, body, qos=options.qos))
        for one in sent:
            one.wait_for_publish(max(0.0, until - time.monotonic()))
            if not one.is_published():
                raise ConnectionError(f"{options.url} does not acknowledge")

    def close(self) -> None:
        self.client.publish(self.options.status, "offline", qos=1, retain=True)
        end(self.client)


def messages(batch: Outcome, every_result: bool) -> Iterator[tuple[str, bool, bytes]]:
    """(unit, whether it is an event, payload in JSON, with null for what is not finite) of a batch."""
    for one in batch.results if every_result else batch.last:
        names = batch.about[one.unit]["names"]
        named = {what: dict(zip(names, getattr(one, what), strict=False)) for what in ("theta", "std")}
        yield one.unit, False, msgspec.json.encode(one._asdict() | named)
    for event in batch.events:
        yield event.unit, True, msgspec.json.encode(event._asdict())


def topic_of(template: str, batch: Outcome, unit: str) -> str:
    """The topic of a unit; wildcards in names are replaced."""
    about = batch.about.get(unit, {})
    parts = {name: "?" for name in Pattern(template).fields} | dict(about.get("parts") or {}) | {"unit": unit}
    return template.format_map(parts).replace("+", "_").replace("#", "_")


def end(client: Any) -> None:
    client.disconnect()
    client.loop_stop()

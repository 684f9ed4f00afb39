"""MQTT, by paho-mqtt: a persistent session, acknowledged by hand after the samples are in the journal.

With ``qos = 1`` (the default) and ``time`` in the units, nothing is lost while the service or the broker is away, and
samples that the broker sends again are recognised by their time. A retained message is a sample like any other.

While the service is held back, the queue of messages is full: the thread of the client waits, and messages stay at the
broker.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal
from urllib.parse import urlsplit

from driftfit.service.connector import client_library
from driftfit.service.options import Secret
from driftfit.service.sources.contract import Batch, QueueReader, Reader, Samples, Source, decode
from driftfit.service.sources.sparkplug import REBIRTH, Sparkplug, UnknownAliasError, rebirth_topic

CLOSE_SECONDS = 1.0
"""For this time a reader that is closed waits for acknowledgements."""
REBIRTH_SECONDS = 30.0
"""Time between two commands to a node to declare its metrics again."""
paho = partial(client_library, "mqtt", "paho.mqtt.client", "paho-mqtt", "serve")


@dataclass(frozen=True, kw_only=True)
class Broker:
    """A broker, and how to log in there."""

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
        connected(self.url)


@dataclass(frozen=True, kw_only=True)
class Mqtt(Broker, Source):
    """Topics of a broker."""

    topic: str
    """Filter with the wildcards + and #; several are separated by spaces."""
    payload: Literal["json", "sparkplug"] = "json"
    """Of Sparkplug B: `driftfit.service.sources.sparkplug`."""

    def check(self) -> None:
        super().check()
        if self.qos not in (0, 1):
            raise ValueError(f"mqtt: qos must be 0 or 1; got {self.qos}.")

    def open(self, position: Any) -> Reader:
        return _Mqtt(self)


class _Mqtt(QueueReader):
    def __init__(self, options: Mqtt) -> None:
        super().__init__()
        self.options = options
        self.sparkplug = Sparkplug() if options.payload == "sparkplug" else None
        self.asked: dict[str, float] = {}
        """When nodes were last asked to declare their metrics again."""
        self.unconfirmed = 0
        """Messages passed on that are not yet acknowledged to the broker."""
        more = {"clean_session": False, "manual_ack": True, "reconnect_on_failure": False}
        self.client = client_of(options, options.client or f"driftfit-{options.name}", **more)
        self.client.on_message = lambda client, user, message: self.arrived.put(message)
        self.client.on_connect = self._subscribe
        self.client.on_disconnect = self._lost
        begin(self.client, options.url)

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


def client_of(options: Any, name: str, **more: Any) -> Any:
    """A client of a broker, with name, password and TLS."""
    from paho.mqtt.enums import CallbackAPIVersion

    client = paho().Client(CallbackAPIVersion.VERSION2, name, **more)
    if options.user:
        client.username_pw_set(options.user, options.password.value if options.password else None)
    if options.url.startswith("mqtts"):
        client.tls_set(ca_certs=options.authority or None)
    return client


def begin(client: Any, url: str) -> None:
    """Connect, and start the client's thread."""
    client.connect(*connected(url), keepalive=30)
    client.loop_start()


def end(client: Any) -> None:
    client.disconnect()
    client.loop_stop()


def connected(url: str) -> tuple[str, int]:
    """(host, port) of mqtt://host:port; ValueError for another address."""
    parts = urlsplit(url)
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or parts.password:
        raise ValueError(f"url must be mqtt://host:port or mqtts://host:port, without a password; got {url!r}.")
    paho()
    return parts.hostname, parts.port or (8883 if parts.scheme == "mqtts" else 1883)

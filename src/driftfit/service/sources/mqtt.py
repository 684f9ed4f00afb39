"""MQTT, by paho-mqtt: a persistent session, acknowledged by hand after the samples are in the journal.

With ``qos = 1`` (the default) and ``time`` in the units, nothing is lost while the service or the broker is away, and
samples that the broker sends again are recognised by their time. A retained message is a sample like any other.
"""

from __future__ import annotations

import queue
import time
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from driftfit.service.settings.options import Secret
from driftfit.service.sources.contract import Reader, Source
from driftfit.service.sources.samples import LARGEST, Batch, Samples, decode
from driftfit.service.sources.sparkplug import REBIRTH, Sparkplug, UnknownAliasError, rebirth_topic

MOST = 2_000
"""Messages of one batch."""
AWAY = 20.0
"""Seconds without a connection after which the source is reported to be away."""

PATIENCE = 30.0
"""Seconds between two commands to a node to declare its metrics again."""


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
        """The address and the client library."""
        connected(self.url)


@dataclass(frozen=True, kw_only=True)
class Mqtt(Broker, Source):
    """Topics of a broker."""

    topic: str
    """Filter with the wildcards + and #; several are separated by spaces."""
    payload: str = "json"
    """json, or sparkplug for the messages of Sparkplug B (`driftfit.service.sources.sparkplug`)."""

    def check(self) -> None:
        """The address, the client library, the payload, and a level of acknowledgement that is read."""
        super().check()
        if self.qos not in (0, 1):
            raise ValueError(f"mqtt: qos must be 0 or 1; got {self.qos}.")
        if self.payload not in ("json", "sparkplug"):
            raise ValueError(f"mqtt: payload must be json or sparkplug; got {self.payload!r}.")

    def open(self, position: Any) -> Reader:
        """Connect; the broker keeps the position."""
        return _Mqtt(self)


class _Mqtt(Reader):
    def __init__(self, options: Mqtt) -> None:
        from paho.mqtt.enums import CallbackAPIVersion

        mqtt = paho()
        self.options = options
        self.sparkplug = Sparkplug() if options.payload == "sparkplug" else None
        self.asked: dict[str, float] = {}
        """When nodes were last asked to declare their metrics again."""
        self.messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
        name = options.client or f"driftfit-{options.name}"
        self.client = mqtt.Client(CallbackAPIVersion.VERSION2, name, clean_session=False, manual_ack=True)
        self.client.on_message = lambda client, user, message: self.messages.put(message)
        self.client.on_connect = self._subscribe
        secure(self.client, options)
        self.lost = time.monotonic()
        host, port = connected(options.url)
        self.client.connect(host, port, keepalive=30)
        self.client.loop_start()

    def _subscribe(self, client: Any, user: Any, flags: Any, reason: Any, properties: Any) -> None:
        if not reason.is_failure:
            client.subscribe([(topic, self.options.qos) for topic in self.options.topic.split()])

    def read(self, wait: float) -> Batch | None:
        """The messages that have arrived."""
        if self.client.is_connected():
            self.lost = time.monotonic()
        elif time.monotonic() - self.lost > AWAY:
            raise ConnectionError(f"no connection to {self.options.url}")
        try:
            found = [self.messages.get(timeout=wait)]
        except queue.Empty:
            return None
        arrived = time.monotonic()
        while len(found) < MOST and not self.messages.empty():
            found.append(self.messages.get())
        samples: list[Samples] = []
        refused = 0
        for message in found:
            try:
                if len(message.payload) > LARGEST:
                    raise ValueError
                read = self._decode(message.topic, message.payload)
                samples += [] if read is None else [read]
            except ValueError:  # it is counted, and acknowledged like any other: sent again it would not be better
                refused += 1
        return Batch(samples, lambda: self._acknowledge(found), refused=refused, arrived=arrived)

    def _decode(self, topic: str, payload: bytes) -> Samples | None:
        """The samples of a message; None if it has none."""
        if self.sparkplug is None:
            return decode(topic, payload)
        try:
            return self.sparkplug.decode(topic, payload)
        except UnknownAliasError:  # the birth was before this process
            command, now = rebirth_topic(topic), time.monotonic()
            if now - self.asked.get(command, -PATIENCE) >= PATIENCE:
                self.asked[command] = now
                self.client.publish(command, REBIRTH)
            raise

    def _acknowledge(self, messages: list[Any]) -> None:
        for message in messages:
            if message.qos:
                self.client.ack(message.mid, message.qos)

    def close(self) -> None:
        """Disconnect; the session stays at the broker."""
        self.client.disconnect()
        self.client.loop_stop()


def paho() -> Any:
    """The client library; ImportError says how to install it."""
    try:
        from paho.mqtt import client
    except ImportError:
        raise ImportError("mqtt needs paho-mqtt: pip install 'driftfit[serve]'.") from None
    return client


def connected(url: str) -> tuple[str, int]:
    """(host, port) of mqtt://host:port; ValueError for another address."""
    parts = urlsplit(url)
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or parts.password:
        raise ValueError(f"url must be mqtt://host:port or mqtts://host:port, without a password; got {url!r}.")
    paho()
    return parts.hostname, parts.port or (8883 if parts.scheme == "mqtts" else 1883)


def secure(client: Any, options: Any) -> None:
    """Name, password and TLS of a client."""
    if options.user:
        client.username_pw_set(options.user, options.password.value if options.password else None)
    if options.url.startswith("mqtts"):
        client.tls_set(ca_certs=options.authority or None)

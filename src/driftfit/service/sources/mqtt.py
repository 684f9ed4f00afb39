"""MQTT, by paho-mqtt: a persistent session, acknowledged by hand after the samples are in the journal.

With ``qos = 1`` (the default) and ``time`` in the units, nothing is lost while the service or the broker is away, and
samples that the broker sends again are recognised by their time. A retained message is a sample like any other.

The thread of the source does the client's network work too (paho's methods for an event loop of one's own): a message
passes through one thread less, and while the service is held back, messages wait at the broker and not in memory.
"""

from __future__ import annotations

import contextlib
import select
import socket
import ssl
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal
from urllib.parse import urlsplit

from driftfit.service.connector import ANSWER_SECONDS, client_library
from driftfit.service.options import Secret
from driftfit.service.sources.contract import BATCH_MESSAGES, MESSAGE_BYTES, Batch, Reader, Samples, Source, decode
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


class _Mqtt(Reader):
    def __init__(self, options: Mqtt) -> None:
        from paho.mqtt.enums import CallbackAPIVersion

        mqtt = paho()
        self.options = options
        self.sparkplug = Sparkplug() if options.payload == "sparkplug" else None
        self.asked: dict[str, float] = {}
        """When nodes were last asked to declare their metrics again."""
        self.batch = Heard()
        self.unconfirmed = 0
        """Messages passed on that are not yet acknowledged to the broker."""
        self.confirmed: deque[list[int]] = deque()
        """Those that are in the journal, from the thread of the journal."""
        self.woken, self.waker = socket.socketpair()
        self.woken.setblocking(False)
        self.waker.setblocking(False)
        self.more = False
        """Whether the last read left messages behind."""
        self.begun = time.monotonic()
        name = options.client or f"driftfit-{options.name}"
        self.client = mqtt.Client(CallbackAPIVersion.VERSION2, name, clean_session=False, manual_ack=True)
        self.client.on_message = self._hear
        self.client.on_connect = self._subscribe
        self.client.on_socket_register_write = lambda *_: None  # packets are sent by `_send`, not one by one
        self.line = Line(self.client)
        secure(self.client, options)
        host, port = connected(options.url)
        self.client.connect(host, port, keepalive=30)

    def _subscribe(self, client: Any, user: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            raise ConnectionError(f"{self.options.url} refuses: {reason}")
        client.subscribe([(topic, self.options.qos) for topic in self.options.topic.split()])

    def _hear(self, client: Any, user: Any, message: Any) -> None:
        """Decode a message; what cannot be read is counted."""
        heard = self.batch
        heard.count += 1
        if message.qos:
            heard.identifiers.append(message.mid)
        try:
            if len(message.payload) > MESSAGE_BYTES:
                raise ValueError
            read = self._decode(message.topic, message.payload)
        except ValueError:  # it is acknowledged like any other: sent again it would not be better
            heard.refused += 1
        else:
            heard.samples += [] if read is None else [read]

    def read(self, wait: float) -> Batch | None:
        until = time.monotonic() + wait
        while not self.batch.count:
            self._send()
            left = until - time.monotonic()
            if left <= 0.0:
                return None
            self._wait(left)
            self._receive()
        heard, self.batch = self.batch, Heard()
        self.unconfirmed += len(heard.identifiers)
        confirm = partial(self._confirm, heard.identifiers)
        return Batch(heard.samples, confirm, refused=heard.refused, arrived=time.monotonic())

    def _send(self) -> None:
        """Acknowledge what is in the journal, and send what waits."""
        while self.confirmed:
            identifiers = self.confirmed.popleft()
            self.unconfirmed -= len(identifiers)
            for one in identifiers:
                self.client.ack(one, 1)
        self._checked(self.client.loop_misc())
        if self.client.want_write():
            self._checked(self.client.loop_write())
        self.line.flush()

    def _wait(self, seconds: float) -> None:
        """Until messages arrive, or acknowledgements are to be sent."""
        socket = self.client.socket()
        if socket is None or (not self.client.is_connected() and time.monotonic() - self.begun > ANSWER_SECONDS):
            raise ConnectionError(f"no connection to {self.options.url}")
        if self.more or (isinstance(socket, ssl.SSLSocket) and socket.pending()):
            return
        writing = [socket] if self.line.to_send or self.client.want_write() else []
        ready, *_ = select.select([socket, self.woken], writing, [], seconds)
        if self.woken in ready:
            self.woken.recv(4096)

    def _receive(self) -> None:
        self.more = True
        while self.more and self.batch.count < BATCH_MESSAGES:  # a call reads one packet
            before = self.batch.count
            self._checked(self.client.loop_read())
            self.more = self.batch.count > before or self.line.holds

    def _checked(self, code: int) -> None:
        if code:
            raise ConnectionError(f"{self.options.url}: {paho().error_string(code)}")

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
        """Let the thread of the source acknowledge messages."""
        self.confirmed.append(identifiers)
        with contextlib.suppress(OSError):  # it is awake already, or closed: the broker sends them again
            self.waker.send(b"1")

    def close(self) -> None:
        """Disconnect, once what was passed on is acknowledged; the session stays at the broker."""
        until = time.monotonic() + CLOSE_SECONDS
        with contextlib.suppress(OSError):
            while self.unconfirmed and (left := until - time.monotonic()) > 0.0:
                select.select([self.woken], [], [], left)
                self._send()
            self.line.release()
            self.client.disconnect()
            self._checked(self.client.loop_write())
        self.woken.close()
        self.waker.close()


class Heard:
    """The messages of the next batch."""

    def __init__(self) -> None:
        self.samples: list[Samples] = []
        self.identifiers: list[int] = []
        """Of those that are to be acknowledged."""
        self.count = self.refused = 0


class Line:
    """The socket of a client, read in large pieces, and written once for many packets.

    paho-mqtt takes three calls of the system to read a message and one to acknowledge it, which is more than half of
    its cost. It has no public way to change that: should its methods be named otherwise one day, it is only slower.
    """

    def __init__(self, client: Any) -> None:
        self.to_send = bytearray()
        self._client, self._read, self._at = client, b"", 0
        self.theirs = {name: getattr(client, name) for name in ("_sock_recv", "_sock_send") if hasattr(client, name)}
        if len(self.theirs) == 2:
            client._sock_recv, client._sock_send = self.receive, self.send

    @property
    def holds(self) -> bool:
        """Whether something was read that the client has not yet taken."""
        return self._at < len(self._read)

    def receive(self, most: int) -> bytes:
        """At most so many bytes; BlockingIOError if there are none, none at the end."""
        if not self.holds:
            self._read, self._at = self.theirs["_sock_recv"](max(most, 1 << 16)), 0
        self._at += most
        return self._read[self._at - most : self._at]

    def send(self, data: bytes) -> int:
        """Add to what `flush` sends."""
        self.to_send += data
        return len(data)

    def flush(self) -> None:
        """Send as much as the system takes."""
        with contextlib.suppress(BlockingIOError):
            while self.to_send:
                del self.to_send[: self.theirs["_sock_send"](self.to_send)]

    def release(self) -> None:
        """Send the rest, and give the socket back to the client."""
        self.flush()
        vars(self._client).update(self.theirs)


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

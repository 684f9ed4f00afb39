"""MQTT, by paho-mqtt: a JSON object for every result, on a topic per unit; a retained status with a last will.

    topic            {"unit": ..., "number": ..., "time": ..., "y": ..., "y_hat": ..., "e": ..., "s": ..., "ok": ...,
                      "alarm": ..., "theta": {"a1": ...}, "std": {"a1": ...}}
    topic/event      events
    status           "online" or "offline"

After a crash the last results come again, with the same ``number``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec

from driftfit.service.settings.matching import Pattern
from driftfit.service.sinks.contract import Outcome, Sink, Writer
from driftfit.service.sinks.sqlite import by_name
from driftfit.service.sources.mqtt import Broker, connected, paho, secure

TIMEOUT = 20.0
"""Seconds in which the broker must have acknowledged a batch."""


@dataclass(frozen=True, kw_only=True)
class Mqtt(Broker, Sink):
    """Topics of a broker."""

    topic: str = "driftfit/{unit}"
    """With {unit}, and the names in braces of the unit's pattern."""
    status: str = "driftfit/status"
    every_result: bool = True
    """Whether every result is sent, or only the last result of each unit in a batch."""

    def check(self) -> None:
        """The address, the topic and the client library."""
        super().check()
        Pattern(self.topic)

    def open(self) -> Writer:
        """Connect."""
        return _Mqtt(self)


class _Mqtt(Writer):
    def __init__(self, options: Mqtt) -> None:
        from paho.mqtt.enums import CallbackAPIVersion

        self.options = options
        name = options.client or f"driftfit-{options.name}-sink"
        self.client = paho().Client(CallbackAPIVersion.VERSION2, name)
        self.client.max_inflight_messages_set(1000)
        self.client.will_set(options.status, "offline", qos=1, retain=True)
        self.client.on_connect = lambda client, *_: client.publish(options.status, "online", qos=1, retain=True)
        secure(self.client, options)
        host, port = connected(options.url)
        self.client.connect(host, port, keepalive=30)
        self.client.loop_start()

    def write(self, batch: Outcome) -> None:
        """Send, and wait for the broker's acknowledgements."""
        until = time.monotonic() + TIMEOUT
        sent = [self.client.publish(topic, body, qos=self.options.qos) for topic, body in messages(self.options, batch)]
        for one in sent:
            one.wait_for_publish(max(0.0, until - time.monotonic()))
            if not one.is_published():
                raise ConnectionError(f"{self.options.url} does not acknowledge")

    def close(self) -> None:
        """Publish the status and disconnect."""
        self.client.publish(self.options.status, "offline", qos=1, retain=True)
        self.client.disconnect()
        self.client.loop_stop()


def messages(options: Any, batch: Outcome) -> Iterator[tuple[str, bytes]]:
    """(topic, payload) of a batch."""
    for one in batch.results if options.every_result else batch.last:
        plain = {key: _finite(value) for key, value in one._asdict().items()}
        plain |= {"theta": by_name(batch, one.unit, one.theta), "std": by_name(batch, one.unit, one.std)}
        yield topic_of(options.topic, batch, one.unit), msgspec.json.encode(plain)
    for event in batch.events:
        yield f"{topic_of(options.topic, batch, event.unit)}/event", msgspec.json.encode(event._asdict())


def topic_of(template: str, batch: Outcome, unit: str) -> str:
    """The topic of a unit; wildcards in names are replaced."""
    about = batch.about.get(unit, {})
    parts = {name: "?" for name in Pattern(template).fields} | dict(about.get("parts") or {}) | {"unit": unit}
    return template.format_map(parts).replace("+", "_").replace("#", "_")


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value

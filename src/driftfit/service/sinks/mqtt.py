"""MQTT, by paho-mqtt: a JSON object for every result, on a topic per unit; a retained status with a last will.

    topic            {"unit": ..., "number": ..., "time": ..., "y": ..., "y_hat": ..., "e": ..., "s": ..., "ok": ...,
                      "alarm": ..., "theta": {"a1": ...}, "std": {"a1": ...}}
    topic/event      events
    status           "online" or "offline"

After a crash the last results come again, with the same ``number``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec

from driftfit.service.connector import ANSWER_SECONDS
from driftfit.service.options import Pattern
from driftfit.service.sinks.contract import Outcome, Sink, Writer
from driftfit.service.sources.mqtt import Broker, begin, client_of, end


@dataclass(frozen=True, kw_only=True)
class Mqtt(Broker, Sink):
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
        return _Mqtt(self)


class _Mqtt(Writer):
    def __init__(self, options: Mqtt) -> None:
        self.options = options
        self.client = client_of(options, options.client or f"driftfit-{options.name}-sink")
        self.client.max_inflight_messages_set(1000)
        self.client.will_set(options.status, "offline", qos=1, retain=True)
        self.client.on_connect = lambda client, *_: client.publish(options.status, "online", qos=1, retain=True)
        begin(self.client, options.url)

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

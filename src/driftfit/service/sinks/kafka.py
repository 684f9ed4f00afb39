"""Kafka, by confluent-kafka: a JSON object for every result, keyed by its unit; the producer is idempotent.

After a crash of the service the last results come again, with the same ``number``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from driftfit.service.sinks.contract import Outcome, Sink, Writer
from driftfit.service.sinks.mqtt import messages
from driftfit.service.sources.kafka import library

FLUSH_SECONDS = 30.0


@dataclass(frozen=True)
class Kafka(Sink):
    """A topic of a cluster."""

    brokers: str
    topic: str = "driftfit"
    every_result: bool = True
    """Whether every result is sent, or only the last result of each unit in a batch."""
    settings: dict[str, str] = field(default_factory=dict)

    def check(self) -> None:
        library()

    def open(self) -> Writer:
        return _Kafka(self)


class _Kafka(Writer):
    def __init__(self, options: Kafka) -> None:
        self.options = options
        given = {"bootstrap.servers": options.brokers, "enable.idempotence": True, "linger.ms": 5} | options.settings
        self.producer = library().Producer(given)
        self.failed: list[str] = []

    def write(self, batch: Outcome) -> None:
        for unit, is_event, body in messages(batch, self.options.every_result):
            topic = self.options.topic + "-events" * is_event
            self.producer.produce(topic, body, unit.encode(), on_delivery=self._delivered)
            self.producer.poll(0)
        left = self.producer.flush(FLUSH_SECONDS)
        failed, self.failed = self.failed, []
        if left or failed:
            raise ConnectionError(failed[0] if failed else f"{left} messages are not acknowledged")

    def _delivered(self, error: Any, message: Any) -> None:
        if error is not None:
            self.failed.append(str(error))

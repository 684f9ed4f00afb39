"""Kafka, by confluent-kafka.

The source keeps its positions in the journal, so every message is taken exactly once; the topic of the samples is the
topic of Kafka, with the key of the message after a slash if it has one. The sink writes a JSON object for every result,
keyed by its unit; its producer is idempotent.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from driftfit.service.connect.base import (
    ANSWER_SECONDS,
    BATCH_MESSAGES,
    Batch,
    Connector,
    Outcome,
    Reader,
    Samples,
    Sink,
    Source,
    Writer,
    decode,
)
from driftfit.service.connect.mqtt import messages


@dataclass(frozen=True, kw_only=True)
class _Cluster(Connector):
    """A cluster."""

    needs: ClassVar = ("confluent_kafka", "confluent-kafka", "kafka")
    brokers: str
    settings: dict[str, str] = field(default_factory=dict)
    """Further settings of librdkafka, such as "security.protocol"."""


@dataclass(frozen=True, kw_only=True)
class KafkaSource(_Cluster, Source):
    """Topics of a cluster."""

    topics: list[str]
    begin: Literal["latest", "earliest"] = "latest"
    """Where to begin without a position."""

    def open(self, position: Any) -> Reader:
        return _Reader(self, dict(position or {}))


class _Reader(Reader):
    def __init__(self, options: KafkaSource, position: dict[str, int]) -> None:
        kafka = options.library()
        self.position = position
        given = {"bootstrap.servers": options.brokers, "group.id": f"driftfit-{options.name}",
                 "enable.auto.commit": False, "auto.offset.reset": options.begin} | options.settings  # fmt: skip
        self.consumer = kafka.Consumer(given)
        places = []
        for topic in options.topics:
            known = self.consumer.list_topics(topic, ANSWER_SECONDS).topics[topic]
            if known.error is not None:
                raise ConnectionError(str(known.error))
            for part in known.partitions:
                at = position.get(f"{topic}/{part}")
                ends = self.consumer.get_watermark_offsets(kafka.TopicPartition(topic, part), ANSWER_SECONDS)
                if at is None:
                    at = ends[options.begin == "latest"]
                elif not ends[0] <= at <= ends[1]:  # the library would go on at one of the ends, without a word
                    self.noticed = f"{topic}/{part} has no message {at}: it is read from its first, {ends[0]}."
                    at = ends[0]
                position[f"{topic}/{part}"] = at  # noted now: nothing is skipped if the service stops before a message
                places.append(kafka.TopicPartition(topic, part, at))
        self.consumer.assign(places)

    def read(self, wait: float) -> Batch | None:
        found = self.consumer.consume(BATCH_MESSAGES, wait)
        if not found:
            return None
        arrived = time.monotonic()
        samples: list[Samples] = []
        refused = 0
        for message in found:
            if message.error() is not None:
                raise ConnectionError(str(message.error()))
            self.position[f"{message.topic()}/{message.partition()}"] = message.offset() + 1
            key = message.key()
            topic = f"{message.topic()}/{key.decode('utf-8', 'replace')}" if key else message.topic()
            try:
                samples.append(decode(topic, message.value() or b""))
            except ValueError:
                refused += 1
        return Batch(samples, position=dict(self.position), refused=refused, arrived=arrived)

    def close(self) -> None:
        self.consumer.close()


@dataclass(frozen=True, kw_only=True)
class KafkaSink(_Cluster, Sink):
    """A topic of a cluster."""

    topic: str = "driftfit"
    every_result: bool = True
    """Whether every result is sent, or only the last result of each unit in a batch."""

    def open(self) -> Writer:
        return _Writer(self)


class _Writer(Writer):
    def __init__(self, options: KafkaSink) -> None:
        self.options = options
        given = {"bootstrap.servers": options.brokers, "enable.idempotence": True, "linger.ms": 5} | options.settings
        self.producer = options.library().Producer(given)

    def write(self, batch: Outcome) -> None:
        failed: list[Any] = []
        for unit, is_event, body in messages(batch, self.options.every_result):
            topic = self.options.topic + "-events" * is_event
            self.producer.produce(topic, body, unit.encode(), on_delivery=lambda error, _: failed.append(error))
            self.producer.poll(0)
        left = self.producer.flush(ANSWER_SECONDS)
        errors = [str(error) for error in failed if error is not None]
        if left or errors:
            raise ConnectionError(errors[0] if errors else f"{left} messages are not acknowledged")

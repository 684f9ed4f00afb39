"""Kafka, by confluent-kafka: positions are kept in the journal, so every message is taken exactly once.

The topic of the samples is the topic of Kafka, with the key of the message after a slash if it has one.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from driftfit.service.connector import ANSWER_SECONDS, client_library
from driftfit.service.sources.contract import BATCH_MESSAGES, Batch, Reader, Samples, Source, decode

library = partial(client_library, "kafka", "confluent_kafka", "confluent-kafka", "kafka")


@dataclass(frozen=True)
class Kafka(Source):
    """Topics of a cluster."""

    brokers: str
    topics: list[str]
    begin: Literal["latest", "earliest"] = "latest"
    """Where to begin without a position."""
    settings: dict[str, str] = field(default_factory=dict)
    """Further settings of librdkafka, such as "security.protocol"."""

    def check(self) -> None:
        library()

    def open(self, position: Any) -> Reader:
        return _Kafka(self, dict(position or {}))


class _Kafka(Reader):
    def __init__(self, options: Kafka, position: dict[str, int]) -> None:
        kafka = library()
        self.position, self.noticed = position, ""
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
        if self.noticed:
            noticed, self.noticed = self.noticed, ""
            return Batch([], noticed=noticed)
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

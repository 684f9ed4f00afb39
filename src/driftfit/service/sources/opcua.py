"""OPC UA, by asyncua (an optional package under the LGPL): values of variables by subscription.

Each entry of ``nodes`` is a unit's topic with its variables by field: the last known values of all of them become a
sample whenever one of them, or the one named ``trigger``, changes. The time is the source timestamp, in the field
``time``. A subscription begins with the present values and has no past, so samples during an absence are lost.
"""

from __future__ import annotations

import contextlib
import queue
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

from driftfit.service.connector import EventLoop, client_library
from driftfit.service.options import Secret
from driftfit.service.sources.contract import Batch, QueueReader, Reader, Source, by_topic

QUEUED_CHANGES = 100_000
"""Changes that wait to be read; those beyond are dropped, and counted as refused."""
library = partial(client_library, "opcua", "asyncua", "asyncua", "opcua")


@dataclass(frozen=True)
class Opcua(Source):
    """Variables of a server."""

    url: str
    """opc.tcp://host:port/path"""
    nodes: dict[str, dict[str, str]]
    """Node ids by field, by topic: { "plant/7" = { flow = "ns=2;s=flow", pressure = "ns=2;s=pressure" } }"""
    trigger: str = ""
    """Field whose change makes a sample; empty: any."""
    period: float = 0.1
    """Seconds between two publications of the server."""
    user: str = ""
    password: Secret | None = None

    def check(self) -> None:
        if not self.url.startswith("opc.tcp://"):
            raise ValueError(f"opcua: url must be opc.tcp://host:port; got {self.url!r}.")
        library()

    def open(self, position: Any) -> Reader:
        return _Opcua(self)


class _Opcua(QueueReader):
    def __init__(self, options: Opcua) -> None:
        super().__init__(QUEUED_CHANGES)
        self.options = options
        self.values: dict[str, dict[str, Any]] = {topic: {} for topic in options.nodes}
        self.dropped = 0
        self.places: dict[str, tuple[str, str]] = {}
        self.loop = EventLoop()
        try:
            self.loop.call(self._connect())
        except BaseException:
            self.close()
            raise

    async def _connect(self) -> None:
        self.client = library().Client(self.options.url, timeout=10)
        if self.options.user:
            self.client.set_user(self.options.user)
            self.client.set_password(self.options.password.value if self.options.password else "")
        await self.client.connect()
        subscription = await self.client.create_subscription(self.options.period * 1e3, self)
        for topic, fields in self.options.nodes.items():
            for field, node in fields.items():
                found = self.client.get_node(node)
                self.places[found.nodeid.to_string()] = (topic, field)
                await subscription.subscribe_data_change(found)

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """Called by the library when a variable has changed."""
        topic, field = self.places[node.nodeid.to_string()]
        values = self.values[topic]
        good = data.monitored_item.Value.StatusCode.is_good()
        values[field] = value if good else None
        stamp = data.monitored_item.Value.SourceTimestamp
        values["time"] = stamp.isoformat() if stamp is not None else None
        if len(values) <= len(self.options.nodes[topic]) or self.options.trigger not in ("", field):
            return
        try:
            self.arrived.put_nowait((topic, dict(values)))
        except queue.Full:
            self.dropped += 1

    def status_change_notification(self, status: Any) -> None:
        """Called by the library when the subscription ends."""
        self.error = ConnectionError(f"subscription: {status}")

    def read(self, wait: float) -> Batch | None:
        found = super().read(wait)
        if found is None:
            self.loop.call(self.client.check_connection())
        return found

    def batch(self, found: list[Any]) -> Batch:
        refused, self.dropped = self.dropped, 0
        return Batch(by_topic(found), refused=refused, arrived=time.monotonic())

    def close(self) -> None:
        try:
            with contextlib.suppress(Exception):  # the server may be gone
                self.loop.call(self.client.disconnect(), 5.0)
        finally:
            self.loop.end()

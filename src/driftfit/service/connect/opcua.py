"""OPC UA, by asyncua (an optional package under the LGPL).

The source takes values of variables by subscription. Each entry of ``nodes`` is a unit's topic with its variables by
field: the last known values of all of them become a sample whenever one of them, or the one named ``trigger``, changes.
The time is the source timestamp, in the field ``time``. A subscription begins with the present values and has no past,
so samples during an absence are lost. The sink is a server, with a folder per unit and a variable for each number that
the service follows: a client sees the last prediction, innovation, alarm, and each parameter with its standard
deviation.
"""

from __future__ import annotations

import contextlib
import queue
import time
from dataclasses import dataclass
from typing import Any, ClassVar

from driftfit.service.connect.base import (
    ANSWER_SECONDS,
    Batch,
    EventLoop,
    Outcome,
    QueueReader,
    Reader,
    Sink,
    Source,
    Writer,
    by_topic,
)
from driftfit.service.core.results import Result
from driftfit.service.options import Secret

QUEUED_CHANGES = 100_000
"""Changes that wait to be read; those beyond are dropped, and counted as refused."""
NEEDS = ("asyncua", "asyncua", "opcua")


@dataclass(frozen=True)
class OpcuaSource(Source):
    """Variables of a server."""

    needs: ClassVar = NEEDS
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
        super().check()

    def open(self, position: Any) -> Reader:
        return _Reader(self)


class _Reader(QueueReader):
    def __init__(self, options: OpcuaSource) -> None:
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
        self.client = self.options.library().Client(self.options.url, timeout=10)
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


@dataclass(frozen=True)
class OpcuaSink(Sink):
    """A server of the present values."""

    needs: ClassVar = NEEDS
    url: str = "opc.tcp://127.0.0.1:4840/driftfit"

    def check(self) -> None:
        if not self.url.startswith(("opc.tcp://127.0.0.1", "opc.tcp://localhost")):
            raise ValueError(
                f"opcua: url {self.url!r} can be reached from other machines, without a password; use 127.0.0.1 and "
                "a gateway."
            )
        super().check()

    def open(self) -> Writer:
        return _Writer(self)


class _Writer(Writer):
    def __init__(self, options: OpcuaSink) -> None:
        self.variables: dict[tuple[str, str], Any] = {}
        self.folders: dict[str, Any] = {}
        self.loop = EventLoop()
        try:
            self.loop.call(self._start(options), 2 * ANSWER_SECONDS)
        except BaseException:
            self.loop.end()
            raise

    async def _start(self, options: OpcuaSink) -> None:
        self.server = options.library().Server()
        await self.server.init()
        self.server.set_endpoint(options.url)
        self.space = await self.server.register_namespace("https://driftfit/units")
        await self.server.start()

    def write(self, batch: Outcome) -> None:
        self.loop.call(self._write(batch))

    async def _write(self, batch: Outcome) -> None:
        for one in batch.last:
            for name, value in _values(one, batch.about[one.unit]["names"]):
                variable = self.variables.get((one.unit, name))
                if variable is None:
                    if one.unit not in self.folders:
                        home = self.server.nodes.objects
                        self.folders[one.unit] = await home.add_folder(f"ns={self.space};s={one.unit}", one.unit)
                    variable = await self.folders[one.unit].add_variable(
                        f"ns={self.space};s={one.unit}.{name}", name, value
                    )
                    self.variables[one.unit, name] = variable
                else:
                    await variable.write_value(value)

    def close(self) -> None:
        try:
            self.loop.call(self.server.stop())
        finally:
            self.loop.end()


def _values(one: Result, names: list[str]) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = [("y", one.y), ("y_hat", one.y_hat), ("innovation", one.e), ("alarm", one.alarm)]
    found += list(zip(names, one.theta, strict=False))
    return found + [(f"std {name}", value) for name, value in zip(names, one.std, strict=False)]

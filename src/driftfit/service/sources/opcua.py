"""OPC UA, by asyncua (an optional package under the LGPL): values of variables by subscription.

Each entry of ``nodes`` is a unit's topic with its variables by field: the last known values of all of them become a
sample whenever one of them, or the one named ``trigger``, changes. The time is the source timestamp, in the field
``time``. A subscription begins with the present values and has no past, so samples during an absence are lost.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from dataclasses import dataclass
from typing import Any

from driftfit.service.settings.options import Secret
from driftfit.service.sources.contract import Reader, Source
from driftfit.service.sources.samples import Batch, Samples

WAITING = 100_000
"""Changes that wait to be read; beyond that the oldest are dropped, and counted as refused."""
MOST = 2_000


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
        """The address and the client library."""
        if not self.url.startswith("opc.tcp://"):
            raise ValueError(f"opcua: url must be opc.tcp://host:port; got {self.url!r}.")
        asyncua()

    def open(self, position: Any) -> Reader:
        """Connect and subscribe."""
        return _Opcua(self)


class _Opcua(Reader):
    def __init__(self, options: Opcua) -> None:
        self.options = options
        self.changes: queue.Queue[tuple[str, dict[str, Any]]] = queue.Queue(WAITING)
        self.values: dict[str, dict[str, Any]] = {topic: {} for topic in options.nodes}
        self.dropped = 0
        self.error: BaseException | None = None
        self.places: dict[str, tuple[str, str]] = {}
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        try:
            self._call(self._connect())
        except BaseException:
            self.close()
            raise

    def _call(self, work: Any, timeout: float = 20.0) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(timeout)

    async def _connect(self) -> None:
        library = asyncua()
        self.client = library.Client(self.options.url, timeout=10)
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
            self.changes.put_nowait((topic, dict(values)))
        except queue.Full:
            self.dropped += 1

    def status_change_notification(self, status: Any) -> None:
        """Called by the library when the subscription ends."""
        self.error = ConnectionError(f"subscription: {status}")

    def read(self, wait: float) -> Batch | None:
        """The changes that have arrived."""
        try:
            found = [self.changes.get(timeout=wait)]
        except queue.Empty:
            if self.error is not None:
                raise self.error from None
            self._call(self.client.check_connection())
            return None
        arrived = time.monotonic()
        while len(found) < MOST and not self.changes.empty():
            found.append(self.changes.get())
        refused, self.dropped = self.dropped, 0
        rows: dict[str, list[dict[str, Any]]] = {}
        for topic, values in found:
            rows.setdefault(topic, []).append(values)
        samples = [
            Samples(topic, len(many), {name: [one.get(name) for one in many] for name in many[-1]})
            for topic, many in rows.items()
        ]
        return Batch(samples, refused=refused, arrived=arrived)

    def close(self) -> None:
        """Disconnect."""
        try:
            if hasattr(self, "client"):
                self._call(self.client.disconnect(), 5.0)
        except Exception:  # the server may be gone
            pass
        finally:
            self.loop.call_soon_threadsafe(self.loop.stop)
            self.thread.join(5.0)
            self.loop.close()


def asyncua() -> Any:
    """The library; ImportError says how to install it."""
    try:
        import asyncua as library
    except ImportError:
        raise ImportError("opcua needs asyncua: pip install 'driftfit[opcua]'.") from None
    return library

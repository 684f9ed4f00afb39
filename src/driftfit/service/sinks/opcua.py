"""OPC UA, by asyncua: the service as a server, with a folder per unit and a variable for each number it follows.

A client sees the last values: prediction, innovation, alarm, and each parameter with its standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from driftfit.service.connector import ANSWER_SECONDS, EventLoop
from driftfit.service.sinks.contract import Outcome, Result, Sink, Writer
from driftfit.service.sources.opcua import library


@dataclass(frozen=True)
class Opcua(Sink):
    """A server of the present values."""

    url: str = "opc.tcp://127.0.0.1:4840/driftfit"

    def check(self) -> None:
        if not self.url.startswith(("opc.tcp://127.0.0.1", "opc.tcp://localhost")):
            raise ValueError(
                f"opcua: url {self.url!r} can be reached from other machines, without a password; use 127.0.0.1 and "
                "a gateway."
            )
        library()

    def open(self) -> Writer:
        return _Opcua(self.url)


class _Opcua(Writer):
    def __init__(self, url: str) -> None:
        self.variables: dict[tuple[str, str], Any] = {}
        self.folders: dict[str, Any] = {}
        self.loop = EventLoop()
        try:
            self.loop.call(self._start(url), 2 * ANSWER_SECONDS)
        except BaseException:
            self.loop.end()
            raise

    async def _start(self, url: str) -> None:
        self.server = library().Server()
        await self.server.init()
        self.server.set_endpoint(url)
        self.space = await self.server.register_namespace("https://driftfit/units")
        await self.server.start()

    def write(self, batch: Outcome) -> None:
        self.loop.call(self._write(batch))

    async def _write(self, batch: Outcome) -> None:
        for one in batch.last:
            for name, value in _values(one, batch.about[one.unit]["names"]):
                variable = self.variables.get((one.unit, name))
                if variable is None:
                    folder = await self._folder(one.unit)
                    variable = await folder.add_variable(f"ns={self.space};s={one.unit}.{name}", name, value)
                    self.variables[one.unit, name] = variable
                else:
                    await variable.write_value(value)

    async def _folder(self, unit: str) -> Any:
        if unit not in self.folders:
            home = self.server.nodes.objects
            self.folders[unit] = await home.add_folder(f"ns={self.space};s={unit}", unit)
        return self.folders[unit]

    def close(self) -> None:
        try:
            self.loop.call(self.server.stop())
        finally:
            self.loop.end()


def _values(one: Result, names: list[str]) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = [("y", one.y), ("y_hat", one.y_hat), ("innovation", one.e), ("alarm", one.alarm)]
    found += list(zip(names, one.theta, strict=False))
    return found + [(f"std {name}", value) for name, value in zip(names, one.std, strict=False)]

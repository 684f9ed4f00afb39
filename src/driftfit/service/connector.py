"""What sources and sinks have in common: options, which are the fields of a frozen dataclass, and a client library."""

from __future__ import annotations

import asyncio
import threading
from abc import ABC
from dataclasses import dataclass
from importlib import import_module
from typing import Any

ANSWER_SECONDS = 20.0
"""In this time a broker or a server must have answered."""


@dataclass(frozen=True)
class Connector(ABC):
    """A source or a sink; the name is that of its table, or its kind and number."""

    name: str

    def check(self) -> None:
        """Raise ValueError or ImportError if the options cannot work."""
        return None


def client_library(kind: str, module: str, package: str, extra: str) -> Any:
    """The client library of a kind of connector; ImportError says how to install it."""
    try:
        return import_module(module)
    except ImportError:
        raise ImportError(f"{kind} needs {package}: pip install 'driftfit[{extra}]'.") from None


class EventLoop:
    """An event loop of asyncio in a thread of its own."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()

    def call(self, work: Any, seconds: float = ANSWER_SECONDS) -> Any:
        """The result of a coroutine."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(seconds)

    def end(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(5.0)
        self.loop.close()

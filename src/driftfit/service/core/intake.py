"""Batches that wait for the journal: batches of sources, and actions, bounded in number.

A source that delivers faster than the journal takes is held back in `put`. Nothing is dropped here.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from driftfit.service.sources.samples import Batch


class Action(NamedTuple):
    """An action on a unit, by an operator or by the service itself."""

    unit: str
    what: dict[str, Any]
    done: Callable[[str], None] = lambda problem: None
    """Called when it was carried out, with "" or the reason why that was not possible."""


class Arrived(NamedTuple):
    """Batches and actions that are journaled together."""

    batches: list[tuple[str, Batch]]
    actions: list[Action]


class Intake:
    """A bounded queue of samples, and an unbounded one of the few actions."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.waiting = 0
        """Samples that wait."""
        self.held_back = 0
        """How often a source had to wait."""
        self._batches: deque[tuple[str, Batch]] = deque()
        self._actions: deque[Action] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, source: str, batch: Batch) -> bool:
        """Add a batch once there is room; False if the service stops first."""
        count = _size(batch)
        with self._changed:
            if self.waiting and self.waiting + count > self.most:
                self.held_back += 1
            while self.waiting and self.waiting + count > self.most and not self._closed:
                self._changed.wait()
            if self._closed:
                return False
            self._batches.append((source, batch))
            self.waiting += count
            self._changed.notify_all()
        return True

    def act(self, action: Action) -> None:
        with self._changed:
            self._actions.append(action)
            self._changed.notify_all()

    def take(self, most: int, wait: float) -> Arrived:
        """The batches that have arrived, up to about ``most`` samples; empty after ``wait`` seconds."""
        until = time.monotonic() + wait
        with self._changed:
            while not (self._batches or self._actions or self._closed):
                left = until - time.monotonic()
                if left <= 0.0 or not self._changed.wait(left):
                    break
            batches, count = [], 0
            while self._batches and count < most:
                batches.append(self._batches.popleft())
                count += _size(batches[-1][1])
            self.waiting -= count
            actions = list(self._actions)
            self._actions.clear()
            self._changed.notify_all()
        return Arrived(batches, actions)

    def close(self) -> None:
        """Release everyone who waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


def _size(batch: Batch) -> int:
    return max(1, sum(one.length for one in batch.samples))

"""What a source is, and what it gives: batches of samples."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftfit.service.connector import Connector
from driftfit.service.sources.samples import Batch

END = Batch([], position="end")
"""The result of `read` when the source has ended."""


@dataclass(frozen=True)
class Source(Connector):
    """A source of samples."""

    @abstractmethod
    def open(self, position: Any) -> Reader:
        """Connect, and continue at a position."""


@dataclass(frozen=True)
class FileSource(Source):
    """A source that reads a file."""

    path: str
    topic: str = ""
    """Topic of the samples; empty: the name of the file."""
    by: str = ""
    """Column that names the unit; it is added to the topic after a slash."""

    def topic_of(self, unit: Any) -> str:
        """The topic of the samples of a unit; without ``by`` that of all."""
        topic = self.topic or Path(self.path).name
        return f"{topic}/{unit}" if self.by else topic


class Reader(ABC):
    """An open source."""

    @abstractmethod
    def read(self, wait: float) -> Batch | None:
        """The samples that have arrived, or None after ``wait`` seconds."""

    def close(self) -> None:
        """Disconnect."""
        return None

"""A source consists of options and two methods. A new source is one file in this folder, with a class of its name.

    class Mine(Source):                         # src/driftfit/service/sources/mine.py, kind = "mine"
        url: str                                # options are the fields of a frozen dataclass
        def open(self, position): ...           # connect; position is where the last run had come to, or None
        def read(self, wait): ...               # a Batch with an acknowledgement, or None if nothing came

`read` is called repeatedly in a separate thread. It blocks for at most ``wait`` seconds. The acknowledgement
of a batch is called, from the thread of the journal, after its samples are on disk. An exception means that the source
is away: it is closed, and opened again after a pause of 1 s, 2 s, ... 60 s.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftfit.service.sources.samples import Batch

END = Batch([], position="end")
"""The result of `read` when the source has ended."""


@dataclass(frozen=True)
class Source(ABC):
    """A source of samples."""

    name: str

    def check(self) -> None:
        """Raise ValueError or ImportError if the options cannot work."""
        return None

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

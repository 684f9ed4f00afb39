"""HTTP: samples that clients send to ``POST /api/samples`` of the page; answered once they are in the journal."""

from __future__ import annotations

import queue
from dataclasses import dataclass
from typing import Any

from driftfit.service.sources.contract import Reader, Source
from driftfit.service.sources.incoming import INCOMING
from driftfit.service.sources.samples import Batch


@dataclass(frozen=True)
class Http(Source):
    """Samples over HTTP; host, port and tokens are those of [page]."""

    def open(self, position: Any) -> Reader:
        """Begin to take samples; the clients keep samples that are not yet acknowledged."""
        return _Http()


class _Http(Reader):
    def read(self, wait: float) -> Batch | None:
        """The next request."""
        try:
            return INCOMING.queue.get(timeout=wait)
        except queue.Empty:
            return None

"""A live service: sources, a journal, the engine, sinks and a page (docs/service.md); the classes that sources of your
own need.
"""

from driftfit.service.connect.base import Batch, Event, Outcome, Reader, Samples, Sink, Source, Writer
from driftfit.service.core.results import Result

__all__ = ["Batch", "Event", "Outcome", "Reader", "Result", "Samples", "Sink", "Source", "Writer"]

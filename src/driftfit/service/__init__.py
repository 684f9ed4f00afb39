"""A live service: sources, a journal, the engine, sinks and a page (docs/service.md); the classes that sources of your
own need.
"""

from driftfit.service.sinks.contract import Event, Outcome, Result, Sink, Writer
from driftfit.service.sources.contract import Batch, Reader, Samples, Source

__all__ = ["Batch", "Event", "Outcome", "Reader", "Result", "Samples", "Sink", "Source", "Writer"]

"""A sink consists of options and of ``write``. A new sink is one file in this folder, with a class of its name.

    class Mine(Sink):                           # src/driftfit/service/sinks/mine.py, kind = "mine"
        url: str                                # options are the fields of a frozen dataclass
        def open(self): ...                     # connect, and return a Writer
                                                # Writer.write(batch) returns once the batch is safe

A sink reads the stored results from where it stopped, so one that is away or slow never delays the tracking and loses
nothing. After a crash the last batches come again: every result has a ``number``, by which an idempotent sink skips
results that it already has. An exception means that the sink is away; the batch is written again after a pause. A sink
with ``one_by_one`` takes events in batches of one, and raises `RefusedError` for one that its receiver does not want:
after some tries that event is set aside, so that it does not hold up those behind it.
"""

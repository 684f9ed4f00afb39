"""A notice that the compiler is working, for whoever waits for it on a terminal or in a notebook: one line on stderr
after two seconds, once per process. Output to a file or a program is not changed.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PATIENCE = 2.0
"""Seconds of silence: the notice, and what other work says of its progress, appear after them."""

TEXT = "driftfit: compiling once for this computer ..."
TEXT_IN_MEMORY = "driftfit: compiling; no folder can be written to keep the code ..."

lock = threading.RLock()
_spent = 0.0
_depth = 0
_shown = False


@contextmanager
def compiling() -> Iterator[None]:
    """A context manager around compilation; of nested ones the outermost counts."""
    global _depth, _spent
    with lock:
        _depth += 1
        timer = None
        if _depth == 1 and not _shown and watched():
            timer = threading.Timer(max(PATIENCE - _spent, 0.0), say)
            timer.daemon = True
            timer.start()
    start, collecting = time.perf_counter(), gc.isenabled()
    gc.disable()  # it takes 6 per cent of the time, and a compiler leaves little behind
    try:
        yield
    finally:
        if collecting and not gc.get_freeze_count():
            gc.freeze()  # what the compiler made is old at once, so that the next collection does not visit it
            gc.unfreeze()
        if collecting:
            gc.enable()
        if timer is not None:
            timer.cancel()
        with lock:
            _depth -= 1
            if _depth == 0:
                _spent += time.perf_counter() - start


def watched() -> bool:
    """Whether stderr is a terminal."""
    return "ipykernel" in sys.modules or bool(sys.stderr and sys.stderr.isatty())


def say() -> None:
    """Print the notice, once."""
    global _shown
    from driftfit.engine.disk_cache import folder

    if not _shown:
        _shown = True
        print(TEXT if folder() else TEXT_IN_MEMORY, file=sys.stderr, flush=True)

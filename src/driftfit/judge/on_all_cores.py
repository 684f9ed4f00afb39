"""Judge many runs on all cores."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from time import monotonic
from typing import TypeVar

from driftfit.run.parallel_lanes import cores
from driftfit.run.program import progress_bar

Result = TypeVar("Result")
PATIENCE = 2.0
"""Seconds after which a progress bar appears."""


def on_all_cores(keys: Iterable[Hashable], judge: Callable[[Hashable], Result], what: str) -> dict[Hashable, Result]:
    """``judge(key)`` for each key, in their order; the first alone, so that only one thread compiles."""
    keys = list(keys)
    found = [judge(key) for key in keys[:1]]
    progress = progress_bar()
    task, begun, shown = progress.add_task(what, total=len(keys), completed=len(found)), monotonic(), False
    with ThreadPoolExecutor(cores()) as pool, ExitStack() as stack:
        for one in pool.map(judge, keys[1:]):
            found.append(one)
            progress.advance(task)
            if not shown and monotonic() - begun > PATIENCE:
                stack.enter_context(progress)
                shown = True
    return dict(zip(keys, found, strict=True))

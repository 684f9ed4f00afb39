"""Judge many runs on all cores, in threads where that takes seconds and in processes where it takes longer.

Half of the time of a verdict is spent in Python, which only one thread executes at a time, so a second thread gains
little. A process has a core of its own; the price is its start (about a second) and sending it the runs (a tenth of the
time of a verdict).

Each process is a new interpreter that imports the package and reads batches from its input until that is closed. Unlike
the workers of ``multiprocessing``, it does not run the user's script again, so scripts need no guard against that. A
batch that fails there is judged in a thread of this process instead: a model that the user's script defines cannot be
sent, and a process may be killed for its memory. An error is then raised here, where the user can read it.

The compiler holds the lock of the interpreter, so a second process also compiles while the first one works, into the
folder that both read (`compiling_beside`).
"""

from __future__ import annotations

import gc
import os
import pickle
import signal
import sys
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from subprocess import DEVNULL, PIPE, Popen
from time import monotonic
from typing import IO, Any, Self, TypeVar

import numpy as np

from driftfit.engine.compile_notice import PATIENCE
from driftfit.engine.disk_cache import folder
from driftfit.judge.changes.null import Lags
from driftfit.judge.changes.words import events
from driftfit.judge.evidence import REJECTED, judged_rows
from driftfit.judge.regressors import Rows
from driftfit.run.parallel_lanes import cores
from driftfit.run.program import progress_bar
from driftfit.trackers.forms.diffuse import machine_learn, machine_root, machine_wander

Result = TypeVar("Result")
FIRST = 5
"""Runs that are judged first, one by one: one compiles, and the others show how long a run takes."""
WORTH = 5.0
"""Processes are started for more seconds of work than this."""
BATCH = 0.2
"""Seconds of work that are sent to a process at once."""

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
"""A process has one core: threads of its linear algebra would wait for one another, and take twice the time."""


def on_all_cores(
    keys: Iterable[Hashable], arguments: Callable[[Hashable], tuple[Any, ...]], judge: Callable[..., Result], what: str
) -> dict[Hashable, Result]:
    """``judge(*arguments(key))`` for each key, in their order; the first few one by one: one thread compiles.

    Processes find ``judge`` by its name, so it must be a function of a module.
    """
    keys = list(keys)
    found = [judge(*arguments(key)) for key in keys[:1]]
    begun = monotonic()
    found += [judge(*arguments(key)) for key in keys[1:FIRST]]
    each = (monotonic() - begun) / (FIRST - 1)
    progress = progress_bar()
    task, begun, shown = progress.add_task(what, total=len(keys), completed=len(found)), monotonic(), False
    with ExitStack() as stack:
        for some in _judged(stack, keys[FIRST:], arguments, judge, each):
            found += some
            progress.advance(task, len(some))
            if not shown and monotonic() - begun > PATIENCE:
                stack.enter_context(progress)
                shown = True
    return dict(zip(keys, found, strict=True))


def _judged(
    stack: ExitStack,
    keys: list[Hashable],
    arguments: Callable[[Hashable], tuple[Any, ...]],
    judge: Callable[..., Result],
    each: float,
) -> Iterator[list[Result]]:
    """The results of batches of keys, as they become known, in order; ``each`` is the time for one in seconds."""
    many = each * len(keys) > WORTH and cores() > 1 and available()
    size = min(max(int(BATCH / each), 1), 64) if many else 1
    batches = [keys[k : k + size] for k in range(0, len(keys), size)]
    processes = stack.enter_context(Processes(cores())) if many else None
    pool = stack.enter_context(ThreadPoolExecutor(cores()))

    def judged(batch: list[Hashable]) -> list[Result]:
        chosen = [arguments(key) for key in batch]
        return processes.map(judge, chosen) if processes else [judge(*one) for one in chosen]

    yield from pool.map(judged, batches)


def available() -> bool:
    """Whether ``sys.executable`` is Python; in a program that embeds or freezes Python it is that program."""
    return Path(sys.executable or "").stem.lower().startswith(("python", "pypy"))


def _python(function: str, **streams: Any) -> Popen[bytes]:
    """A new interpreter that runs a function of this module."""
    code = f"from {__name__} import {function}; {function}()"
    path = os.pathsep.join(filter(None, sys.path))
    return Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path} | ONE_THREAD, **streams)


class Processes:
    """A number of processes, as a context: they end with it."""

    def __init__(self, count: int) -> None:
        self._all: list[Any] = [_python("serve", stdin=PIPE, stdout=PIPE) for _ in range(count)]
        self._idle: SimpleQueue[Any] = SimpleQueue()
        for process in self._all:
            self._idle.put(process)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._all:
            process.kill()
        for process in self._all:
            process.wait()
            for stream in (process.stdin, process.stdout):
                with suppress(OSError):  # what was not sent to a process that has ended
                    stream.close()

    def map(self, judge: Callable[..., Any], batch: Sequence[tuple[Any, ...]]) -> list[Any]:
        """``judge(*arguments)`` for each entry of the batch, in an idle process, or here if that fails."""
        process = self._idle.get()
        try:
            _send(process.stdin, (judge, batch))
            found = pickle.loads(pickle.load(process.stdout))
        except (OSError, EOFError, pickle.PickleError, AttributeError, TypeError):
            found = None
        finally:
            self._idle.put(process)
        return [judge(*arguments) for arguments in batch] if found is None else list(found)


def serve() -> None:
    """Judge batches until the input ends; the answer to one that raises an exception is None."""
    gc.freeze()  # what was imported stays: no collection looks at it again
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the process that sends the batches
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a model prints does not mix with the answers
    while True:
        try:
            message = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            judge, batch = pickle.loads(message)
            answer = [judge(*arguments) for arguments in batch]
        except Exception:
            answer = None
        _send(answers, answer)


def _send(stream: IO[bytes], what: Any) -> None:
    """A pickle within a pickle: what cannot be read from it leaves the stream where the next one begins."""
    pickle.dump(pickle.dumps(what, pickle.HIGHEST_PROTOCOL), stream, pickle.HIGHEST_PROTOCOL)
    stream.flush()


@contextmanager
def compiling_beside() -> Iterator[Callable[[], object]]:
    """While this process works, another compiles half of what every `driftfit.identify` needs, if nothing of it is on
    disk and there is a core for it. Yields the function that waits for it.
    """
    place = folder()
    if cores() < 2 or not available() or place is None or any(place.glob("draw-*")):
        yield lambda: None
        return
    with _python("fill", stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL) as beside:
        try:
            yield beside.wait
        finally:
            beside.terminate()


def fill() -> None:
    """Compile what the start of a tracker calls, and the verdict: of an autoregression whose level jumps."""
    for one in (machine_learn, machine_root, machine_wander):
        one.load()
    at = np.arange(1, 300)
    y = np.random.default_rng(0).normal(size=len(at) + 1) + 2.0 * (np.arange(len(at) + 1) > at.mean())
    lags = Lags(np.arange(1), at[:, None] - 2, np.ones((len(at), 1)))
    rows = Rows(at, np.column_stack([y[:-1], np.ones(len(at))]), y[1:], None, lags, np.ones(len(at)))
    if found := judged_rows(rows, REJECTED):
        events(found, ("a1", "intercept"), at, str)

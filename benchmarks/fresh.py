"""One `track` in a fresh process; prints as JSON how long it took, what was compiled, and the memory it needed.

    python benchmarks/fresh.py 100000

``seconds`` runs from the first line of this file to the first result. ``extra`` is the peak memory of the process
during a second run on T samples, minus what it held before and the bytes of the results.
"""

from time import perf_counter

STARTED = perf_counter()

import json
import resource
import sys

import numba  # noqa: F401 - its share of the start-up is told apart

NUMBA = perf_counter()

import numpy as np
from numba.core import event

from driftfit import ARX, Kalman, track


def peak() -> int:
    """The peak memory of this process in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def main(T: int) -> None:
    rng = np.random.default_rng(1)
    y, u = rng.normal(size=T), rng.normal(size=T)
    with event.install_recorder("numba:compile") as compiled:
        track(ARX(2, 2), Kalman(q=1e-4, r=0.1), y[:1000], u[:1000])
    seconds = perf_counter() - STARTED
    before = peak()
    run = track(ARX(2, 2), Kalman(q=1e-4, r=0.1), y, u)
    extra = peak() - before - run._lane.out.nbytes
    functions = sum(record.is_start for _, record in compiled.buffer)
    print(json.dumps({"seconds": seconds, "numba": NUMBA - STARTED, "compiled": functions, "extra": extra}))


main(int(sys.argv[1]))

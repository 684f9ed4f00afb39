"""The first result of a tracker on a fresh install: how long a newcomer waits while the compiler works.

    python benchmarks/cold_start.py [--quick] [NAME ..]

Each tracker runs in a process of its own over a record of 200 samples, twice: with an empty cache of compiled code, and
with what the first run left there. Printed are seconds from the call of `track` to its result by the clock and of
processor time (on a busy machine the former says little), without the import of the library, which is a column of its
own. ``--quick`` takes the Kalman filter alone.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

TRACKERS = {
    "Kalman": "ARX(2, 2), Kalman(q=1e-4, r=0.1)",
    "AdaptiveKalman": "ARX(2, 2), AdaptiveKalman()",
    "HammersteinWiener": "HammersteinWiener(na=2, nb=2), AdaptiveKalman()",
    "Bank": "ARX(2, 2), Bank()",
}
"""Names, and the model and tracker of each."""
WANTED = {"Kalman": 4.0, "AdaptiveKalman": 8.0, "HammersteinWiener": 10.0, "Bank": 15.0}
"""Seconds that a first result may take on two cores."""
PROGRAM = """
import json, time
start = time.perf_counter()
import numpy as np
from driftfit import ARX, AdaptiveKalman, Bank, HammersteinWiener, Kalman, track
rng = np.random.default_rng(0)
y, u = rng.standard_normal(200), rng.standard_normal(200)
ready, spent = time.perf_counter(), time.process_time()
track({}, y, u)
print(json.dumps([ready - start, time.perf_counter() - ready, time.process_time() - spent]))
"""


def once(name: str, cache: str) -> tuple[float, float, float]:
    """Seconds of the import, of the first result, and of the processor for it."""
    settings = {**os.environ, "NUMBA_CACHE_DIR": cache}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(TRACKERS[name])], env=settings, capture_output=True, text=True, check=True
    )
    imported, waited, spent = json.loads(done.stdout.splitlines()[-1])
    return imported, waited, spent


def main(names: list[str]) -> None:
    print("                     import   first result   processor   wanted   again")
    for name in names:
        with tempfile.TemporaryDirectory() as cache:
            imported, waited, spent = once(name, cache)
            again = once(name, cache)[1]
        print(f"{name:18} {imported:7.1f} s {waited:10.1f} s {spent:9.1f} s {WANTED[name]:6.0f} s {again:7.2f} s")


if __name__ == "__main__":
    main(["Kalman"] if "--quick" in sys.argv else sys.argv[1:] or list(TRACKERS))

"""The first result of a tracker on a fresh install: how long a newcomer waits while the compiler works.

    python benchmarks/cold_start.py [--quick] [NAME ..]

Each tracker runs in a process of its own over a record of 200 samples, twice: with an empty cache of compiled code, and
with what the first run left there. Printed are seconds from the call of `track` to its result by the clock and of
processor time (on a busy machine the former says little), without the import of the library, which is a column of its
own; then the processor time of a second model of another size in the same process. Selections are over structures of a
record of 600 samples, 27 ARX orders and delays and 18 Hammerstein-Wiener orders and bases, and over the same ARX
structures on a stream. ``--quick`` takes the Kalman filter alone, with the compiled code that is there already.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

TRACKERS = {
    "Kalman": "ARX(na=ORDER, nb=2), Kalman(q=1e-4, r=0.1)",
    "AdaptiveKalman": "ARX(na=ORDER, nb=2), AdaptiveKalman()",
    "HammersteinWiener": "HammersteinWiener(na=ORDER, nb=2), AdaptiveKalman()",
    "Bank": "ARX(na=ORDER, nb=2), Bank()",
}
"""Names, and the model and tracker of each, with an order that is 2 first and then 3."""
SELECTIONS = {
    "27 ARX, Kalman": "grid(ARX, na=[1, 2, 3], nb=[1, 2, 3], nk=[0, 1, 2]), y, u, tracker=Kalman(q=1e-4, r=0.1)",
    "27 ARX": "grid(ARX, na=[1, 2, 3], nb=[1, 2, 3], nk=[0, 1, 2]), y, u",
    "18 Hammerstein-W.": "grid(HammersteinWiener, na=[1, 2, 3], nb=[1, 2], input=[None, Polynomial(2), Polynomial(3)], "
    "output=[Polynomial(2)]), y, u",
}
"""Candidates, and the rest of the arguments of `select`."""
STREAMS = {
    "27 ARX, live": "grid(ARX, na=[1, 2, 3], nb=[1, 2, 3], nk=[0, 1, 2]), Kalman(q=1e-4, r=0.1)",
}
"""Arguments of `LiveSelection`, which processes one sample."""
WANTED = {
    "Kalman": 4.0, "AdaptiveKalman": 8.0, "HammersteinWiener": 10.0, "Bank": 15.0, "27 ARX, Kalman": 5.0, "27 ARX": 5.0,
    "18 Hammerstein-W.": 30.0, "27 ARX, live": 5.0,
}  # fmt: skip
"""Seconds that a first result may take on two cores."""
PROGRAM = """
import json, time
start = time.perf_counter()
import numpy as np
from driftfit import ARX, AdaptiveKalman, Bank, HammersteinWiener, Kalman, LiveSelection, grid, select, track
from driftfit.models.hammerstein_wiener.basis import Polynomial
rng = np.random.default_rng(0)
y, u = rng.standard_normal(LENGTH), rng.standard_normal(LENGTH)
ready, spent = time.perf_counter(), time.process_time()
CALL
waited, done = time.perf_counter() - ready, time.process_time()
OTHER
print(json.dumps([ready - start, waited, done - spent, time.process_time() - done]))
"""


def once(name: str, cache: dict[str, str]) -> tuple[float, float, float, float]:
    """Seconds of the import, of the first result, and of the processor for it and for a model of another size."""
    settings = {**os.environ, **cache}
    calls = {one: f"track({given}, y, u)" for one, given in TRACKERS.items()}
    calls |= {one: f"select({given})" for one, given in SELECTIONS.items()}
    calls |= {one: f"LiveSelection({given}).update(y[0], u[0])" for one, given in STREAMS.items()}
    first, other = (calls[name].replace("ORDER", order) for order in ("2", "3"))
    length, other = ("200", other) if name in TRACKERS else ("600", "")
    program = PROGRAM.replace("CALL", first).replace("OTHER", other).replace("LENGTH", length)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program], env=settings, capture_output=True, text=True, check=True
    )
    imported, waited, spent, other_size = json.loads(done.stdout.splitlines()[-1])
    return imported, waited, spent, other_size


def main(names: list[str], quick: bool) -> None:
    print("                     import   first result   processor   wanted   other size   again")
    for name in names:
        with tempfile.TemporaryDirectory() as empty:
            cache = {} if quick else {"NUMBA_CACHE_DIR": empty}
            imported, waited, spent, other = once(name, cache)
            again = once(name, cache)[1]
        size = f"{other:10.1f} s" if name in TRACKERS else " " * 12
        print(
            f"{name:18} {imported:7.1f} s {waited:10.1f} s {spent:9.1f} s {WANTED[name]:6.0f} s {size} {again:7.2f} s"
        )


if __name__ == "__main__":
    quick = "--quick" in sys.argv
    main(["Kalman"] if quick else sys.argv[1:] or [*TRACKERS, *SELECTIONS, *STREAMS], quick)

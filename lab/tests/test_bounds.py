"""Compiled code with checks names the index that is out of bounds; faults to plant are lines of the source."""

import os
import subprocess
import sys

from lab.bounds.checks import settings
from lab.bounds.commands import PLANTED, ROOT

PLANT = """
import numpy as np
from lab.bounds.checks import watch
noted = watch()
from driftfit.engine.kernel import Driver, shared
from driftfit.engine.simd import load, sum_of

@shared
def total(x, count):
    found = 0.0
    for i in range(count):
        found += x[0, i]
    return found

@Driver
def run(x, count, first):
    return total(x, count) + sum_of(load(x, 0, first))

run(np.ones((1, 12)), 12, 4)
print(noted.take())
run(np.ones((1, 12)), 13, 5)
print(noted.take())
"""


def test_an_index_out_of_bounds_is_named(tmp_path):
    """Of scalars and of vectors; with code that this process compiled, and with what it finds on disk."""
    (tmp_path / "lab").mkdir()
    script = tmp_path / "lab" / "planted.py"
    script.write_text(PLANT)
    own = os.environ | settings() | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    for _ in range(2):
        done = subprocess.run([sys.executable, script], env=own, capture_output=True, text=True, check=True)
        clean, wrong = done.stdout.splitlines()
        assert clean == "[]"
        assert wrong == "['planted.py:12: index 12 of 12', 'planted.py:17: index 12 of 12']"


def test_planted_faults_are_in_the_source():
    for name, line, instead in PLANTED.values():
        assert (ROOT / "src" / "driftfit" / name).read_text().count(line) == 1
        assert line != instead

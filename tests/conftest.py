"""Set-up shared by all tests: no display, the same hypothesis examples in every run, and much kept by the compiler."""

import gc
import os

# A process for every core: threads of linear algebra that waited for one took two thirds of the time of some tests.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
# Numba colours every error on the way to the right types; nobody sees them, and they are 4 % of the time of compiling.
os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"

import matplotlib
import pytest
from hypothesis import HealthCheck, settings

from driftfit.engine import kernel

matplotlib.use("Agg")
settings.register_profile(
    "fixed", deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("fixed")
gc.set_threshold(50_000, 20, 1000)  # what the compiler keeps was searched again and again: a tenth of the suite's time
kernel.KEPT = 5000  # tests come back to a record type after all others: at most 1 GB for two fifths of the compiling

compiled_before = len(kernel._entries._owners)


def pytest_collection_finish():
    """Every process of a run collects all tests, so each would compile it, at the same time."""
    if len(kernel._entries._owners) > compiled_before:
        raise pytest.UsageError("a test module runs a tracker while tests are collected; do so in a test or a fixture")

"""Set-up shared by all tests: no display, the same hypothesis examples in every run, and much kept by the compiler."""

import matplotlib
from hypothesis import HealthCheck, settings

from driftfit.engine import kernel

matplotlib.use("Agg")
settings.register_profile(
    "fixed", deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("fixed")
kernel.KEPT = 2000  # tests come back to a record type after all others: 0.4 GB for a third of the compiling

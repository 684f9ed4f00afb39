"""Fleets on Spark: `track` for tables, `follow` for streams, with PySpark 4 (``pip install driftfit[spark]``) and Java.

Spark partitions, shuffles, retries and keeps checkpoints; this package adds the step. Every unit gives the bits that
`driftfit.track` gives for it on one machine.
"""

from driftfit.bridges.spark.batch import track
from driftfit.bridges.spark.follow import Store, follow
from driftfit.bridges.spark.frames import session
from driftfit.bridges.spark.keyed import follow_keyed

__all__ = ["Store", "follow", "follow_keyed", "session", "track"]

"""From a Parquet file to the most drifted units, on Spark with two cores of this computer.

Eighty heating circuits report once an hour for three weeks: the power that they draw, and the temperature difference
that should explain it. Four of them lose insulation from the second week on.

    pip install driftfit[spark]          # and Java 17 or 21
    python examples/spark_fleet.py
"""

import tempfile
from pathlib import Path

import numpy as np
import polars as pl

from driftfit import ARX, Kalman
from driftfit.bridges import spark

HOURS, CIRCUITS, WORN = 21 * 24, 80, (7, 23, 42, 61)


def readings() -> pl.DataFrame:
    """Rows in no order, two per cent of them without a reading."""
    rng = np.random.default_rng(1)
    parts = []
    for k in range(CIRCUITS):
        difference = 12.0 + 6.0 * np.sin(np.arange(HOURS) * 2.0 * np.pi / 24.0) + rng.normal(size=HOURS)
        gain = np.full(HOURS, 0.8)
        if k in WORN:
            gain[HOURS // 3 :] += np.linspace(0.0, 0.12, HOURS - HOURS // 3)
        power = np.zeros(HOURS)
        for t in range(1, HOURS):
            power[t] = 0.6 * power[t - 1] + gain[t] * difference[t - 1] + 0.5 * rng.normal()
        power[rng.random(HOURS) < 0.02] = np.nan
        time = np.datetime64("2024-01-01", "us") + np.arange(HOURS) * np.timedelta64(3600, "s")
        parts.append(pl.DataFrame({"circuit": f"circuit {k:02d}", "time": time, "power": power, "dT": difference}))
    return pl.concat(parts).sample(fraction=1.0, shuffle=True, seed=0)


def main() -> None:
    session = spark.session("local[2]")
    session.sparkContext.setLogLevel("OFF")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "readings.parquet"
        readings().write_parquet(path)
        rows = session.read.parquet(str(path))
        found = spark.track(
            rows, ARX(1, 1), Kalman(q=1e-5, r=0.25), y="power", u="dT", by="circuit", time="time", dt="1h",
            outputs="verdict",
        )  # fmt: skip
        gain = ["round(`theta_b1[dT]`, 3) gain", "round(`std_b1[dT]`, 3) std"]
        found.orderBy("p").selectExpr("circuit", "drifts", "round(p, 5) p", "moved", *gain, "used").show(6)
    session.stop()


if __name__ == "__main__":
    main()

"""Sixteen pumps in one table: different lengths, unsorted rows on one day, missing readings, three pumps that wear.

Prints the ranking of the fleet and saves small multiples. Run: python examples/pump_fleet.py [picture.png]
"""

import sys
import warnings
from datetime import timedelta

import numpy as np
import pandas as pd

from driftfit import ARX, DataWarning, Kalman, track

WEAR = {"pump 03": 0.5, "pump 07": 0.25, "pump 11": 0.12}
"""Share of its gain that a pump loses over its record."""

UNITS = {"flow": "l/min", "pressure": "bar"}


def simulate(seed: int = 4) -> pd.DataFrame:
    """Hourly rows of flow_t = 0.6 flow_(t-1) + gain_t pressure_(t-1) + noise, in no order."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(16):
        name, T = f"pump {k:02d}", int(rng.integers(300, 900))
        gain = 4.0 * (1.0 - WEAR.get(name, 0.0) * np.linspace(0.0, 1.0, T))
        pressure = 3.0 + rng.normal(size=T)
        flow = np.full(T, 30.0)
        for t in range(1, T):
            flow[t] = 0.6 * flow[t - 1] + gain[t] * pressure[t - 1] + 0.5 * rng.normal()
        flow[rng.random(T) < 0.05] = np.nan
        start = pd.Timestamp("2024-03-01", tz="Europe/Berlin") + pd.Timedelta(days=int(rng.integers(0, 20)))
        time = pd.date_range(start, periods=T, freq="h")
        parts.append(pd.DataFrame({"pump": name, "time": time, "flow": flow, "pressure": pressure}))
    table = pd.concat(parts)
    return pd.concat([table, table.iloc[:3]]).sample(frac=1.0, random_state=seed)


def main(picture: str | None = None) -> None:
    warnings.filterwarnings("ignore", "time: 3 of 10156 rows", DataWarning)  # the summary counts them too
    fleet = track(
        ARX(1, 1), Kalman(q=[0.0, 1e-4], r=0.25), "flow", "pressure", data=simulate(), time="time", by="pump",
        dt=timedelta(hours=1), units=UNITS,
    )  # fmt: skip
    print(fleet.summary())
    table = fleet["pump 07"].to_table("pandas")
    for row in table.tail(2).to_dict("records"):
        print(f"pump 07 {row['time']}  {row['theta_b1[pressure]']:.3f} (std {row['std_b1[pressure]']:.3f})")
    print(f"unit of b1[pressure]: {table.attrs['units']['theta_b1[pressure]']}")
    if picture:
        fleet.plot("b1[pressure]").savefig(picture, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:2])

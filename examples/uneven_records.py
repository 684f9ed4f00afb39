"""Two real records as recorded: a pump loop with uneven time, and gas sensors with missing readings.

pump_loop_skab.csv (SKAB, three experiments, one row per second with steps of two) and air_quality_sensors.csv (UCI Air
Quality, one row per hour) are not part of this package. Run: python examples/uneven_records.py FOLDER [FIGURES]
"""

import sys
from datetime import timedelta
from pathlib import Path

import numpy as np

from driftfit import ARX, Fleet, Kalman, Regression, Track, track


def pump(folder: Path) -> Fleet:
    """flow ~ its last value, pressure, current: three experiments in one file."""
    return track(
        ARX(1, 1, nk=0, intercept=True), Kalman(q=[0.0, 1e-4, 1e-4, 1e-2], r=0.3),
        "flow_lpm", ["pressure_bar", "current_A"], data=folder / "pump_loop_skab.csv",
        time="datetime", by="experiment", dt=timedelta(seconds=1),
        units={"flow_lpm": "l/min", "pressure_bar": "bar", "current_A": "A"},
    )  # fmt: skip


def sensor(folder: Path) -> Track:
    """The CO sensor against the reference CO, temperature and humidity, over a year."""
    return track(
        Regression(intercept=True), Kalman(q=[1e-2, 1e-1, 1e2, 1e1], r=400.0),
        "PT08_S1_CO", ["CO_GT", "T", "AH"], data=folder / "air_quality_sensors.csv",
        time="datetime", dt=timedelta(hours=1),
        units={"CO_GT": "mg/m3", "T": "degC", "AH": "g/m3"},
    )  # fmt: skip


def main(folder: str, figures: str | None = None) -> None:
    fleet = pump(Path(folder))
    print(fleet.summary())
    for key, run in fleet.items():
        steps = np.diff(run.time) / np.timedelta64(1, "s")
        broken = int(np.sum((steps > 1.5) & ~run.ok[1:]))
        print(f"{key}: {int(np.sum(steps > 1.5))} of {len(run)} steps are gaps; {broken} samples were skipped there")
    print()
    run = sensor(Path(folder))
    print(run.summary())
    absent = np.isnan(run.y), np.isnan(run.u).any(axis=1)
    print(f"of {len(run)} rows {absent[0].sum()} lack the output and {absent[1].sum()} an input")
    if figures:
        fleet["valve1_1"].plot().savefig(Path(figures) / "pump_loop.png", dpi=110)
        run.plot().savefig(Path(figures) / "sensor_year.png", dpi=110)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(*sys.argv[1:3])

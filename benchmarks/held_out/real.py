"""Real records: one-step error and log score of the default, of fixed Kalman filters and of RLS.

The folder holds the files of which `RECORDS` reads the columns (river Le Leguer, INRAE; heated building, darkgreybox;
gas furnace, Box and Jenkins; heat exchanger, DaISy; UCI air quality; SKAB pump loop; US consumption, fpp2). None of
them is part of the project. Records of installed packages are `lab.bench.real`'s.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from driftfit import ARX, RLS, Kalman, Regression, track
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker
from lab.bench.real import SOURCES
from lab.bench.records import Record

RATIOS = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Drift that the fixed filters add to y in a sample, over r; the same for all parameters."""


class Series(NamedTuple):
    """A model of y (T,) on u (T, m)."""

    model: Model
    y: Array
    u: Array


def columns(folder: Path, name: str, wanted: Sequence[str], keep: tuple[str, str] | None = None) -> list[Array]:
    """Columns of a file, NaN where cells are empty; ``keep`` is a column and the value of the rows to read."""
    table = pl.read_csv(folder / name, infer_schema_length=None)
    table = table.filter(pl.col(keep[0]) == keep[1]) if keep else table
    return [table[one].cast(pl.Float64).fill_null(np.nan).to_numpy() for one in wanted]


def river(folder: Path) -> Series:
    """Daily flow on its last value and the rain of two days."""
    y, rain = columns(folder, "river_leguer.csv", ["flow_mm", "rain_mm"])
    return Series(ARX(1, 2, nk=0, intercept=True), y, rain[:, None])


def building(folder: Path) -> Series:
    """Change of a temperature on three physical differences."""
    names = ["indoor_C", "outdoor_C", "heating_water_C", "heat_power_kW"]
    indoor, outdoor, water, power = columns(folder, "building_heating.csv", names)
    u = np.column_stack([outdoor - indoor, water - indoor, power])
    return Series(Regression(3), np.diff(indoor), u[:-1])


def building_arx(folder: Path) -> Series:
    """The same temperature on two lags and one of each input."""
    names = ["indoor_C", "outdoor_C", "heating_water_C", "heat_power_kW"]
    y, *u = columns(folder, "building_heating.csv", names)
    return Series(ARX(2, (1, 1, 1), nk=(1, 1, 1), intercept=True), y, np.column_stack(u))


def gas_furnace(folder: Path) -> Series:
    """CO2 on its last values and the gas rate three and four samples before."""
    y, u = columns(folder, "gas_furnace.csv", ["co2", "gas_rate"])
    return Series(ARX(2, 2, nk=3, intercept=True), y, u[:, None])


def heat_exchanger(folder: Path) -> Series:
    """Outlet temperature on two lags of it and of the flow."""
    y, u = columns(folder, "heat_exchanger.csv", ["temp_out_C", "flow"])
    return Series(ARX(2, 2, intercept=True), y, u[:, None])


def gas_sensor(folder: Path) -> Series:
    """Metal-oxide sensor S4 on benzene, temperature and humidity."""
    y, *u = columns(folder, "air_quality_sensors.csv", ["PT08_S4_NO2", "C6H6_GT", "T", "AH"])
    return Series(Regression(3, intercept=True), y / 1000.0, np.column_stack(u))


def gas_sensor_arx(folder: Path) -> Series:
    """The same with its last value."""
    one = gas_sensor(folder)
    return Series(ARX(1, (1, 1, 1), nk=(0, 0, 0), intercept=True), one.y, one.u)


def pump(folder: Path, experiment: str) -> Series:
    """Flow on pressure and current."""
    wanted = ["flow_lpm", "pressure_bar", "current_A"]
    y, *u = columns(folder, "pump_loop_skab.csv", wanted, ("experiment", experiment))
    return Series(Regression(2, intercept=True), y, np.column_stack(u))


def consumption(folder: Path) -> Series:
    """Quarterly change of consumption on income and unemployment."""
    y, *u = columns(folder, "us_consumption_change.csv", ["Consumption", "Income", "Unemployment"])
    return Series(ARX(1, (1, 1), nk=(0, 0), intercept=True), y, np.column_stack(u))


RECORDS: dict[str, Callable[[Path], Series]] = {
    "river": river,
    "building": building,
    "building_arx": building_arx,
    "gas_furnace": gas_furnace,
    "heat_exchanger": heat_exchanger,
    "gas_sensor": gas_sensor,
    "gas_sensor_arx": gas_sensor_arx,
    "pump_valve": lambda folder: pump(folder, "valve1_1"),
    "pump_rotor": lambda folder: pump(folder, "other_6"),
    "consumption": consumption,
}


def read(folder: Path) -> dict[str, Series]:
    """Every record that the folder or an installed package has."""
    found = {name: load(folder) for name, load in RECORDS.items()}
    for _, source in SOURCES:
        try:
            found |= {title: Series(one.model, one.y, one.u) for title, one in source()}
        except ImportError:
            continue
    return found


def regressors(series: Series) -> Array:
    """phi (T, n); NaN where it is not known."""
    return Record(series.model.bind(series.u.shape[1]), series.y, series.u).phi


def scored(series: Series, tracker: Tracker) -> dict[str, float]:
    """``rms`` of the one-step errors and mean ``log`` density, after the first samples.

    Filters that were given r = 1 have the noise variance of largest likelihood instead. No density is that of a
    standard deviation below a thousandth of the rms.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = track(series.model, tracker, series.y, series.u if series.u.shape[1] else None)
    e, s = series.y - run.prediction, np.asarray(run.innovation_std) ** 2
    n, T = regressors(series).shape[1], len(e)
    judged = np.isfinite(e) & np.isfinite(s) & (np.arange(T) >= min(max(50, 5 * n), T // 3))
    e, s = e[judged], s[judged]
    s = s * np.mean(e**2 / s) if isinstance(tracker, Kalman) else s
    s = np.maximum(s, 1e-6 * np.mean(e**2))
    log = -0.5 * np.mean(np.log(2.0 * np.pi * s) + e**2 / s)
    return {"rms": float(np.sqrt(np.mean(e**2))), "log": float(log), "samples": float(judged.sum())}


def best_fixed(series: Series) -> dict[str, float]:
    """The least rms and the largest log score of Kalman filters with one ratio of drift to noise, in hindsight."""
    c = np.maximum(np.nanmean(regressors(series) ** 2, axis=0), 1e-12)
    rows = [scored(series, Kalman(q=ratio / c, r=1.0)) for ratio in RATIOS]
    return {"rms": min(row["rms"] for row in rows), "log": max(row["log"] for row in rows)}


METHODS: dict[str, Callable[[Series], dict[str, float]]] = {
    "Kalman": best_fixed,
    "RLS .99": lambda series: scored(series, RLS(0.99)),
    "RLS 1": lambda series: scored(series, RLS(1.0)),
}

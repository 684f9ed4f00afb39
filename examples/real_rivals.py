"""`AdaptiveKalman` without a setting on eight real records, beside what one would otherwise do.

The second half of each record is scored, one step ahead, on the samples that every method could predict. RLS has the
forgetting factor, and NLMS (normalised least mean squares) the step, with the smallest error in the first half;
*constant LS* is RLS without forgetting, and *constant ARX* least squares on two lags of the output, the last value of
each input, and an intercept.

The records are not part of the project. The folder must contain, besides those of `real_records.py`,
heat_exchanger.csv (DaISy), pump_loop_skab.csv (SKAB), air_quality_sensors.csv (UCI) and us_consumption_change.csv
(fpp2).

Run: python examples/real_rivals.py FOLDER
"""

import sys
import warnings
from pathlib import Path

import numpy as np
from real_records import Case, building, building_arx, furnace, river
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, RLS, AdaptiveKalman, Regression, track
from driftfit.data import read_columns
from driftfit.judge.compare import persistence
from driftfit.run.result import root_mean_square

MEMORIES = 1.0 - 10.0 ** np.linspace(-3.5, -0.7, 15)
STEPS = 10.0 ** np.linspace(-2.5, 0.0, 11)


def exchanger(folder: Path) -> Case:
    """Outlet temperature of a heat exchanger (C) on its last two values and those of the flow."""
    data = read_columns(folder / "heat_exchanger.csv", ["temp_out_C", "flow"])
    y, u = data["temp_out_C"], data["flow"][:, None]
    return Case("heat exchanger", ARX(2, 2, inputs=["flow"], intercept=True), y, u, y, u)


def pump(folder: Path) -> Case:
    """Flow (l/min) on pressure (bar) and current (A), while the inlet valve closes."""
    rows = np.genfromtxt(folder / "pump_loop_skab.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    rows = rows[rows["experiment"] == "valve1_1"]
    y, u = rows["flow_lpm"], np.column_stack([rows["pressure_bar"], rows["current_A"]])
    return Case("pump", Regression(["pressure", "current"], intercept=True), y, u, y, u)


def gas_sensor(folder: Path) -> Case:
    """A metal-oxide sensor on benzene, temperature and humidity."""
    names = ["PT08_S4_NO2", "C6H6_GT", "T", "AH"]
    y, *inputs = read_columns(folder / "air_quality_sensors.csv", names).values()
    u = np.column_stack(inputs)
    return Case("gas sensor", Regression(["benzene", "T", "AH"], intercept=True), y, u, y, u)


def consumption(folder: Path) -> Case:
    """Change of consumption (%) on its last value, income and unemployment."""
    names = ["Consumption", "Income", "Unemployment"]
    y, *inputs = read_columns(folder / "us_consumption_change.csv", names).values()
    u = np.column_stack(inputs)
    return Case("consumption", ARX(1, 1, nk=0, inputs=["income", "unemployment"], intercept=True), y, u, y, u)


def regressors(case: Case) -> np.ndarray:
    """phi (T, n); NaN where a lag is missing."""
    model, ones = case.model, np.ones((len(case.y), 1))
    if isinstance(model, Regression):
        return np.hstack([case.u, ones]) if model.intercept else case.u
    assert isinstance(model, ARX)

    def lag(x: np.ndarray, k: int) -> np.ndarray:
        return np.concatenate([np.full(k, np.nan), x[: len(x) - k]])[:, None]

    past = [lag(case.y, k) for k in range(1, model.na + 1)]
    inputs = [lag(case.u[:, j], nk + k) for j, (nb, nk) in enumerate(model.lags) for k in range(nb)]
    return np.hstack([*past, *inputs, ones])


def nlms(phi: np.ndarray, y: np.ndarray, step: float) -> np.ndarray:
    """Innovations (T,) of theta <- theta + step phi e / (phi' phi), on columns in units of their root mean squares."""
    phi = phi / np.sqrt(np.nanmean(phi[: len(y) // 2] ** 2, axis=0))
    theta, e = np.zeros(phi.shape[1]), np.full(len(y), np.nan)
    for t in np.flatnonzero(np.isfinite(y) & np.isfinite(phi).all(axis=1)):
        e[t] = y[t] - phi[t] @ theta
        theta += step * phi[t] * e[t] / (phi[t] @ phi[t] + 1e-12)
    return e


def tuned(candidates: list[np.ndarray], half: int) -> np.ndarray:
    """The innovations with the smallest root mean square in the first half, after 50 samples."""
    return min(candidates, key=lambda e: float(np.sqrt(np.nanmean(e[min(50, half // 2) : half] ** 2))))


def main(folder: str) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False)
    names = ("persistence", "constant LS", "constant ARX", "NLMS", "RLS")
    for head in ("record", "AdaptiveKalman", "in band", *names, "over the best"):
        table.add_column(head, justify="left" if head == "record" else "right", no_wrap=True)
    for read in (river, building, building_arx, furnace, exchanger, pump, gas_sensor, consumption):
        case = read(Path(folder))
        half, phi = len(case.y) // 2, regressors(case)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run = track(case.model, AdaptiveKalman(), case.y, case.u)
            fixed = [track(case.model, RLS(forgetting), case.y, case.u).innovation for forgetting in (1.0, *MEMORIES)]
            arx = track(ARX(2, 1, intercept=True), RLS(1.0), case.level, case.inputs).innovation
        stepped = [nlms(phi, case.y, step) for step in STEPS]
        rivals = [case.level - persistence(case.level), fixed[0], arx, tuned(stepped, half), tuned(fixed, half)]
        scored = np.isfinite([run.innovation, *rivals]).all(axis=0) & (np.arange(len(case.y)) >= half)
        own, *others = (root_mean_square(e[scored]) for e in (run.innovation, *rivals))
        inside = np.mean(np.abs(run.innovation[scored]) < 1.96 * run.innovation_std[scored])
        numbers = (f"{own:.3g}", f"{inside:.2f}", *(f"{other:.3g}" for other in others), f"{own / min(others):.2f}")
        table.add_row(case.name, *numbers)
    Console(width=140).print(table)


if __name__ == "__main__":
    main(*sys.argv[1:2])

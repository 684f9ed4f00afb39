"""`AdaptiveKalman` without a setting on real records, two or more models of each, beside what one would otherwise do.

The second half of each record is scored, one step ahead, on the samples that every method could predict. RLS has the
forgetting factor, and NLMS (normalised least mean squares) the step, with the smallest error in the first half.
*In band* is the share of outputs within the 95 % band of `AdaptiveKalman`, *conformal* that of its band with
``output_band(conformal=True)``. *Constant LS* is RLS without forgetting, and *constant ARX* least squares on two lags
of the output, the last value of each input, and an intercept. The last columns are its error over that
of the best of them, the t of Diebold and Mariano (1995) for the claim that this best one is worse, and its error over
that of the best with the same regressors: all but the constant ARX.

The records are not part of the project. The folder must contain, besides those of `real_records.py`,
heat_exchanger.csv (DaISy), pump_loop_skab.csv (SKAB), air_quality_sensors.csv (UCI) and us_consumption_change.csv
(fpp2).

Run: python examples/real_rivals.py FOLDER
"""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from real_records import Case, building, building_arx, furnace, river
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, RLS, AdaptiveKalman, Regression, track
from driftfit.data import read_columns
from driftfit.judge.compare import persistence
from driftfit.judge.statistics.paired import paired
from driftfit.results import Track
from driftfit.run.result import root_mean_square

MEMORIES = 1.0 - 10.0 ** np.linspace(-3.5, -0.7, 15)
STEPS = 10.0 ** np.linspace(-2.5, 0.0, 11)


def exchanger(folder: Path) -> Case:
    """Outlet temperature of a heat exchanger (C) on its last two values and those of the flow."""
    data = read_columns(folder / "heat_exchanger.csv", ["temp_out_C", "flow"])
    y, u = data["temp_out_C"], data["flow"][:, None]
    return Case("heat exchanger", ARX(2, 2, inputs=["flow"], intercept=True), y, u, y, u)


def pump(experiment: str) -> Callable[[Path], Case]:
    """Flow (l/min) on pressure (bar) and current (A), while the inlet valve closes, or with an unbalanced rotor."""

    def read(folder: Path) -> Case:
        rows = np.genfromtxt(folder / "pump_loop_skab.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
        rows = rows[rows["experiment"] == experiment]
        y, u = rows["flow_lpm"], np.column_stack([rows["pressure_bar"], rows["current_A"]])
        model = Regression(["pressure", "current"], intercept=True)
        return Case(f"pump {experiment}", model, y, u, y, u)

    return read


def gas_sensor(column: str) -> Callable[[Path], Case]:
    """A metal-oxide sensor on benzene, temperature and humidity."""

    def read(folder: Path) -> Case:
        names = [column, "C6H6_GT", "T", "AH"]
        y, *inputs = read_columns(folder / "air_quality_sensors.csv", names).values()
        u = np.column_stack(inputs)
        name = "gas sensor " + column.split("_")[1]
        return Case(name, Regression(["benzene", "T", "AH"], intercept=True), y, u, y, u)

    return read


def consumption(folder: Path) -> Case:
    """Change of consumption (%) on its last value, income and unemployment."""
    names = ["Consumption", "Income", "Unemployment"]
    y, *inputs = read_columns(folder / "us_consumption_change.csv", names).values()
    u = np.column_stack(inputs)
    return Case("consumption", ARX(1, 1, nk=0, inputs=["income", "unemployment"], intercept=True), y, u, y, u)


def with_lags(read: Callable[[Path], Case], na: int, nb: int, nk: int = 0) -> Callable[[Path], Case]:
    """A record by another model: na lags of the level and nb values of each input."""

    def other(folder: Path) -> Case:
        case = read(folder)
        inputs = [f"u{j + 1}" for j in range(case.inputs.shape[1])]
        model = ARX(na, nb, nk=nk, inputs=inputs, intercept=True)
        return Case(f"{case.name}, ARX({na}, {nb})", model, case.level, case.inputs, case.level, case.inputs)

    return other


VALVE, ROTOR, SENSOR, OZONE = pump("valve1_1"), pump("other_6"), gas_sensor("PT08_S4_NO2"), gas_sensor("PT08_S5_O3")
CASES = (
    river, with_lags(river, 2, 3), building, building_arx, with_lags(building, 1, 1), furnace,
    with_lags(furnace, 1, 2, 3), exchanger, with_lags(exchanger, 1, 1, 1), VALVE, with_lags(VALVE, 1, 1),
    pump("valve1_5"), ROTOR, with_lags(ROTOR, 1, 1), SENSOR, with_lags(SENSOR, 1, 1), OZONE,
    consumption, with_lags(consumption, 2, 1),
)  # fmt: skip


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


def within(run: Track, conformal: bool, scored: np.ndarray) -> float:
    """Share of the outputs within the 95 % bands of their prediction."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        low, high = run.output_band(0.95, conformal=conformal)
    return float(np.mean(((low < run.y) & (run.y < high))[scored]))


def main(folder: str) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False)
    names = ("persistence", "constant LS", "constant ARX", "NLMS", "RLS")
    for head in ("record", "AdaptiveKalman", "in band", "conformal", *names, "over the best", "t", "same phi"):
        table.add_column(head, justify="left" if head == "record" else "right", no_wrap=True)
    for read in CASES:
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
        best = int(np.argmin(others))
        t = paired(names[best], rivals[best][scored], run.innovation[scored]).t
        inside = [within(run, conformal, scored) for conformal in (False, True)]
        alike = [error for name, error in zip(names, others, strict=True) if name != "constant ARX"]
        ratios = (f"{own / others[best]:.2f}", f"{t:.1f}", f"{own / min(alike):.2f}")
        numbers = (f"{own:.3g}", *(f"{share:.2f}" for share in inside), *(f"{other:.3g}" for other in others), *ratios)
        table.add_row(case.name, *numbers)
    Console(width=170).print(table)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(*sys.argv[1:2])

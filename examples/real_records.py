"""Three real records: a river, a heated building, and a gas furnace that hardly drifts.

The first half of each record determines the drift and the noise, once by likelihood and once by one-step error. The
second half is scored, one step ahead, and compared with simpler methods.

The records are not part of the project. The folder must contain river_leguer.csv (INRAE, an example catchment of GR4J),
building_heating.csv (from darkgreybox) and gas_furnace.csv (Box and Jenkins, series J).

Run: python examples/real_records.py FOLDER [FOLDER FOR FIGURES]
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, RLS, Kalman, Model, Regression, Track, track
from driftfit.data import read_columns
from driftfit.judge.compare import persistence
from driftfit.run.result import root_mean_square

RATIOS = (0.0, *(10.0 ** np.arange(-7.0, 2.1, 0.5)).tolist())
"""Variance that the drift of one sample adds to y through one parameter, in units of r; the same for all."""


@dataclass(frozen=True)
class Case:
    """A model of y (T,) on u (T, m); persistence and constant ARX predict from ``level`` and ``inputs``."""

    name: str
    model: Model
    y: np.ndarray
    u: np.ndarray
    level: np.ndarray
    inputs: np.ndarray


def river(folder: Path) -> Case:
    """Daily flow (mm) on the flow of the day before, and rain (mm) of the day and the day before."""
    data = read_columns(folder / "river_leguer.csv", ["flow_mm", "rain_mm"])
    y, u = data["flow_mm"], data["rain_mm"][:, None]
    return Case("river", ARX(1, 2, nk=0, inputs=["rain"], intercept=True), y, u, y, u)


def building(folder: Path) -> Case:
    """Change of the indoor temperature (K an hour) on differences to outdoors and heating water (K), and power (kW)."""
    names = ["indoor_C", "outdoor_C", "heating_water_C", "heat_power_kW"]
    indoor, outdoor, water, power = read_columns(folder / "building_heating.csv", names).values()
    u = np.column_stack([outdoor - indoor, water - indoor, power])
    model = Regression(["outdoors", "heating water", "power"])
    signals = np.column_stack([outdoor, water, power])
    return Case("building", model, np.diff(indoor), u[:-1], indoor[1:], signals[1:])


def building_arx(folder: Path) -> Case:
    """The same temperature by a model without physics: two lags of it, one of every input."""
    case = building(folder)
    model = ARX(2, 1, inputs=["outdoors", "heating water", "power"], intercept=True)
    return Case("building, ARX", model, case.level, case.inputs, case.level, case.inputs)


def furnace(folder: Path) -> Case:
    """CO2 in the off-gas (%) on its last two values, and the gas rate three and four samples before."""
    data = read_columns(folder / "gas_furnace.csv", ["co2", "gas_rate"])
    y, u = data["co2"], data["gas_rate"][:, None]
    return Case("gas furnace", ARX(2, 2, nk=3, inputs=["gas"], intercept=True), y, u, y, u)


def sizes(case: Case, half: int) -> np.ndarray:
    """Mean squares of the regressors in the first half, (n,)."""
    y, u = np.mean(case.y[:half] ** 2), np.mean(case.u[:half] ** 2, axis=0)
    if isinstance(case.model, Regression):
        return u
    assert isinstance(case.model, ARX)
    lagged = [u[j] for j, (nb, _) in enumerate(case.model.lags) for _ in range(nb)]
    return np.array([*[y] * case.model.na, *lagged, 1.0])


def fit(case: Case, ratio: float, half: int) -> Track:
    """The first half with q_i = ratio r / size_i and the maximum-likelihood r: the mean of e^2 / s at r = 1."""
    y, u, q = case.y[:half], case.u[:half], ratio / sizes(case, half)
    unit = track(case.model, Kalman(q=q, r=1.0), y, u)
    counted = unit.ok & np.isfinite(unit.innovation_std)
    r = float(np.mean((unit.innovation[counted] / unit.innovation_std[counted]) ** 2))
    return track(case.model, Kalman(q=q * r, r=r), y, u)


def likelihood(run: Track) -> float:
    return run.loglik


def error(run: Track) -> float:
    """Minus the one-step error after the start, so that more is better."""
    return -root_mean_square(run.innovation[max(50, 5 * run.model.n) :][run.ok[max(50, 5 * run.model.n) :]])


def rivals(case: Case) -> np.ndarray:
    """One-step errors of persistence, constant LS and constant ARX, (3, T)."""
    steady = track(case.model, RLS(1.0), case.y, case.u)
    arx = track(ARX(2, 1, intercept=True), RLS(1.0), case.level, case.inputs)
    return np.array([case.level - persistence(case.level), steady.innovation, arx.innovation])


def covered(run: Track, scored: np.ndarray) -> float:
    """Share of the outputs within the 95 % band of their prediction."""
    return float(np.mean(np.abs(run.innovation[scored]) < 1.96 * run.innovation_std[scored]))


def main(folder: str, figures: str | None = None) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False)
    heads = ("ratio", "gain", "tracked", "in band", "persistence", "constant LS", "constant ARX")
    for head in ("record", "chosen by", *heads):
        table.add_column(head, justify="right" if head in heads else "left", no_wrap=True)
    if figures:
        Path(figures).mkdir(parents=True, exist_ok=True)
    for read in (river, building, building_arx, furnace):
        case = read(Path(folder))
        half = len(case.y) // 2
        fits = {ratio: fit(case, ratio, half) for ratio in RATIOS}
        others = rivals(case)
        for judge in (likelihood, error):
            ratio = max(fits, key=lambda ratio: judge(fits[ratio]))
            run = track(case.model, fits[ratio].tracker, case.y, case.u)
            scored = np.isfinite([run.innovation, *others]).all(axis=0) & (np.arange(len(case.y)) >= half)
            errors = [root_mean_square(values[scored]) for values in others]
            numbers = [root_mean_square(run.innovation[scored]), covered(run, scored), *errors]
            end = "*" if ratio == RATIOS[-1] else ""
            gain = fits[ratio].loglik - fits[0.0].loglik
            settings = (case.name, judge.__name__, f"{ratio:.2g}{end}", f"{gain:.1f}")
            table.add_row(*settings, *(f"{number:.3f}" for number in numbers))
        if figures:
            run.plot().savefig(Path(figures) / f"{read.__name__}.png", dpi=78)
    Console(width=110).print(table)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(*sys.argv[1:3])

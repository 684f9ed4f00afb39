"""The tracking benchmark: every method on every scenario, for a regression and an ARX model, compared with the oracle.

For each scenario and model the scored runs have seeds 0, 1, .., and the runs for tuning settings 10000, 10001, .. .
Every method gets the same runs, so comparisons are paired: a ratio is that of the parameter errors of one run to
the oracle's, and its spread is given by the quartiles over runs. *Hindsight* is our Kalman filter with the setting of
its grid that is best on the scored runs themselves: no tuning of one fixed setting can be better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import near
from driftfit.run.result import root_mean_square
from lab import scenarios
from lab.bench.contestants import KALMAN, PEERS, Contestant, own, present
from lab.bench.oracle import oracle
from lab.bench.records import Outcome, Record, simulated
from lab.bench.scores import (
    Detection,
    Score,
    detect,
    parameter_error,
    pooled,
    predicted,
    score,
    surprise,
    threshold,
)

TUNING_SEED = 10_000
ORACLE, HINDSIGHT = "oracle", "Kalman, hindsight"
JUMPS, CALM = "sparse_jumps", "no_drift"


@dataclass(frozen=True)
class Size:
    """Size of the benchmark: scored runs, tuning runs, samples per run."""

    runs: int = 20
    tuning: int = 5
    T: int = 1000

    @property
    def note(self) -> str:
        """The same as words."""
        return f"{self.runs} scored runs, {self.tuning} tuning runs, {self.T} samples each"


QUICK = Size(1, 1, 400)


class Entry(NamedTuple):
    """A contestant with its setting: a row of a table."""

    name: str
    contestant: Contestant
    setting: Any
    c: Array
    scale: float

    def follow(self, record: Record) -> Outcome:
        """Run it; standard deviations in units of the record."""
        out = self.contestant.follow(record, self.setting, self.c)
        return Outcome(out.theta, out.std * self.scale, out.prediction, out.prediction_std * self.scale)


@dataclass
class Cell:
    """Results of one scenario and model: scores (runs,) by row, settings, and detections where there are jumps."""

    scenario: str
    kind: str
    scores: dict[str, list[Score]]
    settings: dict[str, Any]
    detections: dict[str, Detection]

    def values(self, row: str, what: str) -> Array:
        """One score of every run."""
        return np.array([getattr(one, what) for one in self.scores[row]])

    def ratio(self, row: str, what: str = "rmse", to: str = ORACLE) -> Array:
        """Run by run over another row's."""
        return self.values(row, what) / self.values(to, what)


def mean_squares(records: list[Record]) -> Array:
    """Mean square of every regressor."""
    return np.asarray(np.nanmean(np.concatenate([record.phi for record in records]) ** 2, axis=0))


def tuned(
    contestant: Contestant, records: list[Record], c: Array, criterion: Callable[[Record, Outcome], float]
) -> Entry:
    """The setting with the least mean square of a criterion over records, and the corresponding noise variance."""
    totals = [
        root_mean_square([criterion(record, contestant.follow(record, setting, c)) for record in records])
        for setting in contestant.grid
    ]
    return at_setting(contestant, contestant.grid[int(np.argmin(totals))], records, c)


def at_setting(contestant: Contestant, setting: Any, records: list[Record], c: Array, label: str = "tuned") -> Entry:
    """An entry with this setting, and r from the records where standard deviations are relative to it."""
    scale = 1.0
    if contestant.relative:
        squares = [_standardised(record, contestant.follow(record, setting, c)) for record in records]
        scale = float(np.sqrt(np.mean(np.concatenate(squares))))
    return Entry(f"{contestant.name}, {label}", contestant, setting, c, scale)


def _standardised(record: Record, outcome: Outcome) -> Array:
    """e^2 / s of the used samples past the first fifth."""
    z2 = ((record.y - outcome.prediction) / outcome.prediction_std) ** 2
    late = z2[len(z2) // 5 :]
    return np.asarray(late[np.isfinite(late)])


def entries(
    contestants: list[Contestant], records: list[Record], criterion: Callable[[Record, Outcome], float]
) -> list[Entry]:
    """Every contestant as it comes and tuned, as far as it has defaults and settings."""
    c = mean_squares(records)
    rows: list[Entry] = []
    for contestant in contestants:
        if contestant.default:
            label = f"{contestant.name}, default" if contestant.grid else contestant.name
            rows.append(Entry(label, contestant, None, c, 1.0))
        if contestant.tuned_as:
            teacher = next(row for row in rows if row.name == f"{contestant.tuned_as}, tuned")
            rows.append(teacher._replace(name=f"{contestant.name}, tuned", contestant=contestant))
        elif contestant.grid:
            rows.append(tuned(contestant, records, c, criterion))
    return rows


def contestants() -> tuple[list[Contestant], list[str]]:
    """Ours and the peers that are installed, and the names of the packages that are not."""
    there, absent = present(PEERS)
    return own() + there, absent


def run_cell(scenario: str, kind: str, size: Size) -> Cell:
    """Run one scenario with one model."""
    lessons = [simulated(scenario, kind, TUNING_SEED + i, size.T) for i in range(size.tuning)]
    records = [simulated(scenario, kind, i, size.T) for i in range(size.runs)]
    rows = entries(contestants()[0], lessons, parameter_error)
    rows.append(tuned(KALMAN, records, mean_squares(lessons), parameter_error)._replace(name=HINDSIGHT))
    outcomes = [{ORACLE: oracle(record)} | {row.name: row.follow(record) for row in rows} for record in records]
    scores: dict[str, list[Score]] = {name: [] for name in outcomes[0]}
    for record, by_row in zip(records, outcomes, strict=True):
        common = np.logical_and.reduce([predicted(record, outcome) for outcome in by_row.values()])
        for name, outcome in by_row.items():
            scores[name].append(score(record, outcome, common))
    cell = Cell(scenario, kind, scores, {row.name: row.setting for row in rows}, {})
    if scenario == JUMPS:
        calm = [simulated(CALM, kind, TUNING_SEED + i, size.T) for i in range(2 * size.tuning)]
        for row in rows:
            level = threshold([surprise(record, row.follow(record)) for record in calm])
            found = [
                detect(r, surprise(r, by_row[row.name]), level) for r, by_row in zip(records, outcomes, strict=True)
            ]
            cell.detections[row.name] = pooled(found)
    return cell


def chosen(names: list[str] | None) -> list[str]:
    """Names of scenarios, all of them by default; ValueError for one that does not exist."""
    known = scenarios.found()
    for name in names or []:
        if name not in known:
            raise ValueError(f"--scenario {name}: {near(name, known)}")
    return names or list(known)

"""Real records that are shipped with packages, one step ahead, compared with methods that do not track.

Settings are chosen by one-step error on the first half; the second half is scored, on the samples that every method
could predict. The true parameters are unknown, so there are no parameter errors; ``t`` is the paired t statistic of the
differences of squared errors to those of `AdaptiveKalman` (negative: smaller errors than its).

    US money demand   log real M1 on its lag, log real GDP, bill rate, intercept; quarters  (statsmodels macrodata)
    Danish money      log real M2 on its lag, log income, two rates, intercept; quarters (statsmodels danish_data)
    factor betas      excess return of an industry on market, size and value, intercept; months (linearmodels french)
    Nile              a level; years                                                            (statsmodels nile)
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.compare import persistence
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.result import root_mean_square
from driftfit.trackers.rls import RLS
from lab.bench.accuracy import contestants, entries
from lab.bench.computer import installed
from lab.bench.contestants import run
from lab.bench.records import Outcome, Record
from lab.bench.scores import coverage, predicted

REFERENCE = "AdaptiveKalman"


class Row(NamedTuple):
    """One contestant on one record: error, share within the one-step band, and t against the reference."""

    name: str
    setting: Any
    error: float
    y: float
    t: float


class Result(NamedTuple):
    """A record's rows, and how many samples were scored."""

    title: str
    samples: int
    rows: list[Row]


def us_money() -> list[tuple[str, Record]]:
    """Quarters 1959 to 2009."""
    data = import_module("statsmodels.datasets.macrodata").load_pandas().data
    money, income = np.log(data.m1.to_numpy() / data.cpi.to_numpy()), np.log(data.realgdp.to_numpy())
    u = np.column_stack([income - income[0], data.tbilrate.to_numpy()])
    return [("US money demand", _record(ARX(1, (1, 1), nk=0, intercept=True), money - money[0], u))]


def danish_money() -> list[tuple[str, Record]]:
    """Quarters 1974 to 1987."""
    data = import_module("statsmodels.datasets.danish_data").load_pandas().data
    u = data[["lry", "ibo", "ide"]].to_numpy(float)
    model = ARX(1, (1, 1, 1), nk=0, intercept=True)
    return [("Danish money demand", _record(model, data.lrm.to_numpy(float), u - [u[0, 0], 0.0, 0.0]))]


def factor_betas() -> list[tuple[str, Record]]:
    """Months 1949 to 2017, three industries, in per cent."""
    data = import_module("linearmodels.datasets.french").load()
    factors = 100.0 * data[["MktRF", "SMB", "HML"]].to_numpy(float)
    model = Regression(("market", "size", "value"), intercept=True)
    return [
        (f"factor betas of {name}", _record(model, 100.0 * (data[name] - data["RF"]).to_numpy(float), factors))
        for name in ("BusEq", "Utils", "Enrgy")
    ]


def nile() -> list[tuple[str, Record]]:
    """Years 1871 to 1970."""
    volume = import_module("statsmodels.datasets.nile").load_pandas().data.volume.to_numpy(float)
    return [("Nile", _record(Regression(0, intercept=True), volume, np.zeros((len(volume), 0))))]


SOURCES: tuple[tuple[str, Callable[[], list[tuple[str, Record]]]], ...] = (
    ("statsmodels", us_money), ("statsmodels", danish_money), ("linearmodels", factor_betas), ("statsmodels", nile),
)  # fmt: skip


def _record(model: Model, y: Array, u: Array) -> Record:
    return Record(model.bind(u.shape[1]), np.ascontiguousarray(y), np.ascontiguousarray(u))


def rivals(record: Record) -> dict[str, Outcome]:
    """Persistence, and constant least squares on ARX(2, 1 per input) with intercept."""
    unknown = np.full(len(record.y), np.nan)
    arx = ARX(2, 1 if record.u.shape[1] else 0, intercept=True).bind(record.u.shape[1])
    return {
        "persistence": Outcome(unknown[:, None], unknown[:, None], persistence(record.y), unknown),
        "constant ARX": run(RLS(1.0), Record(arx, record.y, record.u)),
    }


def one_step(record: Record, outcome: Outcome) -> float:
    """Root mean square one-step error past the start of a part that settings are chosen on."""
    e = (record.y - outcome.prediction)[start(record) :]
    return root_mean_square(e[~np.isnan(e)])


def start(record: Record) -> int:
    """Samples until estimates are evaluated: max(50, 5 n), or half of what there is."""
    return min(max(50, 5 * record.model.n), len(record.y) // 2)


def judge(title: str, record: Record) -> Result:
    """Choose on the first half, score the second."""
    half = len(record.y) // 2
    lesson = record.part(half)
    rows = entries(contestants()[0], [lesson], one_step)
    settings = {row.name: row.setting for row in rows}
    outcomes = {row.name: row.follow(record) for row in rows} | rivals(record)
    scored = np.arange(len(record.y)) >= half
    for outcome in outcomes.values():
        scored &= predicted(record, outcome)
    errors = {name: (record.y - outcome.prediction)[scored] for name, outcome in outcomes.items()}
    table = [
        Row(
            name, settings.get(name), root_mean_square(e), coverage(e, outcomes[name].prediction_std[scored]),
            paired_t(e, errors[REFERENCE]),
        )
        for name, e in errors.items()
    ]  # fmt: skip
    return Result(title, int(scored.sum()), table)


def paired_t(e: Array, reference: Array) -> float:
    """Mean over standard error of e^2 - reference^2; 0 for the reference itself."""
    d = e**2 - reference**2
    return float(np.mean(d) / (np.std(d, ddof=1) / np.sqrt(len(d)))) if np.any(d) else 0.0


def run_real() -> tuple[list[Result], list[str]]:
    """Every record whose package is installed, and the packages that are not."""
    results = [judge(title, record) for package, load in SOURCES if installed(package) for title, record in load()]
    return results, sorted({package for package, _ in SOURCES if not installed(package)})

"""The summary of a fleet: which series moved most, and by how much.

The path of a parameter counts after the start, that is after max(50, 5 n) samples (a third of a short record) and as
soon as the parameter is determined. With theta_0 its value there, a parameter has moved by

    max_t |theta_t - theta_0| / sqrt(var_t + var_0)

standard deviations, and a series by the largest of its parameters. Without a covariance the excursion
max_t |theta_t - theta_0| is given in units of its median over the fleet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.kernel import Array
from driftfit.judge.compare import persistence
from driftfit.readings.left_out import remarks_of
from driftfit.run.keyed_results import KeyedResults
from driftfit.run.result import Track, burn_in, root_mean_square
from driftfit.show.parts.text import Printed, counts, facts, key_text, table_of, together

SHOWN = 20


@dataclass(frozen=True)
class Unit:
    """One series: the parameter that moved most, by how many standard deviations, from and to which value.

    ``moved`` is NaN if no parameter was determined after the start. ``error`` is the root mean square one-step error
    after the start, and ``persistence`` that of repeating the last output, on the same samples.
    """

    key: Hashable
    samples: int
    used: int
    moved: float
    parameter: str
    start: float
    farthest: float
    last: float
    error: float
    persistence: float
    std: float = float("nan")
    """Standard deviation of ``last``, which decides how many digits are printed."""


@dataclass(frozen=True)
class FleetSummary(Printed):
    """What `Fleet.summary` returns: ``units``, sorted by how much they moved; printing it shows the first twenty."""

    model: str
    trackers: tuple[str, ...]
    units: tuple[Unit, ...]
    failed: dict[Hashable, str]
    dropped: dict[str, int]
    scaled: bool
    missing: dict[str, int] = field(default_factory=dict)
    left_out: tuple[tuple[str, str], ...] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        samples, used = sum(unit.samples for unit in self.units), sum(unit.used for unit in self.units)
        settings = self.trackers[0] if len(self.trackers) == 1 else f"{len(self.trackers)} different settings"
        pairs = [
            ("Model", self.model),
            ("Tracker", settings),
            ("Series", f"{len(self.units)}, {len(self.failed)} without a result"),
            ("Samples", f"{samples}, {used} used, {samples - used} skipped"),
        ]
        if self.dropped:
            pairs.append(("Rows left out", counts(self.dropped)))
        if self.missing:
            pairs.append(("Taken as missing", counts(self.missing)))
        pairs += self.left_out
        yield facts(*pairs)
        yield from self._ranking()
        for key, reason in list(self.failed.items())[:SHOWN]:
            yield Text(f" no result for {key_text(key)}: {reason}")

    def _ranking(self) -> RenderResult:
        what = "std" if self.scaled else "x median"
        heads = ("", "parameter", what, "start", "farthest", "last", "rms e", "persist.")
        table = table_of("Series by how much they moved", *heads, names=2)
        for unit in self.units[:SHOWN]:
            path = together(unit.start, unit.farthest, unit.last, std=unit.std)
            moved = f"{unit.moved:.1f}" if np.isfinite(unit.moved) else "-"
            errors = (f"{error:.4g}" for error in (unit.error, unit.persistence))
            table.add_row(Text(key_text(unit.key)), Text(unit.parameter), moved, *path, *errors)
        yield table
        if len(self.units) > SHOWN:
            yield Text(f" and {len(self.units) - SHOWN} that moved less", "dim")


def summarise(fleet: KeyedResults) -> FleetSummary:
    """Build the summary of results by key, all with the same number of parameters."""
    runs = list(fleet.values())
    paths = [_path(run) for run in runs]
    excursion = np.array([path.excursion for path in paths])
    scaled = all(tracker.covariance for tracker in {run.tracker for run in runs})
    moved = np.array([path.moved for path in paths]) if scaled else excursion / _median(excursion)
    units = [_unit(*each) for each in zip(fleet, runs, paths, moved, strict=True)]
    units.sort(key=lambda unit: -unit.moved if np.isfinite(unit.moved) else np.inf)
    trackers = tuple(dict.fromkeys(repr(run.tracker) for run in runs))
    missing: Counter[str] = Counter()
    for run in runs:
        missing.update(run.labels.missing)
    return FleetSummary(
        repr(fleet.model), trackers, tuple(units), dict(fleet.failed), fleet.dropped, scaled, dict(missing),
        remarks_of(run.left_out for run in runs),
    )  # fmt: skip


@dataclass(frozen=True)
class _Path:
    """The path of every parameter of one series after the start, (n,) each, and where the start ended."""

    begin: int
    start: Array
    farthest: Array
    excursion: Array
    moved: Array


def _path(run: Track) -> _Path:
    n, T = len(run.names), len(run)
    begin = min(burn_in(n), T // 3)
    theta, var = run.theta[begin:], run.var[begin:]
    known = np.isfinite(var) | (not run.tracker.covariance)
    first = (np.argmax(known, axis=0), np.arange(n))
    away = np.where(known, np.abs(theta - theta[first]), 0.0)
    most = np.argmax(away, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.where(known, away / np.sqrt(var + var[first]), 0.0)
    moved = np.where(known.any(axis=0), np.nanmax(np.where(away > 0.0, spread, 0.0), axis=0), np.nan)
    return _Path(begin, theta[first], theta[most, np.arange(n)], away.max(axis=0), moved)


def _median(excursion: Array) -> Array:
    """Median over the fleet, 1 where nothing moved."""
    median = np.median(excursion, axis=0)
    return np.where(median > 0.0, median, 1.0)


def _unit(key: Hashable, run: Track, path: _Path, moved: Array) -> Unit:
    i = int(np.argmax(np.where(np.isfinite(moved), moved, -1.0)))
    errors = np.stack([run.innovation, run.y - persistence(run.used_record.y)])[:, path.begin :]
    error, last = (root_mean_square(e) for e in errors[:, np.isfinite(errors).all(axis=0)])
    return Unit(
        key, len(run), int(run.ok.sum()), float(moved[i]), run.names[i], float(path.start[i]),
        float(path.farthest[i]), float(run.theta[-1, i]), error, last,
        float(run.std[-1, i]),
    )  # fmt: skip

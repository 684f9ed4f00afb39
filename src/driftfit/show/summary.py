"""Summaries: of a run, of a fleet, and what a notebook shows when a result is the value of a cell.

The summary of a run has its present parameters and a comparison with simpler methods, which costs three further runs.
The cell of a notebook has the parameters alone, so nothing is run for it. The summary of a fleet ranks series by how
much they moved. The path of a parameter counts after the start, that is after max(50, 5 n) samples (a third of a short
record) and as soon as the parameter is determined. With theta_0 its value there, a parameter has moved by

    max_t |theta_t - theta_0| / sqrt(var_t + var_0)

standard deviations, and a series by the largest of its parameters. Without a covariance the excursion
max_t |theta_t - theta_0| is given in units of its median over the fleet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.data.record import Labels
from driftfit.engine.kernel import Array
from driftfit.judge.compare import Comparison, compare, left_at_start, persistence
from driftfit.models.base import GAP
from driftfit.models.equation import Equation
from driftfit.models.state_space import StateSpace
from driftfit.readings.left_out import remarks_of
from driftfit.run.fleet import KeyedResults, Outputs
from driftfit.run.live.conformal import quantile
from driftfit.run.result import Track, burn_in, root_mean_square
from driftfit.show.text import (
    ByOutput,
    Printed,
    counts,
    digits,
    facts,
    html_of,
    key_text,
    shortened,
    table_of,
    together,
)
from driftfit.trackers.student import band_ratio
from driftfit.tune.inference import information

LEVEL_SPREADS = 3.0
"""Deviations from 0 from which on the level of an output calls for a constant."""
_RIVALS = ("tracked", "persistence", "constant LS", "constant ARX")


@dataclass(frozen=True)
class Row:
    """One parameter: its value, its 95 % band, and the range of its path after the start."""

    name: str
    theta: float
    std: float
    low: float
    high: float
    path_low: float
    path_high: float
    unit: str


@dataclass(frozen=True)
class Summary(Printed):
    """What `Track.summary` returns; printing it shows two tables."""

    model: str
    tracker: str
    samples: int
    used: int
    loglik: float
    aic: float
    bic: float
    burn: int
    rows: tuple[Row, ...]
    comparison: Comparison
    signals: str
    span: str
    dropped: str
    remarks: tuple[tuple[str, str], ...] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield facts(
            ("Model", self.model),
            ("Tracker", self.tracker),
            ("Signals", self.signals),
            ("Time", self.span),
            ("Samples", f"{self.samples}, {self.used} used, {self.samples - self.used} skipped"),
            ("Rows left out", self.dropped),
            ("Log-likelihood", self._likelihood),
            *self.remarks,
        )
        heads = ("theta", "std", "[0.025", "0.975]", "lowest", "highest")
        table = table_of("Parameters after the last sample", "", *heads)
        for row in self.rows:
            values = (row.theta, row.low, row.high, row.path_low, row.path_high)
            theta, *others = (digits(value, row.std) for value in values)
            table.add_row(Text(f"{row.name}  {row.unit}".strip()), theta, f"{row.std:.4g}", *others)
        yield table
        path = (
            f"range of the path after the first {self.burn} samples" if self.samples > self.burn else "the last values"
        )
        yield Text(f" lowest, highest: {path}", "dim")
        table = table_of("One-step prediction error, root mean square", *_RIVALS, names=0)
        c = self.comparison
        table.add_row(*(f"{value:.5g}" for value in (c.tracked, c.persistence, c.constant_ls, c.constant_arx)))
        yield table
        yield Text(f" {self._scored}", "dim")

    @property
    def _likelihood(self) -> str:
        return f"{self.loglik:.6g}" + (f", AIC {self.aic:.6g}, BIC {self.bic:.6g}" if self.used else "")

    @property
    def _scored(self) -> str:
        of = self.comparison
        which = f"after the first {self.burn} that all {'three' if of.samples and np.isnan(of.constant_ls) else 'four'}"
        if of.samples:
            return f"on the {of.samples} samples {which} could predict"
        return f"the record has no sample {which} could predict: nothing to compare"


def summarise(run: Track) -> Summary:
    """Build the summary of a run; of outputs that share one theta that of all rows."""
    remarks, run = _of_each_output(run), run.rows
    burn = left_at_start(run)
    low, high = run.band(LEVEL)
    path = run.theta[burn:] if len(run) > burn else run.theta[-1:]
    rows = tuple(
        Row(
            name, float(run.theta[-1, i]), float(run.std[-1, i]), float(low[-1, i]), float(high[-1, i]),
            float(path[:, i].min()), float(path[:, i].max()), run.units[i],
        )
        for i, name in enumerate(run.names)
    )  # fmt: skip
    span = " to ".join(run.time_text(t) for t in (0, -1)) if run.timed else ""
    return Summary(
        repr(run.model), shortened(repr(run.tracker)), len(run), int(np.sum(run.ok)), run.loglik,
        information(run, 0, 2.0), information(run, 0), burn, rows, compare(run),
        _signals(run.labels) if run.labels.u or run.labels.y != "y" else "", span, counts(run.labels.dropped),
        (
            *remarks, *_missing(run), *_undefined(run), *_level(run), *_gate(run), *not_learned(run),
            *run.tracker.remarks(run),
        ),
    )  # fmt: skip


def summarise_outputs(run: Outputs) -> ByOutput[Summary]:
    """The summary of each output with a separate theta, with the model and the signals of the joint run."""
    model, labels = repr(run.model), run.labels
    return ByOutput({
        name: replace(summarise(run[name]), model=model, signals=_signals(replace(labels, y=name)) if labels.u else "")
        for name in run.outputs
    })  # fmt: skip


def _of_each_output(run: Track) -> tuple[tuple[str, str], ...]:
    """The one-step error of each of the outputs that share one theta, after the start."""
    if run.rows_per_instant == 1:
        return ()
    kept = run.innovation[burn_in(len(run.names)) :]
    errors = (root_mean_square(e[np.isfinite(e)]) for e in kept.T)
    text = ", ".join(f"{name} {error:.5g}" for name, error in zip(run.outputs, errors, strict=True))
    return ("Rows", f"{len(run.outputs)} of each sample"), ("RMS error of", text)


def _signals(labels: Labels) -> str:
    """Names of the signals with their units."""
    named = [f"{name} ({labels.units[name]})" if name in labels.units else name for name in (labels.y, *labels.u)]
    return f"{named[0]} from {', '.join(named[1:])}" if labels.u else named[0]


def _gate(run: Track) -> tuple[tuple[str, str], ...]:
    """What the gate left out, a line for each reason, and the step of a coarse meter, where gate or tracker looked for
    it.
    """
    left, floor = remarks_of(run.left_out), float(run.state["floor"])
    if floor > 0.0:
        step = f"steps of {np.sqrt(12.0 * floor):.4g}, whose rounding has a variance of {floor:.3g}"
        left = (*left, ("Resolution", step))
    return left or (() if run.program.gate is None else (("Gate", "nothing left out"),))


def _missing(run: Track) -> tuple[tuple[str, str], ...]:
    """Readings that were counted as missing although they contain a number."""
    return (("Taken as missing", counts(run.labels.missing)),) if run.labels.missing else ()


def _undefined(run: Track) -> tuple[tuple[str, str], ...]:
    """Samples with all they need, at which equations have no finite value at the estimate."""
    model = run.model
    if not isinstance(model, (Equation, StateSpace)):
        return ()
    known = np.isfinite(run.y) & np.isfinite(run.u).all(axis=1) & (run.record.known.interval <= GAP)
    whole = np.convolve(~known, np.ones(model.reach + 1))[: len(run)] == 0.0
    count = int(np.sum((whole & np.isnan(run.prediction))[model.reach :]))
    why = (
        f"{count} samples at which the equation is not finite at the estimate (exp, or / by 0): begin elsewhere, start="
    )
    return (("No value", why),) if count else ()


def not_learned(run: Track) -> tuple[tuple[str, str], ...]:
    """Parameters that the record has not determined, with the reason."""
    names = [name for name, std in zip(run.names, run.std[-1], strict=True) if np.isinf(std)]
    why = "never varied separately from the others" if run.ok.any() else "no sample could be used"
    if run.ok.any() and np.isnan(run.state.get("scale", 0.0)) and run.state.get("rank") == len(run.names):
        why = "constants explain every output without error, so the noise is unknown"
    return (("Not learned", f"{', '.join(names)}: {why}; std is inf"),) if names else ()


def _level(run: Track) -> tuple[tuple[str, str], ...]:
    """What is missing if the output varies about a level that neither the model nor an input about its own explains."""
    setting = run.model.constant
    if not setting or getattr(run.model, setting):
        return ()
    (level, *others), (spread, *others_spread) = zip(*(_middle(x) for x in (run.y, *run.u.T)), strict=True)
    explained = any(not abs(x) <= wide for x, wide in zip(others, others_spread, strict=True))
    if explained or not abs(level) > LEVEL_SPREADS * spread > 0.0:
        return ()
    inputs = ", the inputs about 0" if others else ""
    return ((f"No {setting}", f"y varies by {spread:.3g} about {level:.4g}{inputs}: {setting}=True is missing"),)


def _middle(x: Array) -> tuple[float, float]:
    """The median, and the usual distance from it; their mean and deviation if most values are equal."""
    known = x[np.isfinite(x)]
    if not len(known):
        return 0.0, 0.0
    middle = float(np.median(known))
    spread = float(np.median(np.abs(known - middle)))
    return (middle, spread / 0.6745) if spread > 0.0 else (float(np.mean(known)), float(np.std(known)))


ROWS_SHOWN = 20
"""Rows of the table in a notebook, and series in the summary of a fleet."""
LEVEL = 0.95


def cell_of(result: Track | KeyedResults) -> str:
    """One line about the result and a table, as HTML: every parameter of every lane."""
    lanes = [("", result)] if isinstance(result, Track) else [(key_text(key), run) for key, run in result.items()]
    rows, count = (row for lane in lanes for row in _own(*lane)), sum(len(run.names) for _, run in lanes)
    table = table_of("Parameters after the last sample", "", "", "theta", "std", "[0.025", "0.975]", names=2)
    for key, name, theta, std, half in islice(rows, ROWS_SHOWN):
        band = (digits(value, std) for value in (theta - half, theta + half))
        table.add_row(Text(key), Text(name), digits(theta, std), f"{std:.4g}", *band)
    more = [Text(f" and {count - ROWS_SHOWN} more rows")] if count > ROWS_SHOWN else []
    return html_of(Text(repr(result)), table, *more)


def _own(key: str, run: Track) -> Iterator[tuple[str, str, float, float, float]]:
    """(key, name, theta, std, half the band) of every parameter of a lane."""
    # the lane's own end, which is cheap; a whole path of standard deviations is not
    theta, std = run.theta[-1], np.sqrt(run.var[-1])
    half = quantile(LEVEL) * std * (band_ratio(run.state["count"], LEVEL) if run.tracker.learns_noise else 1.0)
    for i, name in enumerate(run.names):
        yield key if i == 0 else "", name, float(theta[i]), float(std[i]), float(half[i])


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
        yield facts(
            ("Model", self.model),
            ("Tracker", settings),
            ("Series", f"{len(self.units)}, {len(self.failed)} without a result"),
            ("Samples", f"{samples}, {used} used, {samples - used} skipped"),
            ("Rows left out", counts(self.dropped)),
            ("Taken as missing", counts(self.missing)),
            *self.left_out,
        )
        what = "std" if self.scaled else "x median"
        heads = ("", "parameter", what, "start", "farthest", "last", "rms e", "persist.")
        table = table_of("Series by how much they moved", *heads, names=2)
        for unit in self.units[:ROWS_SHOWN]:
            path = together(unit.start, unit.farthest, unit.last, std=unit.std)
            moved = f"{unit.moved:.1f}" if np.isfinite(unit.moved) else "-"
            errors = (f"{error:.4g}" for error in (unit.error, unit.persistence))
            table.add_row(Text(key_text(unit.key)), Text(unit.parameter), moved, *path, *errors)
        yield table
        if len(self.units) > ROWS_SHOWN:
            yield Text(f" and {len(self.units) - ROWS_SHOWN} that moved less", "dim")
        for key, reason in list(self.failed.items())[:ROWS_SHOWN]:
            yield Text(f" no result for {key_text(key)}: {reason}")


def summarise_fleet(fleet: KeyedResults) -> FleetSummary:
    """Build the summary of results by key, all with the same number of parameters."""
    runs = list(fleet.values())
    paths = [_path(run) for run in runs]
    excursion = np.array([path.excursion for path in paths])
    scaled = all(tracker.covariance for tracker in {run.tracker for run in runs})
    median = np.median(excursion, axis=0) if runs else 1.0
    moved = np.array([path.moved for path in paths]) if scaled else excursion / np.where(median > 0.0, median, 1.0)
    units = [_unit(*each) for each in zip(fleet, runs, paths, moved, strict=True)]
    units.sort(key=lambda unit: -unit.moved if np.isfinite(unit.moved) else np.inf)
    trackers = tuple(dict.fromkeys(repr(run.tracker) for run in runs))
    missing = sum((Counter(run.labels.missing) for run in runs), Counter[str]())
    return FleetSummary(
        repr(fleet.model), trackers, tuple(units), dict(fleet.failed), fleet.dropped, scaled, dict(missing),
        remarks_of({k: run.left_out for k, run in enumerate(runs)}),
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


def _unit(key: Hashable, run: Track, path: _Path, moved: Array) -> Unit:
    i = int(np.argmax(np.where(np.isfinite(moved), moved, -1.0)))
    errors = np.stack([run.innovation, run.y - persistence(run.used_record.y)])[:, path.begin :]
    error, last = (root_mean_square(e) for e in errors[:, np.isfinite(errors).all(axis=0)])
    return Unit(
        key, len(run), int(run.ok.sum()), float(moved[i]), run.names[i], float(path.start[i]),
        float(path.farthest[i]), float(run.theta[-1, i]), error, last,
        float(run.std[-1, i]),
    )  # fmt: skip

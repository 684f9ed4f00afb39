"""The summary of a run: the present parameters, and a comparison with simpler methods."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.data.record import Labels
from driftfit.engine.kernel import Array
from driftfit.judge.compare import Comparison, compare, left_at_start
from driftfit.models.base import GAP
from driftfit.models.equation import Equation
from driftfit.models.state_space import StateSpace
from driftfit.readings.remarks import counts as counts_of
from driftfit.readings.remarks import floor_remark
from driftfit.readings.remarks import remarks as remarks_of
from driftfit.run.outputs import Outputs
from driftfit.run.result import Track, burn_in, root_mean_square
from driftfit.show.parts.by_output import ByOutput
from driftfit.show.parts.text import Printed, counts, digits, facts, shortened, table_of

HIGH = 3.0
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
            *([("Signals", self.signals)] if self.signals else []),
            *([("Time", self.span)] if self.span else []),
            ("Samples", f"{self.samples}, {self.used} used, {self.samples - self.used} skipped"),
            *([("Rows left out", self.dropped)] if self.dropped else []),
            ("Log-likelihood", f"{self.loglik:.6g}"),
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
    low, high = run.band(0.95)
    path = run.theta[burn:] if len(run) > burn else run.theta[-1:]
    rows = tuple(
        Row(
            name, float(run.theta[-1, i]), float(run.std[-1, i]), float(low[-1, i]), float(high[-1, i]),
            float(path[:, i].min()), float(path[:, i].max()), run.units[i],
        )
        for i, name in enumerate(run.names)
    )  # fmt: skip
    tracker = shortened(repr(run.tracker))
    return Summary(
        repr(run.model), tracker, len(run), int(np.sum(run.ok)), run.loglik, burn, rows, compare(run),
        _signals(run.labels) if run.labels.u or run.labels.y != "y" else "", _span(run), counts(run.labels.dropped),
        (*remarks, *_missing(run), *_undefined(run), *_level(run), *_gate(run), *run.tracker.remarks(run)),
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
    """What the gate left out, a line for each reason; nothing without a gate."""
    left = remarks_of(counts_of(run.left_out.code))
    if run.program.gate is None:
        return left
    return (*left, *floor_remark(float(run.state["floor"]))) or (("Gate", "nothing left out"),)


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


def _level(run: Track) -> tuple[tuple[str, str], ...]:
    """What is missing if the output varies about a level that neither the model nor an input about its own explains."""
    setting = run.model.constant
    if not setting or getattr(run.model, setting):
        return ()
    (level, *others), (spread, *others_spread) = zip(*(_middle(x) for x in (run.y, *run.u.T)), strict=True)
    explained = any(not abs(x) <= wide for x, wide in zip(others, others_spread, strict=True))
    if explained or not abs(level) > HIGH * spread > 0.0:
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


def _span(run: Track) -> str:
    """First and last time."""
    if not run.timed:
        return ""
    first, last = (run.time_text(t) for t in (0, -1))
    return f"{first} to {last}"

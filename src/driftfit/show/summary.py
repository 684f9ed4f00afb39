"""The summary of a run: the present parameters, and a comparison with simpler methods."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.jupyter import JupyterMixin
from rich.table import Column, Table
from rich.text import Text

from driftfit.judge.compare import Comparison, compare

if TYPE_CHECKING:
    from driftfit.run.result import Track

WIDTH = 96

_RIVALS = ("tracked", "persistence", "constant LS", "constant ARX")


def printed(*parts: Any) -> str:
    """What a console of `WIDTH` columns shows, as plain text, the same wherever Python runs.

    By default rich sends output to the display of a notebook, and takes colours and widths from the environment.
    """
    text = StringIO()
    console = Console(
        file=text, width=WIDTH, height=100, color_system=None, force_jupyter=False, force_terminal=False,
        legacy_windows=False,
    )  # fmt: skip
    console.print(*parts)
    return text.getvalue()


class Printed(JupyterMixin):
    """A result that rich draws: ``str`` returns it as plain text, and a notebook shows it as the value of a cell."""

    def __str__(self) -> str:
        return printed(self)


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
            cells = (row.theta, row.std, row.low, row.high, row.path_low, row.path_high)
            table.add_row(Text(f"{row.name}  {row.unit}".strip()), *(f"{value:.4g}" for value in cells))
        yield table
        yield Text(f" lowest, highest: range of the path after the first {self.burn} samples", "dim")
        table = table_of("One-step prediction error, root mean square", *_RIVALS, names=0)
        c = self.comparison
        table.add_row(*(f"{value:.5g}" for value in (c.tracked, c.persistence, c.constant_ls, c.constant_arx)))
        yield table
        yield Text(f" {self._scored}", "dim")

    @property
    def _scored(self) -> str:
        if self.comparison.samples:
            return f"on the {self.comparison.samples} samples after the first {self.burn} that all four could predict"
        return f"the record has no sample after the first {self.burn} that all four could predict: nothing to compare"


def summarise(run: Track) -> Summary:
    """Build the summary of a run."""
    burn = max(50, 5 * run.model.n)
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
        _signals(run), _span(run), counts(run.labels.dropped), (*_missing(run), *run.tracker.remarks(run)),
    )  # fmt: skip


def _signals(run: Track) -> str:
    """Names of the signals with their units; empty where they have none."""
    labels = run.labels
    if not labels.u and labels.y == "y":
        return ""
    named = [f"{name} ({labels.units[name]})" if name in labels.units else name for name in (labels.y, *labels.u)]
    return f"{named[0]} from {', '.join(named[1:])}" if labels.u else named[0]


def _missing(run: Track) -> tuple[tuple[str, str], ...]:
    """Readings that were counted as missing although they contain a number."""
    return (("Taken as missing", counts(run.labels.missing)),) if run.labels.missing else ()


def _span(run: Track) -> str:
    """First and last time."""
    if run._time is None:
        return ""
    first, last = (run.time_text(t) for t in (0, -1))
    return f"{first} to {last}"


def key_text(key: Hashable) -> str:
    """The key of a series as text; a key of several columns has no brackets."""
    return ", ".join(map(str, key)) if isinstance(key, tuple) else str(key)


def counts(dropped: Mapping[str, int]) -> str:
    """Counts by reason, as text."""
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items())


def shortened(text: str) -> str:
    """Round numbers of more than six digits to six."""
    return re.sub(r"\d\.\d{6,}(e-?\d+)?", lambda found: f"{float(found[0]):.6g}", text)


def facts(*pairs: tuple[str, str]) -> Table:
    """Names and values side by side, as plain text, since b1[flow] is not markup."""
    table = Table.grid(padding=(0, 2), pad_edge=True)
    for name, value in pairs:
        table.add_row(Text(name, "bold"), Text(value))
    return table


SHORT = 10
"""A cell of at most this many characters stays on one line: numbers, and p-values such as < 0.0001."""


class Numbers(Table):
    """A table no wider than `WIDTH` or the terminal, in which nothing is cut off: long text is wrapped at blanks."""

    def add_row(self, *cells: Any, **options: Any) -> None:
        """Add a row; every column is at least as wide as its longest word."""
        super().add_row(*cells, **options)
        for column, cell in zip(self.columns, cells, strict=False):
            _widen(column, str(cell))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        return super().__rich_console__(console, options.update(max_width=min(WIDTH, options.max_width)))


def _widen(column: Column, text: str) -> None:
    words = [text] if len(text) <= SHORT else text.split()
    column.min_width = max(column.min_width or 0, *map(cell_len, words), 0)


def table_of(title: str, *heads: str, names: int = 1) -> Table:
    """A table of numbers over the full width; the first ``names`` columns are left-aligned, numbers right-aligned."""
    table = Numbers(
        title=f"\n {title}", title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_edge=False, expand=True
    )
    for place, head in enumerate(heads):
        table.add_column(Text(head), justify="left" if place < names else "right", overflow="fold")
        _widen(table.columns[-1], head)
    return table

"""Text of results: tables no wider than `WIDTH`, the same on a terminal, in a file and in a notebook."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from copy import copy
from io import StringIO
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.jupyter import JupyterMixin
from rich.table import Column, Table
from rich.text import Text

from driftfit.engine.kernel import Array

WIDTH = 96


def _console(parts: tuple[Any, ...], **options: Any) -> Console:
    """A console of `WIDTH` columns with some output, the same wherever Python runs.

    By default rich sends output to the display of a notebook, and takes colours and widths from the environment.
    """
    fixed: dict[str, Any] = dict.fromkeys(("force_jupyter", "force_terminal", "legacy_windows"), False)
    console = Console(file=StringIO(), width=WIDTH, height=100, **fixed, **options)
    console.print(*parts, crop=False)
    return console


def printed(*parts: Any) -> str:
    """The output of a console as plain text."""
    text = _console(parts, color_system=None).file
    assert isinstance(text, StringIO)
    return text.getvalue()


def html_of(*parts: Any) -> str:
    """The same text as HTML, with its bold and dim letters."""
    console = _console(parts, record=True)
    style = "white-space:pre;overflow-x:auto;line-height:normal;font-family:Menlo,Consolas,monospace"
    return console.export_html(inline_styles=True, code_format=f'<pre style="{style}">{{code}}</pre>')


class Printed(JupyterMixin):
    """A result that rich draws: ``str`` returns it as plain text, and a notebook shows it as the value of a cell.

    So does a prompt: a dataclass would write out every field, a megabyte for the verdict of a thousand series.
    """

    def __init_subclass__(cls) -> None:
        cls.__repr__ = Printed.__repr__  # type: ignore[method-assign]  # a dataclass keeps a method of its class

    def __repr__(self) -> str:
        return str(self).strip("\n")

    def __str__(self) -> str:
        return printed(self)

    def _repr_html_(self) -> str:
        """What notebooks ask for that do not ask rich."""
        return html_of(self)


Kind = TypeVar("Kind", bound=type)


def printing(kind: Kind) -> Kind:
    """Let a named tuple, which cannot inherit, show itself as `Printed` does."""
    for name in ("__repr__", "__str__", "_repr_html_"):
        setattr(kind, name, vars(Printed)[name])
    return kind


def key_text(key: Hashable) -> str:
    """The key of a series as text; a key of several columns has no brackets."""
    return ", ".join(map(str, key)) if isinstance(key, tuple) else str(key)


def counts(dropped: Mapping[str, int]) -> str:
    """Counts by reason, as text."""
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items())


def shortened(text: str) -> str:
    """Round numbers of more than six digits to six."""
    return re.sub(r"\d\.\d{6,}(e-?\d+)?", lambda found: f"{float(found[0]):.6g}", text)


def digits(value: float, std: float, least: int = 4) -> str:
    """A number with ``least`` significant digits, or with more if its standard deviation is below the last of them.

    A price of 29998.6 +- 0.8 would otherwise read 3e+04, as would both ends of its band.
    """
    known = 0.0 < std < np.inf and 0.0 < abs(value) < np.inf
    places = int(np.floor(np.log10(abs(value))) - np.floor(np.log10(std))) + 1 if known else least
    return f"{value:.{min(max(places, least), 15)}g}"


def together(*values: float, std: float = float("nan"), least: int = 4) -> tuple[str, ...]:
    """Numbers that are compared with each other, so that a difference is seen where there is one.

    Each is known to ``std``, or, where that is not known, to the smallest difference of two of them, and a number below
    a million has all digits before its point.
    """
    known = np.unique([value for value in values if np.isfinite(value)])
    gaps = np.diff(known)
    gap = float(np.min(gaps[gaps > 1e-7 * np.abs(known).max(initial=0.0)], initial=np.inf))
    finest = std if 0.0 < std < np.inf else gap
    whole = (len(f"{abs(value):.0f}") if abs(value) < 1e6 else 0 for value in values)
    return tuple(digits(value, finest, max(least, n)) for value, n in zip(values, whole, strict=True))


def facts(*pairs: tuple[str, str]) -> Table:
    """Names and values side by side, as plain text, since b1[flow] is not markup; what is empty is left out."""
    table = Table.grid(padding=(0, 2), pad_edge=True)
    for name, value in pairs:
        if value:
            table.add_row(Text(name, "bold"), Text(value))
    return table


UNWRAPPED = 10
"""A cell of at most this many characters stays on one line: numbers, and p-values such as < 0.0001."""


BETWEEN = 3
"""Blanks between two columns of a table."""


class Numbers(Table):
    """A table no wider than `WIDTH` or the terminal, in which nothing is cut off: long text is wrapped at blanks.

    A table of more columns continues below, ``group`` columns of numbers always side by side.
    """

    group: int = 1

    def add_row(self, *cells: Any, **options: Any) -> None:
        """Add a row; every column is at least as wide as its longest word."""
        super().add_row(*cells, **options)
        for column, cell in zip(self.columns, cells, strict=False):
            _widen(column, str(cell))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = min(WIDTH, options.max_width)
        for part in self._parts(width):
            yield from super(Numbers, part).__rich_console__(console, options.update(max_width=width))

    def _parts(self, width: int) -> list[Numbers]:
        """The table itself, or tables below each other, with the names in each, where its columns need more room."""
        names = next((i for i, column in enumerate(self.columns) if column.justify != "left"), 0)
        edges = [0, *range((len(self.columns) - names) % self.group, len(self.columns) - names + 1, self.group)]
        needs = [(column.min_width or 0) + BETWEEN for column in self.columns]
        rows: list[list[Column]] = [[]]
        left = room = width + 1 - sum(needs[:names])
        for a, b in pairwise(names + edge for edge in edges):
            if sum(needs[a:b]) > left and rows[-1]:
                rows.append([])
                left = room
            rows[-1] += self.columns[a:b]
            left -= sum(needs[a:b])
        parts = [copy(self) for _ in rows]
        for part, columns in zip(parts, rows, strict=True):
            part.columns = [*self.columns[:names], *columns]
            part.title = self.title if part is parts[0] else " "
        return parts


def _widen(column: Column, text: str) -> None:
    words = [text] if len(text) <= UNWRAPPED else text.split()
    column.min_width = max(column.min_width or 0, *map(cell_len, words), 0)


def some_rows(count: int, most: int = 20) -> Array:
    """The rows of a table of ``count``: at most ``most``, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def table_of(title: str, *heads: str, names: int = 1, group: int = 1) -> Table:
    """A table of numbers over the full width; the first ``names`` columns are left-aligned, numbers right-aligned."""
    table = Numbers(
        title=f"\n {title}", title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_edge=False, expand=True
    )
    table.group = group
    for place, head in enumerate(heads):
        table.add_column(Text(head), justify="left" if place < names else "right", overflow="fold")
        _widen(table.columns[-1], head)
    return table


def path_table(title: str, names: Sequence[str], value: Array, std: Array, axis: Sequence[Any] | None = None) -> Table:
    """At most 20 rows of values (N, k) with their standard deviations, which ``axis`` names, or numbers from 0."""
    rows = some_rows(len(value))
    heads = (head for name in names for head in (name, "+-"))
    shown = f", {len(rows)} of {len(value)} rows" if len(value) > len(rows) else ""
    table = table_of(f"{title}{shown}", "", *heads, group=2)
    for i in rows:
        cells = ((digits(x, s), "" if np.isnan(s) else f"{s:.3g}") for x, s in zip(value[i], std[i], strict=True))
        table.add_row(Text(str(i if axis is None else axis[i])), *(cell for pair in cells for cell in pair))
    return table


Result = TypeVar("Result")


class ByOutput(Printed, Mapping[str, Result]):
    """What a verb found for each output of a record, by name; printing it shows one after the other."""

    def __init__(self, results: Mapping[str, Result]) -> None:
        self._results = dict(results)

    def __getitem__(self, output: str) -> Result:
        return self._results[output]

    def __iter__(self) -> Iterator[str]:
        return iter(self._results)

    def __len__(self) -> int:
        return len(self._results)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for place, (name, one) in enumerate(self.items()):
            yield Text(f"\n{name}" if place else name, "bold")
            yield one if hasattr(one, "__rich_console__") else Text(repr(one))

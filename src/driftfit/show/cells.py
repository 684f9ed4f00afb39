"""What a notebook shows when a result is the value of a cell: what it is, and its parameters after the last sample.

Nothing is run for it, unlike for a summary, whose comparisons cost three further runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from rich.text import Text

from driftfit.run.keyed_results import KeyedResults
from driftfit.run.live.conformal import quantile
from driftfit.run.result import Track
from driftfit.show.parts.text import digits, html_of, key_text, table_of
from driftfit.trackers.student import wider

SHOWN = 20
"""Rows of the table."""
LEVEL = 0.95

Row = tuple[str, str, float, float, float]


def cell_of(result: Track | KeyedResults) -> str:
    """One line about the result and a table, as HTML."""
    rows, count = _rows(result)
    table = table_of("Parameters after the last sample", "", "", "theta", "std", "[0.025", "0.975]", names=2)
    for key, name, theta, std, half in islice(rows, SHOWN):
        band = (digits(value, std) for value in (theta - half, theta + half))
        table.add_row(Text(key), Text(name), digits(theta, std), f"{std:.4g}", *band)
    more = [Text(f" and {count - SHOWN} more rows")] if count > SHOWN else []
    return html_of(Text(repr(result)), table, *more)


def _rows(result: Track | KeyedResults) -> tuple[Iterator[Row], int]:
    """(key, name, theta, std, half the band) of every parameter of every lane, and how many there are."""
    if isinstance(result, KeyedResults):
        lanes = ((key_text(key), run) for key, run in result.items())
        return (row for key, run in lanes for row in _own(key, run)), sum(len(run.names) for run in result.values())
    return _own("", result), len(result.names)


def _own(key: str, run: Track) -> Iterator[Row]:
    # the lane's own end, which is cheap; a whole path of standard deviations is not
    theta, std = run.theta[-1], np.sqrt(run.var[-1])
    half = quantile(LEVEL) * std * (wider(run.state["count"], LEVEL) if run.tracker.learns_noise else 1.0)
    for i, name in enumerate(run.names):
        yield key if i == 0 else "", name, float(theta[i]), float(std[i]), float(half[i])

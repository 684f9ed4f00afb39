"""Summaries of records with several outputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.run.outputs import Outputs
from driftfit.run.result import burn_in, root_mean_square
from driftfit.run.shared_outputs import Shared
from driftfit.show.parts.text import Printed, table_of
from driftfit.show.summary import Summary, summarise


@dataclass(frozen=True)
class OutputsSummary(Printed):
    """What `Outputs.summary` returns: the `Summary` of each output, by name; printing it shows them all."""

    of: Mapping[str, Summary]

    def __getitem__(self, output: str) -> Summary:
        return self.of[output]

    def __iter__(self) -> Iterator[str]:
        return iter(self.of)

    def __len__(self) -> int:
        return len(self.of)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for place, (name, summary) in enumerate(self.of.items()):
            yield Text(f"\n{name}" if place else name, "bold")
            yield summary


@dataclass(frozen=True)
class SharedSummary(Printed):
    """What `Shared.summary` returns: ``rows`` of (name, theta, std, low, high), and root mean square errors.

    ``errors`` are those of one-step predictions, by output, after the first max(50, 5 n) samples.
    """

    rows: tuple[tuple[str, float, float, float, float], ...]
    errors: Mapping[str, float]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = table_of("Parameters after the last sample", "", "theta", "std", "[0.025", "0.975]")
        for name, *values in self.rows:
            table.add_row(name, *(f"{value:.4g}" for value in values))
        yield table
        table = table_of("One-step prediction error, root mean square", *self.errors, names=0)
        table.add_row(*(f"{error:.5g}" for error in self.errors.values()))
        yield table


def summarise_outputs(run: Outputs) -> OutputsSummary:
    """Build the summary of a record with a theta for each output."""
    return OutputsSummary({name: summarise(run[name]) for name in run.outputs})


def summarise_shared(run: Shared) -> SharedSummary:
    """Build the summary of a record whose outputs share one theta."""
    low, high = run.band(0.95)
    rows = tuple(
        (name, float(run.theta[-1, i]), float(run.std[-1, i]), float(low[-1, i]), float(high[-1, i]))
        for i, name in enumerate(run.names)
    )
    kept = run.innovation[burn_in(len(run.names)) :]
    errors = (root_mean_square(e[np.isfinite(e)]) for e in kept.T)
    return SharedSummary(rows, dict(zip(run.outputs, errors, strict=True)))

"""``driftfit detect``: alarms at a set rate of false alarms, scored against labels if there are any."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from rich.text import Text
from typer import Option

from driftfit.cli.options import Given, Plot, Report, Table, check_table, reads
from driftfit.cli.program import app, say
from driftfit.cli.reading import interval_from
from driftfit.data.limits import end_of
from driftfit.engine.settings import marks
from driftfit.results import Track
from driftfit.show.export import write_table
from driftfit.show.report import check_path


@dataclass(frozen=True)
class AlarmOptions:
    """The options that define an alarm."""

    kind: Annotated[str, Option(help="glr or band.")] = "glr"
    every: Annotated[float, Option(help="Samples in which one false alarm may begin.")] = 10_000.0
    reference: Annotated[
        list[str] | None,
        Option(help="What is normal: a number of first samples, FROM..TO in times, or name=low:high; repeat the last."),
    ] = None

    def find(self, run: Any) -> Any:
        """The alarms of a run, an `Outputs` or a fleet."""
        return run.detect(self.kind, every=self.every, reference=parse_reference(self.reference, run))


@app.command()
@reads
def detect(
    given: Given,
    options: AlarmOptions,
    labels: Annotated[
        str | None, Option(help="Column of labels, 0 or 1, that mark faults; the alarms are scored.")
    ] = None,
    write_to: Table = None,
    plot: Plot = None,
    report: Report = None,
) -> None:
    """Find alarms at a set rate of false alarms; with labels, score them."""
    if labels is not None and (given.by or len(given.outputs) > 1):
        raise ValueError("--labels: labels are for one series of one output; leave out --by and further --y.")
    check_table(write_to, "alarms are")
    if report is not None:
        check_path(report)
    rows = given.read(labels) if labels is not None else None
    run = given.run(rows)
    alarms = options.find(run)
    say(alarms)
    faulty = None
    if rows is not None and labels is not None:
        faulty = marks("--labels", rows.numbers[labels][rows.order()], len(alarms.active))
        score = alarms.score(faulty)
        late = "" if np.isnan(score.delay) else f", {score.delay:g} samples after they began (median)"
        found = f" Labels: {score.found} of {score.events} found{late};"
        say(Text(f"{found} {score.false} false alarms in {score.normal} normal samples."), soft_wrap=True)
    if write_to is not None:
        write_table(alarms.table, write_to)
    if plot is not None:
        if not isinstance(run, Track):
            raise ValueError("--plot: alarms are drawn for one series; use --report for a fleet.")
        alarms.plot(faulty).savefig(plot, dpi=150)
    if report is not None:
        run.report(report, alarms=alarms, **({} if faulty is None else {"labels": faulty}))


def parse_reference(given: list[str] | None, run: Any) -> Any:
    """``300``, ``2024-03-01..2024-03-04`` or ``gain=0.9:1.1`` in the form that `Track.detect` takes."""
    if not given:
        return None
    if all("=" in entry for entry in given):
        return dict(_band(entry) for entry in given)
    if len(given) > 1:
        raise ValueError("--reference: several references are only for bands, such as --reference gain=0.9:1.1.")
    if given[0].strip().isdigit():
        return int(given[0])
    first, last = interval_from(given[0], "--reference")
    axis, zone = (run.time, run.labels.zone) if isinstance(run, Track) else (np.arange(1), None)
    return end_of("--reference", first, axis, zone, 0), end_of("--reference", last, axis, zone, 1)


def _band(entry: str) -> tuple[str, tuple[float, float]]:
    name, _, bounds = entry.partition("=")
    low, _, high = bounds.partition(":")
    try:
        return name.strip(), (float(low or "-inf"), float(high or "inf"))
    except ValueError:
        raise ValueError(f"--reference {entry}: give a band as name=low:high.") from None

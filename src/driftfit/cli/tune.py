"""``driftfit tune``: estimate settings of a tracker from a record."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from rich.text import Text
from typer import Option

from driftfit.cli.options import Given, Plot, reads
from driftfit.cli.program import app, progress, say
from driftfit.cli.reading import listed
from driftfit.parsing.settings import given_fields
from driftfit.readings.left_out import remarks_of
from driftfit.show.text import facts, shortened, table_of


@app.command()
@reads
def tune(
    given: Given,
    method: Annotated[str, Option(help="ml, h-step, loo or gcv.")] = "ml",
    ahead: Annotated[int, Option("--ahead", help="Samples ahead, for h-step.")] = 1,
    groups: Annotated[
        str | None, Option(help="each: a separate drift for each parameter; or one label per parameter, a,a,b.")
    ] = None,
    level: Annotated[float, Option(help="Level of the intervals.")] = 0.95,
    plot: Plot = None,
) -> None:
    """Estimate the settings that a tracker is missing: --tracker kalman estimates q and r."""
    from driftfit.tune.tune import tune as find
    from driftfit.tune.tuned import Tuned

    models, shared = given.models(), groups.split(",") if groups and groups != "each" else groups
    with progress.status("tuning"):
        tuned = find(
            models[0], given.chosen_tracker(), method=method, h=ahead, groups=shared, level=level, **given.arrays()
        )
    assert isinstance(tuned, Tuned)  # `arrays` are of one output
    rows = [
        ("Model", repr(models[0])),
        ("Tracker", shortened(repr(tuned.tracker))),
        ("Log-likelihood", f"{tuned.loglik:.6g} of {tuned.used} samples"),
        *remarks_of(tuned.left_out),
    ]
    say(facts(*rows))
    table = table_of(f"Settings by {method}", "", "chosen", f"{level:.0%} from", "to")
    for name, value in tuned.chosen.items():
        low, high = tuned.interval.get(name, (np.nan, np.nan))
        table.add_row(Text(name), *("" if np.isnan(x) else f"{x:.4g}" for x in (value, low, high)))
    say(table)
    if tuned.at_bound:
        say(Text(f" at a bound of the search: {', '.join(tuned.at_bound)}", "dim"))
    say(Text(f" To use them: {_flags(given, tuned.tracker)}", "dim"), soft_wrap=True)
    if plot is not None:
        tuned.plot().savefig(plot, dpi=150)


def _flags(given: Given, tracker: Any) -> str:
    """The tracker as command line options."""
    values = {f.name: (getattr(tracker, f.name), f.default) for f in given_fields(type(tracker))}
    parts = [f"-p {name}={_typed(value)}" for name, (value, default) in values.items() if not _same(value, default)]
    return " ".join([f"--tracker {given.tracker}", *parts])


def _same(value: Any, default: Any) -> bool:
    return np.shape(value) == np.shape(default) and bool(np.all(value == default))


def _typed(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return str(value).lower()
    return ",".join(f"{x:.6g}" for x in np.ravel(value)) if np.ndim(value) or isinstance(value, float) else str(value)


@app.command()
@reads
def select(
    given: Given,
    keep: Annotated[list[str] | None, Option(help="Regressor that every subset contains; repeat it.")] = None,
    most: Annotated[int | None, Option(help="Largest number of regressors in a subset.")] = None,
    plot: Plot = None,
) -> None:
    """Compare models (repeat --model), or the regressors of one, by how well they predict."""
    from driftfit.judge.structures.select import Selection
    from driftfit.judge.structures.select import select as compare

    models = given.models()
    with progress.status("comparing"):
        selection = compare(
            models if len(models) > 1 else models[0], tracker=given.chosen_tracker(), keep=tuple(listed(keep)),
            most=most, **given.arrays(),
        )  # fmt: skip
    say(selection)
    assert isinstance(selection, Selection)  # `arrays` are of one output
    if plot is not None:
        selection.plot().savefig(plot, dpi=150)

"""Commands that read a record: track, verdict, tune, select, detect, forecast, smooth; and identify, from a file to an
answer.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import numpy as np
import polars as pl
import typer
from rich.text import Text
from typer import Argument, Option

from driftfit.cli.options import (
    Cells,
    Given,
    Names,
    Out,
    Plot,
    Report,
    Since,
    Table,
    check_table,
    interval_from,
    limits_from,
    listed,
    parse_interval,
    parse_seconds,
    reads,
)
from driftfit.cli.program import app, draw, progress, say, writable
from driftfit.data.columns import Wanted
from driftfit.data.limits import end_of
from driftfit.data.limits import marks as marks_of
from driftfit.data.record import Reading
from driftfit.data.tables import read_records
from driftfit.engine.compile_notice import PATIENCE
from driftfit.engine.kernel import Array
from driftfit.engine.settings import marks, missing_settings
from driftfit.identify.answer import chosen, identify
from driftfit.identify.page import SERVICE, interval, unit
from driftfit.identify.roles import NoAnswerError
from driftfit.judge.structures.select import Selection
from driftfit.judge.structures.select import select as compare
from driftfit.models.arx import arx_text
from driftfit.parsing.settings import given_fields
from driftfit.readings.left_out import remarks_of
from driftfit.results import Track
from driftfit.run.live.conformal import quantile
from driftfit.show.export import check_ending, write, write_table
from driftfit.show.page import document, opening
from driftfit.show.report import check_path, written
from driftfit.show.text import digits, facts, shortened, table_of
from driftfit.tune.tune import tune as estimate
from driftfit.tune.tuned import Tuned


@app.command()
@reads
def track(
    given: Given,
    write_to: Out = None,
    plot: Plot = None,
    system: Annotated[
        Path | None, Option(help="Save a picture of responses, poles and gain over time (ARX, one output).")
    ] = None,
    report: Report = None,
    since: Since = None,
) -> None:
    """Track the parameters of a model in a record, or in a fleet of records."""
    if write_to is not None:
        check_ending(write_to)
    _check_page(given, report, since)
    if given.free:
        given = _with_structure(given)
    run = given.run()
    say(run.summary())
    if write_to is not None:
        write(run, write_to)
    draw(plot, run.plot)
    if system is not None and not isinstance(run, Track):
        raise ValueError("--system: this draws one series with one output; leave out --by and further --y.")
    draw(system, lambda: run.plot_system())
    _page(run, report, since)


def _check_page(given: Given, path: Path | None, since: str | None) -> None:
    """ValueError for a page that cannot be written, before anything is run."""
    if path is not None:
        check_path(path)
    if since is not None and (path is None or not (given.by or len(given.outputs) > 1)):
        raise ValueError("--since: this is for the page of many series; give --report and --by.")


def _page(run: Any, path: Path | None, since: str | None) -> None:
    """Write the page of a record or a fleet, if there is a path for it."""
    if path is not None:
        run.report(path, **({} if since is None else {"since": since}))


def _with_structure(given: Given) -> Given:
    """The options with the inputs, the structure and the time that `driftfit identify` finds."""
    with progress.status("searching the structure"):
        found, model = chosen(given.file[0], given.outputs[0], given.time, given.wanted)
    text, inputs = arx_text(model), f" --u {','.join(model.input_names)}" if model.input_names else ""
    say(Text(f" Chosen: --model {text}{inputs}; `driftfit identify` says why."), soft_wrap=True)
    dt = given.dt or (interval(found) if found.clock else None)
    return replace(given, model=[text], u=list(model.input_names), time=found.clock, dt=dt)


@app.command()
@reads
def verdict(
    given: Given,
    level: Annotated[float, Option(help="Error rate of the test; for a fleet, the false discovery rate.")] = 0.05,
    lags: Annotated[int | None, Option(help="Lags of correlation of the noise to allow for.")] = None,
    report: Report = None,
    since: Since = None,
) -> None:
    """Report whether the parameters move, which ones and when, and whether tracking them pays."""
    _check_page(given, report, since)
    run = given.run()
    say(run.verdict(level=level, lags=lags))
    _page(run, report, since)


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
    models, shared = given.models(), groups.split(",") if groups and groups != "each" else groups
    with progress.status("tuning"):
        tuned = estimate(
            models[0], given.chosen_tracker(), method=method, h=ahead, groups=shared, level=level, **given.arrays()
        )
    assert isinstance(tuned, Tuned)  # `arrays` are of one output
    likelihood = ("Log-likelihood", f"{tuned.loglik:.6g} of {tuned.used} samples")
    model, tracker = ("Model", repr(models[0])), ("Tracker", shortened(repr(tuned.tracker)))
    say(facts(model, tracker, likelihood, *remarks_of(tuned.left_out)))
    table = table_of(f"Settings by {method}", "", "chosen", f"{level:.0%} from", "to")
    for name, value in tuned.chosen.items():
        low, high = tuned.interval.get(name, (np.nan, np.nan))
        table.add_row(Text(name), *("" if np.isnan(x) else f"{x:.4g}" for x in (value, low, high)))
    say(table)
    if tuned.at_bound:
        say(Text(f" at a bound of the search: {', '.join(tuned.at_bound)}", "dim"))
    parts = [f"--tracker {given.tracker}"]
    for field in given_fields(type(tuned.tracker)):
        value, default = getattr(tuned.tracker, field.name), np.asarray(field.default)
        if np.shape(value) != default.shape or not np.all(value == default):
            parts.append(f"-p {field.name}={_typed(value)}")
    say(Text(f" To use them: {' '.join(parts)}", "dim"), soft_wrap=True)
    draw(plot, tuned.plot)


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
    models = given.models()
    with progress.status("comparing"):
        selection = compare(
            models if len(models) > 1 else models[0], tracker=given.chosen_tracker(), keep=tuple(listed(keep)),
            most=most, **given.arrays(),
        )  # fmt: skip
    say(selection)
    assert isinstance(selection, Selection)  # `arrays` are of one output
    draw(plot, selection.plot)


@app.command()
@reads
def detect(
    given: Given,
    kind: Annotated[str, Option(help="glr or band.")] = "glr",
    every: Annotated[float, Option(help="Samples in which one false alarm may begin.")] = 10_000.0,
    reference: Annotated[
        list[str] | None,
        Option(help="What is normal: a number of first samples, FROM..TO in times, or name=low:high; repeat the last."),
    ] = None,
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
    _check_page(given, report, None)
    run = given.run()
    alarms = run.detect(kind, every=every, reference=parse_reference(reference, run))
    say(alarms)
    faulty = None
    if labels is not None:
        read = read_records(
            given.files, labels, None, None, Reading(time=given.time, dt="label", missing=given.missing)
        )[0]
        faulty = marks("--labels", read.y, len(alarms.active))
        score = alarms.score(faulty)
        late = "" if np.isnan(score.delay) else f", {score.delay:g} samples after they began (median)"
        found = f" Labels: {score.found} of {score.events} found{late};"
        say(Text(f"{found} {score.false} false alarms in {score.normal} normal samples."), soft_wrap=True)
    if write_to is not None:
        write_table(alarms.table, write_to)
    if plot is not None and not isinstance(run, Track):
        raise ValueError("--plot: alarms are drawn for one series; use --report for a fleet.")
    draw(plot, lambda: alarms.plot(faulty))
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


FORECAST_ROWS, SMOOTHED_ROWS = 40, 5
"""Rows that are printed, at most."""


@app.command()
@reads
def forecast(
    given: Given,
    ahead: Annotated[int | None, Option("--ahead", help="Samples to forecast; as many as --future has rows.")] = None,
    future: Annotated[str | None, Option(help="File of future inputs, with the columns of --u.")] = None,
    level: Annotated[float, Option(help="Level of the bands.")] = 0.95,
    write_to: Table = None,
) -> None:
    """Forecast the outputs, and the parameters, after the end of the record."""
    quantile(level, "--level")  # whether there is one
    check_table(write_to, "a forecast is")
    given.check_single("forecast")
    u = None if future is None else _inputs(given, future)
    if ahead is None:
        ahead = 10 if u is None else len(u)
    if u is None and given.inputs:
        raise ValueError(
            f"forecast: future inputs are needed: --future FILE with the columns {', '.join(given.inputs)}."
        )
    run: Track = given.run()
    made = run.forecast(ahead, None if u is None else u[:ahead])
    low, high = made.band(level)
    frame = made.table.with_columns(low=low, high=high)
    table = table_of(
        f"{run.labels.y} after {run.time_text(-1)}", "ahead" if made.time is None else made.axis, run.labels.y, "std",
        f"{level:.0%} from", "to",
    )  # fmt: skip
    for k, row in enumerate(frame.head(FORECAST_ROWS).select("y_hat", "y_std", "low", "high").iter_rows()):
        table.add_row(made.time_text(k), *(f"{value:.6g}" for value in row))
    say(table)
    if ahead > FORECAST_ROWS:
        say(Text(f" the first {FORECAST_ROWS} of {ahead}; --out writes all", "dim"))
    if write_to is not None:
        write_table(frame, write_to)


def _inputs(given: Given, future: str) -> Array:
    if not given.inputs:
        raise ValueError(f"--future {future}: the model has no inputs; leave it out.")
    files = replace(given.files, paths=future, rows=(1, None), times=(None, None))
    numbers = files.columns(Wanted(tuple(given.inputs), missing=marks_of(given.missing)[0]))[0].numbers
    return np.stack([numbers[name] for name in given.inputs], axis=1)


@app.command()
@reads
def smooth(given: Given, write_to: Table = None, plot: Plot = None) -> None:
    """Estimate the parameters at every sample from the whole record; settings that are left out are tuned first."""
    check_table(write_to, "a path is")
    given.check_single("smooth")
    tracker = given.chosen_tracker()
    if missing_settings(tracker):
        with progress.status("tuning"):
            tuned = estimate(given.models()[0], tracker, **given.arrays())
        assert isinstance(tuned, Tuned)  # `arrays` are of one output
        tracker = tuned.tracker
    run = given.run(tracker=tracker)
    smoothed = run.smooth()
    say(facts(("Model", repr(run.model)), ("Tracker", repr(run.tracker)), ("Samples", str(len(run)))))
    table = table_of("Parameters from the whole record", "at", *run.names)
    for t in np.unique(np.linspace(0, len(run) - 1, SMOOTHED_ROWS).astype(int)):
        cells = (f"{digits(v, s)} +- {s:.2g}" for v, s in zip(smoothed.theta[t], smoothed.std[t], strict=True))
        table.add_row(Text(run.time_text(int(t))), *cells)
    say(table)
    say(Text(" +- one standard deviation", "dim"))
    if write_to is not None:
        columns: dict[str, Any] = {run.labels.time or "sample": run.time}
        columns |= {f"theta_{name}": smoothed.theta[:, i] for i, name in enumerate(run.names)}
        columns |= {f"std_{name}": smoothed.std[:, i] for i, name in enumerate(run.names)}
        write_table(pl.DataFrame(columns), write_to)
    draw(plot, smoothed.plot)


@app.command("identify")
@reads
def identify_command(
    file: Annotated[list[str], Argument(help="CSV or Parquet files, or patterns such as 'runs/*.csv'.")],
    cells: Cells,
    *,
    y: Annotated[str | None, Option(help="Column of the output.")] = None,
    u: Annotated[Names, Option(help="Inputs to choose from; repeat it, or separate names by commas.")] = None,
    not_u: Annotated[Names, Option(help="Columns that are no inputs.")] = None,
    by: Annotated[str | None, Option(help="Column that identifies records of one structure.")] = None,
    max_lag: Annotated[int, Option(help="Longest lag of an input, in samples.")] = 30,
    forecast: Annotated[
        bool, Option("--forecast/--explain", help="Only inputs of earlier samples, or also of the same.")
    ] = False,
    horizon: Annotated[int, Option(help="Steps ahead of the second comparison.")] = 10,
    level: Annotated[float, Option(help="Error rate of the statement that parameters move.")] = 0.05,
    gate: Annotated[
        bool | None, Option("--gate/--no-gate", help="Leave out fault codes however many, or use all readings.")
    ] = None,
    budget: Annotated[str, Option(help="Time for the answer: seconds, or a duration such as 2m.")] = "45s",
    seed: Annotated[int, Option(help="Seed of the displaced copies of inputs.")] = 0,
    page: Annotated[Path | None, Option(help="Write the answer to a page (.html).")] = None,
    json_to: Annotated[Path | None, Option("--json", help="Write the answer as JSON; - is stdout.")] = None,
    serve: Annotated[Path | None, Option(help="Write a configuration for `driftfit serve` (.toml).")] = None,
    quiet: Annotated[bool, Option("--quiet", help="Print the headline alone.")] = False,
) -> None:
    """From a file to an answer: which inputs matter, what changed, since when, and is it time or the working point?

    Exit codes: 0 answered, 1 undecided, 2 arguments or file, 3 the record cannot answer.
    """
    for path, option in ((page, "--page"), (json_to, "--json"), (serve, "--serve")):
        writable(path, option)
    ranges = dict(limits_from(one, [one.rpartition("=")[0].strip()]) for one in cells.limits or [])
    began = monotonic()
    with progress.status("reading") as status:
        if not (progress.is_terminal and not quiet):
            status.stop()

        def tell(text: str) -> None:
            if monotonic() - began > PATIENCE:
                status.update(text)

        try:
            found = identify(
                file if len(file) > 1 else file[0], y, u=listed(u) or None, not_u=listed(not_u), time=cells.time,
                dt=parse_interval(cells.dt), by=by, limits=ranges, max_lag=max_lag, forecast=forecast,
                horizon=horizon, level=level, gate=gate, budget=parse_seconds(budget), seed=seed,
                reading=cells.wanted, progress=tell,
            )  # fmt: skip
        except NoAnswerError as error:
            status.stop()
            typer.echo(text := f"driftfit: this record cannot answer: {error}", err=True)
            written(document("No answer", [opening([text])]), page)
            raise typer.Exit(3) from None
    _tell(found, page, json_to, serve)
    if str(json_to) != "-":
        say(" ".join(found.headline.split()) if quiet else found, soft_wrap=quiet)
    raise typer.Exit(found.code)


def _tell(found: Any, page: Path | None, json_to: Path | None, serve: Path | None) -> None:
    """Write an answer to what was asked for."""
    if page is not None:
        found.page(page)
    if serve is not None:
        serve.write_text(SERVICE + unit(found), encoding="utf-8")
    if json_to is not None:
        text = json.dumps(found.json(), indent=1)
        typer.echo(text) if str(json_to) == "-" else json_to.write_text(text, encoding="utf-8")

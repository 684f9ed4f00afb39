"""Report: one self-contained page about a run, for a reader who does not know this library.

The page gives the verdict first, then the parameters, the comparison, the diagnostics, pictures, settings and counts of
skipped samples. Pictures are inline SVG in the colours of the page, which follow the reader's light or dark setting and
turn light for print; nothing is loaded from elsewhere. The points of a long record are an image inside the SVG, which
keeps the page small.
"""

from __future__ import annotations

from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftfit.engine import __version__
from driftfit.judge.diagnose import Diagnosis, diagnosis
from driftfit.judge.evidence import Evidence
from driftfit.judge.verdict import LEVEL, Verdict, change, judged, p_text
from driftfit.models.arx import ARX
from driftfit.run.result import Track, burn_in
from driftfit.show.page_parts import document, picture, section, table
from driftfit.show.page_style import READING
from driftfit.show.parts.axes import date_axis, draw_innovation, draw_parameter, draw_prediction, new_figure, time_label
from driftfit.show.parts.text import digits
from driftfit.show.report_faults import faults
from driftfit.show.summary import Summary, summarise
from driftfit.use.system import dc_gain, largest_pole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.engine.kernel import Array
    from driftfit.judge.alarms.detect import Alarms


def report(
    run: Track,
    path: str | PathLike[str],
    title: str | None = None,
    alarms: Alarms | None = None,
    labels: Array | None = None,
) -> None:
    """Write a page about a run.

    Parameters
    ----------
    run : Track
        What `track` returned.
    path : str or path
        File to write; its name ends in .html.
    title : str or None
        The heading; None uses the names of the signals.
    alarms : Alarms or None
        The result of `detect`: the page then shows the dates, causes and a picture of the alarms.
    labels : (T,) or None
        True where something was wrong: the page then shows these dates, and which of them the alarms found.

    Raises
    ------
    ValueError
        If the path does not end in .html or .htm, or labels have another length than the record.
    OSError
        If the file cannot be written.
    """
    check_path(path).write_text(page(run, title, alarms, labels), encoding="utf-8")


def check_path(path: str | PathLike[str]) -> Path:
    """The path of a page; ValueError if its name does not end in .html."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"report: the page is HTML, so its name must end in .html; got {str(path)!r}.")
    return Path(path)


def page(run: Track, title: str | None = None, alarms: Alarms | None = None, labels: Array | None = None) -> str:
    """The page as HTML text."""
    facts, known = summarise(run), Evidence(run)
    truth, health = judged(known, LEVEL), diagnosis(known)
    heading = title or _heading(run)
    sections = [
        f"<h1>{escape(heading)}</h1>",
        f'<p class="soft">{escape(_subtitle(run, facts))}</p>',
        _verdict(truth, health),
        *([section("Faults and alarms", faults(run, alarms, labels))] if alarms or labels is not None else []),
        section("Parameters over time", picture(parameter_figure(run), run, PARAMETERS)),
        section("Parameters", _parameter_table(facts, truth) + _system_table(run)),
        section("Predictions", _comparison(truth) + picture(_signals(run), run, SIGNALS)),
        section("Diagnostics", _checks(health) + picture(health.plot(), run, DIAGNOSTICS)),
        section("Settings and omitted data", _settings(run, facts)),
        section("How to read this", READING),
    ]
    return document(heading, sections)


PARAMETERS = "Each parameter after every sample (line) with its 95 % band. Each estimate uses the past only."
SIGNALS = (
    "Above: the output (dots) and its prediction one sample before. Below: the prediction error and its 95 % band."
)
DIAGNOSTICS = "The innovations (one-step errors), the excitation, and the constancy of the coefficients. Grey: limits."


def _heading(run: Track) -> str:
    labels = run.labels
    return f"{labels.y} from {', '.join(labels.u)}" if labels.u else f"Parameters of {labels.y}"


def _subtitle(run: Track, facts: Summary) -> str:
    parts = [f"{facts.samples} samples", facts.span, f"{facts.used} used", f"{facts.samples - facts.used} skipped"]
    return ", ".join(part for part in parts if part)


def _verdict(truth: Verdict, health: Diagnosis) -> str:
    count = len(health.sentences)
    state = (
        health.no_finding
        if health.ok
        else (f"{count} of {len(health.checks)} diagnostics {'is' if count == 1 else 'are'} out of bounds, see below.")
    )
    lines = "".join(f"<p>{escape(sentence)}</p>" for sentence in (*truth.sentences, state))
    return f'<div class="verdict">{lines}</div>'


def _parameter_table(facts: Summary, truth: Verdict) -> str:
    heads = ("parameter", "now", "95 % band", "range of the path", "p, constant", "moves")
    tests = {moved.name: moved for moved in truth.parameters}
    rows = []
    for row in facts.rows:
        test = tests.get(row.name)
        moved = "no" if test is not None and np.isfinite(test.p_own) else ""
        if test is not None and test.moves:
            moved = f"{change(test)}, {escape(test.when)}"
        values = (row.theta, row.low, row.high, row.path_low, row.path_high)
        theta, low, high, least, most = (digits(value, row.std) for value in values)
        cells = (theta, f"{low} to {high}", f"{least} to {most}")
        p = "" if test is None else escape(p_text(test.p_own))
        rows.append((escape(f"{row.name} {row.unit}".strip()), *cells, p, moved))
    caption = f"After the last sample; the range is that of the path after the first {facts.burn} samples."
    return table(caption, heads, rows)


def _system_table(run: Track) -> str:
    """Gain and largest pole of an ARX model at a few times; empty for other models."""
    if not isinstance(run.model, ARX) or run.names != run.model.names or run.model.na == 0 or len(run) < 10:
        return ""
    T = len(run)
    at = np.unique(np.linspace(min(burn_in(run.model.n), T // 3), T - 1, 5).astype(int))
    gain, pole = dc_gain(run, at), largest_pole(run, at)
    names = run.model.inputs if isinstance(run.model.inputs, tuple) else [f"u{j + 1}" for j in range(run.model.m)]
    heads = ("at", *(f"gain of {escape(str(name))}" for name in names), "largest pole")
    rows = []
    for k, t in enumerate(at):
        gains = (f"{digits(v, s)} +- {s:.2g}" for v, s in zip(gain.value[k], gain.std[k], strict=True))
        rows.append(
            (escape(run.time_text(int(t))), *gains, f"{digits(pole.value[k], pole.std[k])} +- {pole.std[k]:.2g}")
        )
    return table("The system behind the parameters: steady-state gain; a pole below 1 is stable.", heads, rows)


def _comparison(truth: Verdict) -> str:
    rows = [("this run", f"{truth.rms:.5g}", "", "")]
    for rival in truth.rivals:
        ratio = f"{rival.rms / truth.rms:.3f}" if truth.rms > 0.0 else ""
        rows.append((rival.name, f"{rival.rms:.5g}", ratio, escape(p_text(rival.p))))
    caption = f"One-step prediction error, root mean square, on {truth.scored} samples that all could predict."
    return table(caption, ("", "error", "over this run", "p, no better"), rows)


def _checks(health: Diagnosis) -> str:
    rows = []
    for check in health.checks:
        low, high = ("" if np.isinf(limit) else f"{limit:.4g}" for limit in (check.low, check.high))
        state = '<span class="good">ok</span>' if check.ok else '<span class="bad">out of bounds</span>'
        rows.append((check.name, escape(check.text), low, high, "not known" if np.isnan(check.value) else state))
    text = "".join(f"<li>{escape(sentence)}</li>" for sentence in health.sentences)
    listed = table("Numbers with their limits.", ("check", "value", "from", "to", ""), rows)
    return listed + (f"<ul>{text}</ul>" if text else "")


def _settings(run: Track, facts: Summary) -> str:
    missing_y, missing_u = int(np.sum(~np.isfinite(run.y))), int(np.sum(~np.isfinite(run.u).all(axis=1)))
    pairs = [
        ("Model", facts.model), ("Tracker", facts.tracker), ("Signals", facts.signals), ("Time", facts.span),
        ("Samples", f"{facts.samples}, of which {facts.used} were used and {facts.samples - facts.used} skipped"),
        ("Missing", f"{missing_y} outputs, {missing_u} samples with a missing input"),
        ("Rows left out", facts.dropped), *facts.remarks, ("Log-likelihood", f"{facts.loglik:.6g}"),
        ("Made by", f"driftfit {__version__}"),
    ]  # fmt: skip
    return f"<dl>{''.join(f'<dt>{escape(name)}</dt><dd>{escape(value)}</dd>' for name, value in pairs if value)}</dl>"


def parameter_figure(run: Track) -> Figure:
    n = len(run.names)
    columns = 1 if n <= 3 else 2
    rows = -(-n // columns)
    figure = new_figure(9.5, 1.55 * rows + 0.5)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for i, axis in enumerate(axes):
        axis.set_visible(i < n)
        if i < n:
            draw_parameter(axis, run, i)
            date_axis(axis, run)
    for axis in axes[-columns:]:
        axis.set_xlabel(time_label(run))
    return figure


def _signals(run: Track) -> Figure:
    figure = new_figure(9.5, 4.6)
    signal, error = figure.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.3])
    draw_prediction(signal, run)
    draw_innovation(error, run)
    error.set_xlabel(time_label(run))
    date_axis(error, run)
    return figure

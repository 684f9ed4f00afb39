"""Report: one self-contained page about a run, or about many, for a reader who does not know this library.

The page gives the verdict first, then the parameters, the comparison, the diagnostics, pictures, settings and counts of
skipped samples; with alarms or labels also their dates and causes. A page about many runs has a row for each, and
pictures of those that move most clearly. Pictures are inline SVG in the colours of the page, which follow the reader's
light or dark setting and turn light for print; nothing is loaded from elsewhere. The points of a long record are an
image inside the SVG, which keeps the page small.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.data.limits import within
from driftfit.engine import __version__
from driftfit.engine.kernel import Array
from driftfit.engine.settings import marks
from driftfit.judge.alarms.detect import onsets
from driftfit.judge.changes.words import rows as listed
from driftfit.judge.diagnose import Diagnosis, diagnosis
from driftfit.judge.evidence import Evidence
from driftfit.judge.fleet_verdict import Judgement, ManyDiagnoses, ManyVerdicts, verdicts_and_diagnoses
from driftfit.judge.verdict import LEVEL, Verdict, change, judged, p_text
from driftfit.models.arx import ARX
from driftfit.run.result import Track, burn_in
from driftfit.show.page import READING, document, facts, of_all, opening, picture, points, section, table
from driftfit.show.plots import plot_parameters, plot_signals
from driftfit.show.summary import Summary, summarise
from driftfit.show.text import counts, digits, key_text
from driftfit.use.system import dc_gain, largest_pole

if TYPE_CHECKING:
    from driftfit.judge.alarms.detect import Alarms
    from driftfit.judge.alarms.fleet_alarms import ManyAlarms


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
    written(page(run, title, alarms, labels), path)


def check_path(path: str | PathLike[str]) -> Path:
    """The path of a page; ValueError if its name does not end in .html."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"report: the page is HTML, so its name must end in .html; got {str(path)!r}.")
    return Path(path)


def written(text: str, path: str | PathLike[str] | None) -> str:
    """The text of a page, which is written where there is a path."""
    if path is not None:
        check_path(path).write_text(text, encoding="utf-8")
    return text


def page(run: Track, title: str | None = None, alarms: Alarms | None = None, labels: Array | None = None) -> str:
    """The page as HTML text."""
    summary, known = summarise(run), Evidence(run)
    truth, health = judged(known), diagnosis(known)
    labelled = run.labels
    heading = f"{labelled.y} from {', '.join(labelled.u)}" if labelled.u else f"Parameters of {labelled.y}"
    heading = title or heading
    skipped, out = summary.samples - summary.used, len(health.sentences)
    counted = (f"{summary.samples} samples", summary.span, f"{summary.used} used", f"{skipped} skipped")
    state = f"{out} of {len(health.checks)} diagnostics {'is' if out == 1 else 'are'} out of bounds, see below."
    state = health.no_finding if health.ok else state
    sections = [
        f"<h1>{escape(heading)}</h1>",
        f'<p class="soft">{escape(", ".join(part for part in counted if part))}</p>',
        opening((*truth.sentences, state)),
        *([section("Faults and alarms", faults(run, alarms, labels))] if alarms or labels is not None else []),
        section("Parameters over time", picture(plot_parameters(run), run, PARAMETERS)),
        section("Parameters", _parameter_table(summary, truth) + _system_table(run)),
        section("Predictions", _comparison(truth) + picture(plot_signals(run), run, SIGNALS)),
        section("Diagnostics", _checks(health) + picture(health.plot(), run, DIAGNOSTICS)),
        section("Settings and omitted data", _settings(run, summary)),
        section("How to read this", READING),
    ]
    return document(heading, sections)


PARAMETERS = "Each parameter after every sample (line) with its 95 % band. Each estimate uses the past only."
SIGNALS = (
    "Above: the output (dots) and its prediction one sample before. Below: the prediction error and its 95 % band."
)
DIAGNOSTICS = "The innovations (one-step errors), the excitation, and the constancy of the coefficients. Grey: limits."


def _parameter_table(summary: Summary, truth: Verdict) -> str:
    heads = ("parameter", "now", "95 % band", "range of the path", "moves")
    tests = {moved.name: moved for moved in truth.parameters}
    rows = []
    for row in summary.rows:
        test = tests.get(row.name)
        moved = "no" if test is not None and truth.drifts is not None and row.name not in truth.held else ""
        if test is not None and test.moves:
            moved = f"{change(test)}, {escape(test.when)}"
        values = (row.theta, row.low, row.high, row.path_low, row.path_high)
        theta, low, high, least, most = (digits(value, row.std) for value in values)
        cells = (theta, f"{low} to {high}", f"{least} to {most}")
        rows.append((escape(f"{row.name} {row.unit}".strip()), *cells, moved))
    caption = f"After the last sample; the range is that of the path after the first {summary.burn} samples."
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
    listed = table("Numbers with their limits.", ("check", "value", "from", "to", ""), rows)
    return listed + points([escape(sentence) for sentence in health.sentences])


def _settings(run: Track, summary: Summary) -> str:
    missing_y, missing_u = int(np.sum(~np.isfinite(run.y))), int(np.sum(~np.isfinite(run.u).all(axis=1)))
    skipped = summary.samples - summary.used
    pairs = [
        ("Model", summary.model), ("Tracker", summary.tracker), ("Signals", summary.signals), ("Time", summary.span),
        ("Samples", f"{summary.samples}, of which {summary.used} were used and {skipped} skipped"),
        ("Missing", f"{missing_y} outputs, {missing_u} samples with a missing input"),
        ("Rows left out", summary.dropped), *summary.remarks, ("Log-likelihood", f"{summary.loglik:.6g}"),
        ("Made by", f"driftfit {__version__}"),
    ]  # fmt: skip
    return facts(pairs)


SERIES_LISTED = 200
"""Most rows in the table."""
PICTURES = 4
"""Most runs with pictures."""
LISTED_BY_NAME = 4
"""Fewer runs, or models, than this are listed by name instead of counted."""

MANY = """<p>Each row was tested separately. Among many tests some reject by chance: q is the share of false rejections
among all series with a q this small or smaller (false discovery rate).</p>"""


def page_of_many(
    runs: Mapping[Hashable, Track],
    by: tuple[str, ...],
    title: str | None,
    failed: Mapping[Hashable, str],
    dropped: Mapping[str, int],
    alarms: ManyAlarms | None = None,
    labels: Mapping[Hashable, Array] | None = None,
    since: Any = None,
) -> str:
    """The page as HTML text; ``by`` names the parts of a key, ``failed`` gives the reasons of missing results,
    ``dropped`` counts the rows that are left out, by reason; ``labels`` by key are true for faults. With ``since`` the
    page begins with what changed from then on.
    """
    if not runs:
        raise ValueError("report: no series has a result to report.")
    new = {
        key: within([(since, None)], run.time, np.arange(len(run)), run.labels.zone, "report: since")
        for key, run in (runs.items() if since is not None else ())
    }
    verdicts, health = verdicts_and_diagnoses(runs, by, LEVEL)
    heading = title or (", ".join(map(key_text, runs)) if len(runs) < LISTED_BY_NAME else f"{len(runs)} series")
    samples, used = sum(map(len, runs.values())), sum(int(run.ok.sum()) for run in runs.values())
    counted = f"{len(runs)} series, {samples} samples, {used} used, {samples - used} skipped"
    shown = [row for row in verdicts.rows[:PICTURES] if row.drifts] or list(verdicts.rows[:1])
    first, changed = _since(since, verdicts, new) if new else ((), ())
    return document(
        heading,
        [
            f"<h1>{escape(heading)}</h1>",
            f'<p class="soft">{escape(counted)}</p>',
            _verdict_of_many(first, verdicts, health),
            *changed,
            *([section("Faults and alarms", many_faults(runs, alarms, labels or {}))] if alarms or labels else []),
            section("All series", _rows(verdicts, health)),
            section(
                "The series that move most clearly" if verdicts.drifting else "The clearest",
                "".join(_pictured(row, runs[row.key]) for row in shown),
            ),
            section("Diagnostics", _health(health)),
            section("Settings and omitted data", _settings_of_many(runs, failed, dropped)),
            section("How to read this", MANY + READING),
        ],
    )


def _since(
    since: Any, verdicts: ManyVerdicts, new: Mapping[Hashable, Array]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(a sentence, and a section) about the changes that happened, went on or ended at ``since`` or later."""
    rows, changed = [], 0
    for one in verdicts.rows:
        found = [event for event in one.verdict.events if one.drifts and new[one.key][max(event.at, event.until or 0)]]
        changed += bool(found)
        moves = [move for event in found for move in event.moves]
        for (kind, when, _, ended, *cells), move in zip(listed(found), moves, strict=True):
            clear = abs(move.before) > np.nan_to_num(move.std)
            share = f"{100.0 * (move.after - move.before) / abs(move.before):+.0f} %" if clear else ""
            begun = f"{when} to {ended}" if ended else when
            rows.append(tuple(map(escape, (key_text(one.key), cells[0], kind, begun, *cells[1:], share))))
    text = f"{changed or 'None'} of {len(new)} series changed since {since}."
    heads = ("", "what", "how", "when", "before", "after", "+-", "change")
    caption = f"The clearest first.{of_all(len(rows), SERIES_LISTED)}"
    listing = table(caption, heads, rows[:SERIES_LISTED], (1, 2, 3))
    return (text,), (section(f"What changed since {since}", listing),) if rows else ()


def _verdict_of_many(first: tuple[str, ...], verdicts: ManyVerdicts, health: ManyDiagnoses) -> str:
    out, known = sum(not one.ok for one in health.of.values()), len(health.known)
    state = f"{out} of {known} have diagnostics out of bounds." if out else "All diagnostics are within limits."
    return opening((*first, *verdicts.sentences, state if known else "No diagnostic can be computed."))


def _rows(verdicts: ManyVerdicts, health: ManyDiagnoses) -> str:
    rows, known = [], set(health.known)
    for row in verdicts.rows[:SERIES_LISTED]:
        out = len(health[row.key].sentences)
        marked = f'<span class="bad">{out}</span>' if out else "0" if row.key in known else ""
        rows.append((escape(key_text(row.key)), *map(escape, row.cells), marked))
    heads = ("", "what moves", "p", "q", "error", "of constants", "pays", "out of bounds")
    return table(f"The clearest first.{of_all(len(verdicts), SERIES_LISTED)}", heads, rows, (1,))


def _pictured(row: Judgement, run: Track) -> str:
    text = escape(" ".join(row.verdict.sentences))
    shown = picture(plot_parameters(run), run, PARAMETERS)
    return f'<div class="one"><h3>{escape(key_text(row.key))}</h3><p>{text}</p>{shown}</div>'


def _health(health: ManyDiagnoses) -> str:
    computed = health.computed
    out = [(name, str(k), str(computed[name])) for name, k in health.counts.items()]
    counted = table(
        "How many are out of bounds, of those for which the check can be computed.", ("check", "series", "of"), out
    )
    worst = [key for key in health.worst[:PICTURES] if not health[key].ok]
    return counted + points(
        [f"<b>{escape(key_text(key))}</b>: {escape(' '.join(health[key].sentences))}" for key in worst]
    )


def _settings_of_many(
    runs: Mapping[Hashable, Track], failed: Mapping[Hashable, str], dropped: Mapping[str, int]
) -> str:
    trackers = list(dict.fromkeys(repr(run.tracker) for run in runs.values()))
    models = list(dict.fromkeys(repr(run.model) for run in runs.values()))
    without = "; ".join(f"{key_text(key)}: {reason}" for key, reason in list(failed.items())[:20])
    missing = counts(sum((Counter(run.labels.missing) for run in runs.values()), Counter()))
    pairs = [
        ("Model", "; ".join(models) if len(models) < LISTED_BY_NAME else f"{len(models)} different ones"),
        ("Tracker", trackers[0] if len(trackers) == 1 else f"{len(trackers)} different settings"),
        ("Without a result", without or "none"), ("Rows left out", counts(dropped) or "none"),
        ("Taken as missing", missing or "none"), ("Made by", f"driftfit {__version__}"),
    ]  # fmt: skip
    return facts(pairs)


FAULTS_LISTED = 100
"""Most rows in a table."""

PICTURE = "The output, and each statistic over its limit (dashed). Red: an alarm is on. Grey: labelled as wrong."


def faults(run: Track, alarms: Alarms | None, labels: Array | None) -> str:
    """The section for one run: labels, alarms, and the picture of the alarms."""
    wrong = None if labels is None else marks("report", labels, len(run))
    parts = [] if wrong is None else [_labels(run, alarms, wrong)]
    if alarms is not None:
        parts += [_score(alarms, wrong), _alarms(alarms), picture(alarms.plot(wrong), run, PICTURE)]
    return "".join(parts)


def many_faults(runs: Mapping[Hashable, Track], alarms: ManyAlarms | None, labels: Mapping[Hashable, Array]) -> str:
    """The section for many runs: a row for each with labels or alarms, and pictures of the most extreme."""
    watched = {} if alarms is None else {row.key: row for row in alarms.rows}
    strange = [key for key in labels if key not in runs]
    if strange:
        raise ValueError(f"report: labels name {strange[0]!r}, which has no result.")
    rows, given = [], {key: marks("report", labels[key], len(runs[key])) for key in labels}
    for key in dict.fromkeys([*watched, *labels]):
        wrong = given.get(key, np.zeros(len(runs[key]), bool))
        begun, row = onsets(wrong), watched.get(key)
        marked = escape(runs[key].time_text(int(begun[0]))) if len(begun) else ""
        cells: tuple[str, ...] = (escape(key_text(key)), str(len(begun)) if key in labels else "", marked)
        if row is not None and (len(begun) or row.onsets):
            score = row.alarms.score(wrong)
            found = (str(score.found), str(score.false)) if key in labels else ("", "")
            cells += (str(len(row.onsets)), escape(row.first), escape(p_text(row.q)), *found)
        if len(cells) > 3 or len(begun):
            rows.append((*cells, *[""] * (8 - len(cells))))
    heads = ("", "labelled", "the first", "alarms", "the first", "q", "found", "false")
    shown = [row for row in watched.values() if row.onsets][:PICTURES]
    pictures = (
        f'<div class="one"><h3>{escape(key_text(row.key))}</h3>'
        f"{picture(row.alarms.plot(given.get(row.key)), runs[row.key], PICTURE)}</div>"
        for row in shown
    )
    caption = f"Intervals labelled as wrong, and alarms.{of_all(len(rows), FAULTS_LISTED)}"
    return table(caption, heads, rows[:FAULTS_LISTED], (2, 4)) + "".join(pictures)


def _labels(run: Track, alarms: Alarms | None, wrong: Array) -> str:
    rows = []
    for first in onsets(wrong):
        last = int(first) + int(np.argmin(np.append(wrong[first:], False)))
        row = [escape(run.time_text(int(first))), escape(run.time_text(last - 1)), str(last - int(first))]
        if alarms is not None:
            begun = alarms.onsets[(alarms.onsets >= first) & (alarms.onsets < last)]
            missed = '<span class="bad">no alarm</span>'
            row.append(
                f"{escape(run.time_text(int(begun[0])))}, {int(begun[0] - first)} later" if len(begun) else missed
            )
        rows.append(tuple(row))
    heads = ("from", "to", "samples", "first alarm")[: 3 if alarms is None else 4]
    return table(f"Labelled as wrong.{of_all(len(rows), FAULTS_LISTED)}", heads, rows[:FAULTS_LISTED], (1, 3))


def _score(alarms: Alarms, wrong: Array | None) -> str:
    text = (
        f"Alarm: {alarms.kind}, one false alarm in {alarms.every:g} samples. {len(alarms.onsets)} alarms; "
        f"A record without a fault is as extreme as this one with probability {p_text(alarms.p)}."
    )
    if wrong is not None:
        score = alarms.score(wrong)
        text += f" {score.found} of {score.events} labelled intervals found, {score.false} false alarms."
    return f"<p>{escape(text)}</p>"


def _alarms(alarms: Alarms) -> str:
    rows = [tuple(map(escape, alarms.cells(int(t)))) for t in alarms.onsets]
    return table(f"Alarms.{of_all(len(rows), FAULTS_LISTED)}", alarms.heads, rows[:FAULTS_LISTED], (1, 2))

"""Report on many runs: one self-contained page about a fleet, or about the outputs of one record.

The page gives the verdict on all runs first, then a table with one row per run, pictures of those that change most
clearly, and how often each diagnostic is out of bounds. It has the style of `driftfit.show.report`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping
from html import escape
from typing import TYPE_CHECKING

from driftfit.engine import __version__
from driftfit.judge.fleet_verdict import Judgement, ManyDiagnoses, ManyVerdicts, verdicts_and_diagnoses
from driftfit.judge.verdict import LEVEL
from driftfit.show.page_parts import document, picture, section, table
from driftfit.show.page_style import READING
from driftfit.show.parts.text import counts, key_text
from driftfit.show.report import PARAMETERS, parameter_figure
from driftfit.show.report_faults import many_faults

if TYPE_CHECKING:
    from driftfit.engine.kernel import Array
    from driftfit.judge.alarms.fleet_alarms import ManyAlarms
    from driftfit.run.result import Track

LISTED = 200
"""Most rows in the table."""
PICTURED = 4
"""Most runs with pictures."""
NAMED = 4
"""Fewer runs, or models, than this are listed by name instead of counted."""

HEADS = ("check", "series", "of")

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
) -> str:
    """The page as HTML text; ``by`` names the parts of a key, ``failed`` gives the reasons of missing results,
    ``dropped`` counts the rows that are left out, by reason; ``labels`` by key are true for faults.
    """
    if not runs:
        raise ValueError("report: no series has a result to report.")
    verdicts, health = verdicts_and_diagnoses(runs, by, LEVEL)
    heading = title or (", ".join(map(key_text, runs)) if len(runs) < NAMED else f"{len(runs)} series")
    samples, used = sum(map(len, runs.values())), sum(int(run.ok.sum()) for run in runs.values())
    counted = f"{len(runs)} series, {samples} samples, {used} used, {samples - used} skipped"
    shown = [row for row in verdicts.rows[:PICTURED] if row.drifts] or list(verdicts.rows[:1])
    return document(
        heading,
        [
            f"<h1>{escape(heading)}</h1>",
            f'<p class="soft">{escape(counted)}</p>',
            _verdict(verdicts, health),
            *([section("Faults and alarms", many_faults(runs, alarms, labels or {}))] if alarms or labels else []),
            section("All series", _rows(verdicts, health)),
            section(
                "The series that move most clearly" if verdicts.drifting else "The clearest",
                "".join(_pictured(row, runs[row.key]) for row in shown),
            ),
            section("Diagnostics", _health(health)),
            section("Settings and omitted data", _settings(runs, failed, dropped)),
            section("How to read this", MANY + READING),
        ],
    )


def _verdict(verdicts: ManyVerdicts, health: ManyDiagnoses) -> str:
    out = sum(not one.ok for one in health.of.values())
    known = len(health.known)
    state = f"{out} of {known} have diagnostics out of bounds." if out else "All diagnostics are within limits."
    if known == 0:
        state = "No diagnostic can be computed."
    lines = "".join(f"<p>{escape(sentence)}</p>" for sentence in (*verdicts.sentences, state))
    return f'<div class="verdict">{lines}</div>'


def _rows(verdicts: ManyVerdicts, health: ManyDiagnoses) -> str:
    rows, known = [], set(health.known)
    for row in verdicts.rows[:LISTED]:
        out = len(health[row.key].sentences)
        marked = f'<span class="bad">{out}</span>' if out else "0" if row.key in known else ""
        rows.append((escape(key_text(row.key)), *map(escape, row.cells), marked))
    heads = ("", "what moves", "p", "q", "error", "of constants", "pays", "out of bounds")
    more = f" The first {LISTED} of {len(verdicts)}." if len(verdicts) > LISTED else ""
    return table(f"The clearest first.{more}", heads, rows, (1,))


def _pictured(row: Judgement, run: Track) -> str:
    text = escape(" ".join(row.verdict.sentences))
    shown = picture(parameter_figure(run), run, PARAMETERS)
    return f'<div class="one"><h3>{escape(key_text(row.key))}</h3><p>{text}</p>{shown}</div>'


def _health(health: ManyDiagnoses) -> str:
    computed = health.computed
    out = [(name, str(k), str(computed[name])) for name, k in health.counts.items()]
    counted = table("How many are out of bounds, of those for which the check can be computed.", HEADS, out)
    worst = [key for key in health.worst[:PICTURED] if not health[key].ok]
    text = "".join(
        f"<li><b>{escape(key_text(key))}</b>: {escape(' '.join(health[key].sentences))}</li>" for key in worst
    )
    return counted + (f"<ul>{text}</ul>" if text else "")


def _settings(runs: Mapping[Hashable, Track], failed: Mapping[Hashable, str], dropped: Mapping[str, int]) -> str:
    trackers = list(dict.fromkeys(repr(run.tracker) for run in runs.values()))
    models = list(dict.fromkeys(repr(run.model) for run in runs.values()))
    pairs = [
        ("Model", "; ".join(models) if len(models) < NAMED else f"{len(models)} different ones"),
        ("Tracker", trackers[0] if len(trackers) == 1 else f"{len(trackers)} different settings"),
        (
            "Without a result",
            "; ".join(f"{key_text(key)}: {reason}" for key, reason in list(failed.items())[:20]) or "none",
        ),
        ("Rows left out", counts(dropped) or "none"),
        ("Taken as missing", counts(sum((Counter(run.labels.missing) for run in runs.values()), Counter())) or "none"),
        ("Made by", f"driftfit {__version__}"),
    ]
    return f"<dl>{''.join(f'<dt>{escape(name)}</dt><dd>{escape(value)}</dd>' for name, value in pairs)}</dl>"

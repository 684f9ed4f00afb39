"""The section about faults: the dates of labels, the alarms with dates and causes, and their picture."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import marks
from driftfit.judge.alarms.onsets import onsets
from driftfit.judge.verdict import p_text
from driftfit.show.page_parts import picture, table
from driftfit.show.parts.text import key_text

if TYPE_CHECKING:
    from driftfit.judge.alarms.detect import Alarms
    from driftfit.judge.alarms.fleet_alarms import ManyAlarms
    from driftfit.run.result import Track

LISTED = 100
"""Most rows in a table."""

PICTURED = 4
"""Most pictures of alarms on a page about many series."""

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
    rows = []
    for key in dict.fromkeys([*watched, *labels]):
        wrong = marks("report", labels[key], len(runs[key])) if key in labels else np.zeros(len(runs[key]), bool)
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
    shown = [row for row in watched.values() if row.onsets][:PICTURED]
    pictures = (
        f'<div class="one"><h3>{escape(key_text(row.key))}</h3>'
        f"{picture(row.alarms.plot(_given(runs, labels, row.key)), runs[row.key], PICTURE)}</div>"
        for row in shown
    )
    return table(f"Intervals labelled as wrong, and alarms.{_more(rows)}", heads, rows[:LISTED], (2, 4)) + "".join(
        pictures
    )


def _given(runs: Mapping[Hashable, Track], labels: Mapping[Hashable, Array], key: Hashable) -> Array | None:
    return marks("report", labels[key], len(runs[key])) if key in labels else None


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
    return table(f"Labelled as wrong.{_more(rows)}", heads, rows[:LISTED], (1, 3))


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
    return table(f"Alarms.{_more(rows)}", alarms.heads, rows[:LISTED], (1, 2))


def _more(rows: Sequence[tuple[str, ...]]) -> str:
    return f" The first {LISTED} of {len(rows)}." if len(rows) > LISTED else ""

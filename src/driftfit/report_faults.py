"""What was wrong, on a page: the dates of labels, the alarms with dates and causes, and their picture."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

import numpy as np

from driftfit.judges.onsets import onsets
from driftfit.judges.plots import plot_alarms
from driftfit.kernel import Array
from driftfit.report_parts import picture, table
from driftfit.verdict import p_text

if TYPE_CHECKING:
    from driftfit.detect import Alarms
    from driftfit.result import Track

LISTED = 100
"""Rows of a table."""

PICTURE = "The output, and each statistic over its limit (dashed). Red: an alarm is on. Grey: labelled as wrong."


def faults(run: Track, alarms: Alarms | None, labels: Array | None) -> str:
    """The section: labels, alarms, and the picture of the alarms."""
    wrong = None if labels is None else np.asarray(labels).astype(bool)
    if wrong is not None and wrong.shape != (len(run),):
        raise ValueError(f"report: labels have shape {wrong.shape}, but the record has {len(run)} samples.")
    parts = [] if wrong is None else [_labels(run, alarms, wrong)]
    if alarms is not None:
        parts += [_said(alarms, wrong), _alarms(alarms), picture(plot_alarms(alarms, wrong), run, PICTURE)]
    return "".join(parts)


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


def _said(alarms: Alarms, wrong: Array | None) -> str:
    text = (
        f"Alarm: {alarms.kind}, one false alarm in {alarms.every:g} samples. {len(alarms.onsets)} alarms; "
        f"{p_text(alarms.p)} is the chance that a record without a fault gets as extreme as this one."
    )
    if wrong is not None:
        score = alarms.score(wrong)
        text += f" {score.found} of {score.events} labelled stretches found, {score.false} false alarms."
    return f"<p>{escape(text)}</p>"


def _alarms(alarms: Alarms) -> str:
    rows = []
    for t in alarms.onsets:
        cause = alarms.cause(int(t))
        j = alarms.names.index(cause)
        first, last = alarms.span(int(t))
        numbers = f"{alarms.statistic[t, j]:.4g}", f"{alarms.limits[j]:.4g}"
        rows.append((escape(first), escape(last), escape(cause), *numbers))
    heads = ("from", "to", "cause", "statistic", "limit")
    return table(f"Alarms.{_more(rows)}", heads, rows[:LISTED], (1, 2))


def _more(rows: list[tuple[str, ...]]) -> str:
    return f" The first {LISTED} of {len(rows)}." if len(rows) > LISTED else ""

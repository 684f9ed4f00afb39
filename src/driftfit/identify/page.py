"""The page of an answer, its picture, and the answer as plain data."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.identify import words
from driftfit.judge.verdict import p_equals
from driftfit.show.axes import BLUE, RED, date_axis, draw_prediction, frame, panels, settled, time_label
from driftfit.show.page import document, facts, opening, picture, points, section, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.identify.answer import Identification, ManyIdentified

NAME = "driftfit.identify/1"
KINDS = ("moves", "a static curve explains it", "both", "no drift found", "cannot decide")
OBJECT, TEXT, LIST = {"type": "object"}, {"type": "string"}, {"type": "array"}
PROPERTIES: dict[str, Any] = {
    "schema": {"const": NAME}, "answer": {"enum": KINDS}, "headline": TEXT, "why": TEXT, "model": TEXT,
    "p": {"type": ["number", "null"]}, "roles": OBJECT, "structure": OBJECT, "effects": LIST, "moves": LIST,
    "errors": LIST, "memory": OBJECT, "cause": OBJECT, "notes": LIST, "undecided": LIST, "commands": LIST, "unit": TEXT,
}  # fmt: skip
SCHEMA = {"title": NAME, "type": "object", "required": list(PROPERTIES), "properties": PROPERTIES}
"""JSON Schema of `Identification.json`."""
DRAWN = 200
"""Samples at which gains are drawn."""
CAPTION = (
    "Above: the output (dots) and its prediction one sample before. Below: the static gain of each input with its 95 % "
    "band, from the past only. Red: when it changed."
)


def finite(value: Any) -> Any:
    """Plain data: lists, strings, numbers, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {str(key): finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def as_json(answer: Identification) -> dict[str, Any]:
    """The answer in the form of `SCHEMA`."""
    roles, structure = answer.roles, answer.structure
    second = [(words.structure_text(answer, shape), *behind) for shape, *behind in structure.second]
    inputs = {roles.inputs[j]: {"nb": nb, "nk": nk, "delays": structure.delays[j]} for j, nb, nk in structure.shape[1]}
    shown = ("output", "inputs", "clock", "by", "step", "why", "refused", "missing")
    found: dict[str, Any] = finite({
        "schema": NAME, "answer": answer.kind, "headline": answer.headline, "why": answer.why,
        "model": repr(answer.model), "p": answer.verdict.p, "roles": {name: getattr(roles, name) for name in shown},
        "structure": {"na": structure.na, "inputs": inputs, "second": second},
        "effects": [one._asdict() for one in answer.effects], "moves": [one._asdict() for one in answer.moves],
        "errors": [one._asdict() for one in answer.errors], "memory": answer.memory._asdict(),
        "cause": {name: value for name, value in vars(answer.cause).items() if name != "columns"},
        "notes": answer.notes, "undecided": answer.undecided, "commands": words.commands(answer),
        "unit": words.unit(answer),
    })  # fmt: skip
    return found


def figure(answer: Identification) -> Figure:
    """The output with its prediction, and the static gain of the first four inputs with dates of changes."""
    run, shown = answer.track, answer.model.input_names[:4]
    drawn, axes = panels(None, (9.5, 2.4 + 1.6 * max(len(shown), 1)), 1 + len(shown), sharex=True)
    draw_prediction(axes[0], run)
    at = np.unique(np.linspace(settled(run).start, len(run) - 1, min(DRAWN, len(run))).astype(int))
    value, std = run.dc_gain(at) if shown else (np.zeros((len(at), 0)),) * 2
    for i, (axis, name) in enumerate(zip(axes[1:], shown, strict=True)):
        low, high = value[:, i] - 1.96 * std[:, i], value[:, i] + 1.96 * std[:, i]
        axis.fill_between(run.time[at], low, high, color=BLUE, alpha=0.2, lw=0)
        axis.plot(run.time[at], value[:, i], color=BLUE, lw=1.3)
        axis.set_ylabel(f"effect of\n{name}")
        axis.grid(alpha=0.25, lw=0.5)
        both = np.concatenate([low, high])
        frame(axis, np.nanpercentile(both[np.isfinite(both)], (2.0, 98.0)) if np.isfinite(both).any() else both)
        for move in answer.moves:
            if move.what == name and move.kind != "wandering":
                axis.axvline(run.time[move.at], color=RED, lw=1.0)
    axes[-1].set_xlabel(time_label(run))
    for axis in axes:
        date_axis(axis, run)
    drawn.align_ylabels(axes)
    return drawn


def html(answer: Identification) -> str:
    """The page."""
    heading = f"{answer.roles.output} from {', '.join(answer.model.input_names) or 'its own past'}"
    subtitle = f"{answer.source}, {len(answer.track)} samples, answer: {answer.kind}"
    first = [f"<h1>{escape(heading)}</h1>", f'<p class="soft">{escape(subtitle)}</p>', opening([answer.headline])]
    return document(heading, [*first, *body(answer)])


def body(answer: Identification) -> list[str]:
    """The sections of a page below the headline."""
    cause, curve = answer.cause, ""
    leads = (f"{name} {one[0]:.1f} +- {one[1]:.1f}" for name, one in
             (("tracked parameters", cause.tracked), ("a curve", cause.curve), ("both", cause.joint)))  # fmt: skip
    if answer.kind in KINDS[1:3]:
        curve = f"<p>A model with that curve, fitted:</p><pre>{escape(answer.curve_call)}</pre>"
    copied = "".join(f"<pre>{escape(one)}</pre>" for one in (*words.commands(answer)[:2], words.unit(answer)))
    open_ = [*answer.undecided, f"{p_equals(answer.verdict.p)} is that of a test after a selection"]
    return [
        section("What, since when, how large", _listed(words.sentences(answer)) + _effects(answer)),
        section("The picture", picture(figure(answer), answer.track, CAPTION)),
        section("How good", _errors(answer)),
        section("Time or working point", f"<p>Nats over constants: {escape(', '.join(leads))}.</p>{curve}"),
        section("What was chosen, and what came second", _listed([*words.chosen(answer), *words.columns(answer)])),
        section("Problems of the data", _listed(answer.notes) or "<p>None.</p>"),
        section("What it could not decide", _listed(open_)),
        section("To go on", f"{copied}<p>The last is a unit for <code>driftfit serve</code>.</p>"),
        facts([("Model", repr(answer.model))]),
    ]


def _listed(sentences: Any) -> str:
    return points([escape(one) for one in sentences])


def _effects(answer: Identification) -> str:
    rows = [(escape(name), words.delay(answer, name), words.number(gain), f"{std:.2g}", words.number(least))
            for name, gain, std, least in answer.effects]  # fmt: skip
    heads = ("input", "delay", answer.effect, "+-", "smallest change found")
    caption = "Effects with constant parameters, in units of the output per unit of the input."
    return table(caption, heads, rows, (1,)) if rows else ""


def _errors(answer: Identification) -> str:
    rows = []
    for steps, rms, samples in answer.errors:
        better = (
            (f'<span class="bad">{value:.4g}</span>' if value < rms["driftfit"] else f"{value:.4g}")
            for value in rms.values()
        )
        rows.append((f"{steps} ahead", *better, str(samples)))
    caption = "Root mean square errors of predictions made before the sample, tracked and constants mixed. Red: lower."
    return table(caption, ("", *answer.errors[0].rms, "samples"), rows)


def many(answer: ManyIdentified) -> str:
    """The page of many records: the table first, then those that move most clearly."""
    heads = ("record", "what moves", "p", "q", "error", "of constants", "pays")
    rows = [(escape(str(row.key)), *map(escape, row.cells)) for row in answer.verdict.rows]
    parts = [f"<h1>{len(rows)} records</h1>", opening(answer.verdict.sentences)]
    parts.append(section("All records", table("The clearest first.", heads, rows, (1,))))
    for key, one in answer.worst.items():
        parts += [f"<h2>{escape(str(key))}</h2>", opening([one.headline]), *body(one)]
    return document(f"{len(rows)} records", parts)

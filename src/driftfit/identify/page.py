"""The page of an answer, its picture, and the answer as plain data."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.engine import __version__
from driftfit.identify import words
from driftfit.show.axes import BLUE, RED, date_axis, draw_prediction, frame, panels, settled, time_label
from driftfit.show.page import document, facts, opening, picture, points, section, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.identify.answer import Identification, ManyIdentified

NAME = "driftfit.identify/1"
SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": NAME,
    "type": "object",
    "required": ["schema", "answer", "headline", "model", "roles", "effects", "moves", "errors", "cause", "commands"],
    "properties": {
        "schema": {"const": NAME},
        "answer": {
            "enum": ["moves", "a static curve explains it", "both", "no drift found", "cannot decide"],
        },
        "headline": {"type": "string"},
        "model": {"type": "string"},
        "p": {"type": ["number", "null"]},
        "roles": {"type": "object"},
        "effects": {"type": "array", "items": {"type": "object", "required": ["name", "gain", "std", "least"]}},
        "moves": {"type": "array", "items": {"type": "object", "required": ["what", "kind", "before", "after"]}},
        "errors": {"type": "array", "items": {"type": "object", "required": ["steps", "rms", "samples"]}},
        "cause": {"type": "object", "required": ["kind", "tracked", "curve", "joint"]},
        "commands": {"type": "array", "items": {"type": "string"}},
    },
}
"""JSON Schema of `Identification.json`."""
DRAWN = 200
"""Samples at which gains are drawn."""


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
    roles, structure, cause = answer.roles, answer.structure, answer.cause
    found: dict[str, Any] = finite(
        {
            "schema": NAME,
            "answer": answer.kind,
            "headline": answer.headline,
            "why": answer.why,
            "model": repr(answer.model),
            "p": answer.verdict.p,
            "after_selection": True,
            "roles": {
                "output": roles.output, "inputs": roles.inputs, "time": roles.clock, "dt": roles.step, "by": roles.by,
                "left_out": dict(roles.why), "refused": dict(roles.refused), "missing": roles.missing,
            },
            "structure": {
                "na": structure.na,
                "inputs": {roles.inputs[j]: {"nb": nb, "nk": nk, "delays": structure.delays.get(j)}
                           for j, nb, nk in structure.shape[1]},
                "second": [{"structure": words.structure_text(answer, one), "behind": behind, "error": error}
                           for one, behind, error in structure.second],
            },
            "effects": [one._asdict() for one in answer.effects],
            "moves": [one._asdict() for one in answer.moves],
            "errors": [one._asdict() for one in answer.errors],
            "cause": {"kind": cause.kind, "tracked": cause.tracked, "curve": cause.curve, "joint": cause.joint,
                      "products": cause.products},
            "notes": answer.notes,
            "undecided": answer.undecided,
            "commands": words.commands(answer),
            "unit": words.unit(answer),
        }
    )  # fmt: skip
    return found


def figure(answer: Identification) -> Figure:
    """The output with its prediction, and the static gain of every input with its 95 % band and dates of changes."""
    run = answer.track
    shown = [one.name for one in answer.effects][:4]
    drawn, axes = panels(None, (9.5, 2.4 + 1.6 * max(len(shown), 1)), 1 + len(shown), sharex=True)
    draw_prediction(axes[0], run)
    start = settled(run).start
    at = np.unique(np.linspace(start, len(run) - 1, min(DRAWN, len(run) - start)).astype(int))
    if shown:
        gain = run.dc_gain(at)
        low, high = gain.band()
    for i, (axis, name) in enumerate(zip(axes[1:], shown, strict=True)):
        axis.fill_between(run.time[at], low[:, i], high[:, i], color=BLUE, alpha=0.2, lw=0)
        axis.plot(run.time[at], gain.value[:, i], color=BLUE, lw=1.3)
        known = np.isfinite(gain.std[:, i])
        usual = (
            np.nanpercentile(np.concatenate([low[known, i], high[known, i]]), (2.0, 98.0))
            if known.any()
            else gain.value[:, i]
        )
        frame(axis, np.asarray(usual))
        axis.set_ylabel(f"effect of\n{name}")
        axis.grid(alpha=0.25, lw=0.5)
        for move in answer.moves:
            if move.what == name and move.kind != "wandering":
                axis.axvline(run.time[move.at], color=RED, lw=1.0)
    axes[-1].set_xlabel(time_label(run))
    for axis in axes:
        date_axis(axis, run)
    drawn.align_ylabels(axes)
    return drawn


CAPTION = "Above: the output (dots) and its prediction one sample before. Below: the effect of each input in the long run (static gain) with its 95 % band, from the past only; red: when it changed."


def html(answer: Identification) -> str:
    """The page."""
    roles = answer.roles
    heading = f"{roles.output} from {', '.join(answer.model.input_names) or 'its own past'}"
    sections = [
        f"<h1>{escape(heading)}</h1>",
        f'<p class="soft">{escape(f"{answer.source}, {len(answer.track)} samples, answer: {answer.kind}")}</p>',
        opening([answer.headline]),
        *body(answer),
    ]
    return document(heading, sections)


def body(answer: Identification) -> list[str]:
    """The sections of a page below the headline."""
    cause, verdict = answer.cause, answer.verdict
    copied = "".join(f"<pre>{escape(one)}</pre>" for one in (*words.commands(answer)[:2], words.unit(answer)))
    said = [f"tracked parameters {_nats(cause.tracked)}", f"a curve {_nats(cause.curve)}", f"both {_nats(cause.joint)}"]
    decided = [*answer.undecided, f"the p-value ({words.p_equals(verdict.p)}) is that of a test after a selection"]
    return [
        section("What, since when, how large", _moves(answer) + _effects(answer)),
        section("The picture", picture(figure(answer), answer.track, CAPTION)),
        section("How good", _errors(answer)),
        section("Time or working point", f"<p>Lead over constants: {escape(', '.join(said))}.</p>{_curve(answer)}"),
        section("What was chosen", points([escape(one) for one in (*words.chosen(answer), *words.columns(answer))])),
        section("Problems of the data", points([escape(one) for one in answer.notes]) or "<p>None.</p>"),
        section("What it could not decide", points([escape(one) for one in decided])),
        section("To go on", f"{copied}<p>The last is a unit of a service, for <code>driftfit serve</code>.</p>"),
        facts([("Made by", f"driftfit {__version__}"), ("Model", repr(answer.model))]),
    ]


def _nats(one: tuple[float, float]) -> str:
    return f"{one[0]:.1f} +- {one[1]:.1f} nats"


def _moves(answer: Identification) -> str:
    said = [escape(one) for one in words.sentences(answer)]
    return points(said) if said and answer.kind in ("moves", "both") else ""


def _effects(answer: Identification) -> str:
    rows = [(escape(one.name), words.delay(answer, one.name), words.number(one.gain), f"{one.std:.2g}", words.number(one.least))
            for one in answer.effects]  # fmt: skip
    heads = ("input", "delay", "static gain", "+-", "smallest change seen")
    return table(
        "Static gains with constant parameters, in units of the output per unit of the input.", heads, rows, (1,)
    )


def _errors(answer: Identification) -> str:
    rows = []
    for errors in answer.errors:
        own = errors.rms["driftfit"]
        cells = (f'<span class="bad">{value:.4g}</span>' if name != "driftfit" and value < own else f"{value:.4g}"
                 for name, value in errors.rms.items())  # fmt: skip
        rows.append((f"{errors.steps} ahead", *cells, str(errors.samples)))
    caption = "Root mean square errors of predictions made before the sample; red: lower than that of driftfit, which mixes tracked parameters and constants."
    return table(caption, ("", *answer.errors[0].rms, "samples"), rows)


def _curve(answer: Identification) -> str:
    """The Hammerstein-Wiener call, where a curve of one input explains the record."""
    if answer.kind not in ("a static curve explains it", "both"):
        return ""
    return f"<pre>{escape(curve_call(answer))}</pre>"


def curve_call(answer: Identification) -> str:
    """The call that fits a Hammerstein-Wiener model."""
    model, j = answer.model, answer.cause.bent
    bent = answer.roles.inputs[j] if j >= 0 else ""
    bases = ", ".join("Polynomial(3)" if name == bent or not bent else "None" for name in model.input_names)
    return (
        f"HammersteinWiener({model.na}, {list(model.for_each_input('nb'))}, {list(model.for_each_input('nk'))}, "
        f"input=[{bases}], intercept=True, inputs={list(model.input_names)})"
    )


def many(answer: ManyIdentified) -> str:
    """The page of many records: the table first, then those that move most clearly."""
    heads = ("record", "what moves", "p", "q", "error", "of constants", "pays")
    rows = [(escape(str(row.key)), *map(escape, row.cells)) for row in answer.verdict.rows]
    heading = f"{len(rows)} records"
    parts = [f"<h1>{heading}</h1>", opening(answer.verdict.sentences), section("All records", table("The clearest first.", heads, rows, (1,)))]  # fmt: skip
    for key, one in answer.worst.items():
        parts += [f"<h2>{escape(str(key))}</h2>", opening([one.headline]), *body(one)]
    return document(heading, parts)

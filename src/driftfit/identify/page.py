"""The answer in words: the headline, the lines of the terminal, the page with its picture, and plain data."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import PurePath
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.identify.result import Answer, Move
from driftfit.identify.roles import CALENDAR, Roles
from driftfit.identify.structure import Shape
from driftfit.judge.fleet_verdict import ManyVerdicts
from driftfit.judge.verdict import p_equals
from driftfit.models.arx import ARX
from driftfit.show.axes import BLUE, RED, date_axis, draw_prediction, frame, panels, settled, time_label
from driftfit.show.page import document, facts, opening, picture, points, section, table
from driftfit.show.text import WIDTH

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


UNITS = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))


def number(value: float) -> str:
    """Three digits, without an exponent below a million."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def duration(answer: Answer, samples: int) -> str:
    """A number of samples, where the record has dates as a time."""
    if not answer.roles.dated:
        return f"{samples} sample{'' if samples == 1 else 's'}"
    if answer.roles.dt in CALENDAR:
        return f"{samples} {answer.roles.dt}{'' if samples == 1 else 's'}"
    seconds = samples * answer.roles.step
    size, unit = next((one for one in UNITS if seconds >= 2.0 * one[0]), UNITS[-1])
    return f"{seconds / size:.3g} {unit}"


def delay(answer: Answer, name: str) -> str:
    """The delay of an input, a range where several are as good."""
    low, high = answer.structure.delays[answer.roles.inputs.index(name)]
    if high == 0:
        return "at once"
    return (
        f"delay {duration(answer, high)}"
        if low == high
        else f"delay {duration(answer, low)} to {duration(answer, high)}"
    )


def headline(answer: Answer) -> str:
    """The answer in one sentence or two."""
    output, rms = answer.roles.output, answer.errors[0].rms
    if answer.kind == "cannot decide":
        return f"Cannot decide: {answer.why}."
    if answer.kind == "a static curve explains it":
        return f"A static curve explains it, nothing moves in time: {curve(answer)}."
    if answer.kind == "no drift found":
        least = "; ".join(f"{one.name} by {number(one.least)} from {number(one.gain)}" for one in answer.effects)
        seen = f" In 4 of 5 records a change half-way of the {answer.effect} would have been found: {least}."
        return f"No drift found in {output} ({p_equals(answer.verdict.p)}).{seen if least else ''}"
    said = sentences(answer)
    change = 100.0 * (1.0 - rms["driftfit"] / rms["constants"]) if rms["constants"] > 0.0 else 0.0
    gain = f"lowers the error {change:.0f} %" if change >= 0.5 else "does not lower the error"
    more = f"; and {len(said) - 2} more change{'' if len(said) == 3 else 's'}" if len(said) > 2 else ""
    text = f"{'; '.join(said[:2])}{more}; tracking {gain}."
    return (f"Both: {curve(answer)}. Besides this: " if answer.kind == "both" else "") + text[0].upper() + text[1:]


def curve(answer: Answer) -> str:
    """What the curve is made of."""
    nats = f"{answer.cause.curve[0]:.0f} nats over a straight line"
    return f"the effects depend on the working point ({', '.join(answer.cause.products)}; {nats})"


def sentences(answer: Answer) -> list[str]:
    """What every event did."""
    events: dict[tuple[str, int], list[Move]] = {}
    for move in answer.moves:
        events.setdefault((move.kind, move.at), []).append(move)
    return [_event(answer, own) for own in events.values()]


def _event(answer: Answer, own: list[Move]) -> str:
    one, output, parts = own[0], answer.roles.output, []
    whats = {"memory": f"the memory of {output} (sum of its lags)", "level": f"the level of {output} (at mean inputs)"}
    for move in own:
        what = whats.get(move.what) or f"the effect of {move.what} on {output} ({delay(answer, move.what)})"
        does = "wandered" if one.kind == "wandering" else verb(move)
        parts.append(f"{what} {does} from {number(move.before)} to {number(move.after)}")
    when = f"on {one.first}" if one.first == one.last else f"between {one.first} and {one.last}"
    when = "over the whole record" if one.kind == "wandering" else when
    when = f"gradually from {one.first} to {one.last}" if one.kind == "gradual" else when
    back = ", and was then as before" if one.kind == "temporary" else ""
    instead = f" (or {' or '.join(one.instead)} changed)" if one.instead else ""
    return f"{', '.join(parts)} {when}{back}{instead}"


def verb(move: Move) -> str:
    """fell or rose; a negative effect weakened or grew stronger, because it has no plain direction."""
    up = move.after > move.before
    if max(move.before, move.after) < 0.0:
        return "weakened" if up else "grew stronger"
    return "rose" if up else "fell"


def structure_text(answer: Answer, shape: Shape) -> str:
    """A structure in short."""
    each = (f", {answer.roles.inputs[j]} {nk}{f' to {nk + nb - 1}' if nb > 1 else ''}" for j, nb, nk in shape[1])
    return f"{shape[0]} lag{'' if shape[0] == 1 else 's'} of {answer.roles.output}{''.join(each)}"


def chosen(answer: Answer) -> list[str]:
    """What was chosen, and what came second."""
    found, names, memory = answer.structure, answer.roles.inputs, answer.memory
    root = ": perhaps a unit root" if memory.root else ""
    said = [f"Chosen: {structure_text(answer, found.shape)} (lags in samples); sum of the lags of "
            f"{answer.roles.output} {memory.value:.3f} +- {memory.std:.2g}{root}."]  # fmt: skip
    for shape, behind, error in found.second[:1]:
        said.append(f"Second: {structure_text(answer, shape)}, {behind:.1f} +- {error:.1f} nats behind.")
    moving = {move.what for move in answer.moves}
    idle = [name for j, name in enumerate(names) if j not in found.lags]
    steady = [names[j] for j in sorted(found.lags) if moving and names[j] not in moving]
    said += [f"{what}: {', '.join(which)}." for what, which in (("Constant", steady), ("Not needed", idle)) if which]
    if found.forecast is not None:
        other = structure_text(answer, found.forecast.shape)
        said.append(f"An input at once explains {answer.roles.output} and does not forecast it. A forecast: {other}.")
    return said


def columns(answer: Answer) -> list[str]:
    """The roles, with the options that change them."""
    roles = answer.roles
    step = duration(answer, 1) if roles.dated else f"{roles.step:g}"
    clock = f"{roles.clock}, every {step} (--time, --dt)" if roles.clock else "none, rows are even (--time)"
    said = [f"Output {roles.output} (--y); inputs {', '.join(roles.inputs) or 'none'} (--u, --not-u); time {clock}."]
    left = ", ".join(f"{name} ({why})" for name, why in roles.why.items())
    return [*said, f"Not inputs: {left}."] if left else said


def commands(answer: Answer) -> list[str]:
    """Three lines to copy."""
    model, roles = answer.model, answer.roles
    inputs = f" --u '{','.join(model.input_names)}'" if model.input_names else ""
    given = f"{answer.source} --y {roles.output}{inputs} --model {short(model)}"
    given += f" --time {roles.clock} --dt {interval(roles)}" if roles.clock else ""
    served = f"driftfit serve {PurePath(answer.source).stem}.toml   # the unit is on the page"
    return [f"driftfit track {given}", f"driftfit detect {given}", served]


def short(model: ARX) -> str:
    """A model as the option --model."""
    nb, nk = ("/".join(str(one[i]) for one in model.lags) for i in (0, 1))
    return f"arx:{model.na},{nb or 0}{nk and f',nk={nk}'},intercept"


def interval(roles: Roles) -> str:
    """The interval as the option --dt."""
    return str(roles.dt) if roles.dated else f"{roles.step:g}"


def unit(answer: Answer) -> str:
    """The unit of a service, as TOML."""
    names = ", ".join(f'"{name}"' for name in answer.model.input_names)
    dt = f'dt = "{answer.roles.dt}"\n' if answer.roles.dated else ""
    return (f'[[unit]]\nname = "{PurePath(answer.source).stem}"\ny = "{answer.roles.output}"\nu = [{names}]\n{dt}'
            f'model = "{answer.model!r}"\ntracker = "AdaptiveKalman()"\nalarm = {{ every = "1 week" }}\n')  # fmt: skip


def lines(answer: Answer) -> list[tuple[str, str]]:
    """The lines of the terminal, each with its style."""
    found = [("bold", line) for line in wrap(headline(answer), WIDTH - 1)]
    for one in answer.effects:
        moved = ", moves" if any(move.what == one.name for move in answer.moves) else ""
        text = f"{answer.effect} {number(one.gain)} +- {one.std:.2g}, {delay(answer, one.name)}{moved}"
        found.append(("", f"{one.name:<20} {text}"))
    for steps, rms, _ in answer.errors:
        each = ", ".join(f"{name} {number(value)}" for name, value in rms.items() if name != "tracked")
        found.append(("", f"Error {steps} step{'' if steps == 1 else 's'} ahead: {each}"))
    rest = [*chosen(answer), *columns(answer)]
    rest += [
        f"{head}: {'; '.join(said)}."
        for head, said in (("Data", answer.notes), ("Not decided", answer.undecided))
        if said
    ]
    found += [("", line) for text in rest for line in wrap(text, WIDTH - 1)]
    return [(style, f" {line}") for style, line in found + [("dim", one) for one in commands(answer)]]


def finite(value: Any) -> Any:
    """Plain data: lists, strings, numbers, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {str(key): finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def as_json(answer: Answer) -> dict[str, Any]:
    """The answer in the form of `SCHEMA`."""
    roles, structure = answer.roles, answer.structure
    second = [(structure_text(answer, shape), *behind) for shape, *behind in structure.second]
    inputs = {roles.inputs[j]: {"nb": nb, "nk": nk, "delays": structure.delays[j]} for j, nb, nk in structure.shape[1]}
    shown = ("output", "inputs", "clock", "by", "step", "why", "refused", "missing")
    found: dict[str, Any] = finite({
        "schema": NAME, "answer": answer.kind, "headline": headline(answer), "why": answer.why,
        "model": repr(answer.model), "p": answer.verdict.p, "roles": {name: getattr(roles, name) for name in shown},
        "structure": {"na": structure.na, "inputs": inputs, "second": second},
        "effects": [one._asdict() for one in answer.effects], "moves": [one._asdict() for one in answer.moves],
        "errors": [one._asdict() for one in answer.errors], "memory": answer.memory._asdict(),
        "cause": {name: value for name, value in vars(answer.cause).items() if name != "columns"},
        "notes": answer.notes, "undecided": answer.undecided, "commands": commands(answer),
        "unit": unit(answer),
    })  # fmt: skip
    return found


def figure(answer: Answer) -> Figure:
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


def html(answer: Answer) -> str:
    """The page."""
    heading = f"{answer.roles.output} from {', '.join(answer.model.input_names) or 'its own past'}"
    subtitle = f"{answer.source}, {len(answer.track)} samples, answer: {answer.kind}"
    first = [f"<h1>{escape(heading)}</h1>", f'<p class="soft">{escape(subtitle)}</p>', opening([headline(answer)])]
    return document(heading, [*first, *body(answer)])


def body(answer: Answer) -> list[str]:
    """The sections of a page below the headline."""
    cause, curve = answer.cause, ""
    leads = (f"{name} {one[0]:.1f} +- {one[1]:.1f}" for name, one in
             (("tracked parameters", cause.tracked), ("a curve", cause.curve), ("both", cause.joint)))  # fmt: skip
    if answer.kind in KINDS[1:3]:
        curve = f"<p>A model with that curve, fitted:</p><pre>{escape(answer.curve_call)}</pre>"
    copied = "".join(f"<pre>{escape(one)}</pre>" for one in (*commands(answer)[:2], unit(answer)))
    open_ = [*answer.undecided, f"{p_equals(answer.verdict.p)} is that of a test after a selection"]
    return [
        section("What, since when, how large", _listed(sentences(answer)) + _effects(answer)),
        section("The picture", picture(figure(answer), answer.track, CAPTION)),
        section("How good", _errors(answer)),
        section("Time or working point", f"<p>Nats over constants: {escape(', '.join(leads))}.</p>{curve}"),
        section("What was chosen, and what came second", _listed([*chosen(answer), *columns(answer)])),
        section("Problems of the data", _listed(answer.notes) or "<p>None.</p>"),
        section("What it could not decide", _listed(open_)),
        section("To go on", f"{copied}<p>The last is a unit for <code>driftfit serve</code>.</p>"),
        facts([("Model", repr(answer.model))]),
    ]


def _listed(sentences: Any) -> str:
    return points([escape(one) for one in sentences])


def _effects(answer: Answer) -> str:
    rows = [(escape(name), delay(answer, name), number(gain), f"{std:.2g}", number(least))
            for name, gain, std, least in answer.effects]  # fmt: skip
    heads = ("input", "delay", answer.effect, "+-", "smallest change found")
    caption = "Effects with constant parameters, in units of the output per unit of the input."
    return table(caption, heads, rows, (1,)) if rows else ""


def _errors(answer: Answer) -> str:
    rows = []
    for steps, rms, samples in answer.errors:
        better = (
            (f'<span class="bad">{value:.4g}</span>' if value < rms["driftfit"] else f"{value:.4g}")
            for value in rms.values()
        )
        rows.append((f"{steps} ahead", *better, str(samples)))
    caption = "Root mean square errors of predictions made before the sample, tracked and constants mixed. Red: lower."
    return table(caption, ("", *answer.errors[0].rms, "samples"), rows)


def many(verdict: ManyVerdicts, worst: Mapping[Any, Answer]) -> str:
    """The page of many records: the table first, then those that move most clearly."""
    heads = ("record", "what moves", "p", "q", "error", "of constants", "pays")
    rows = [(escape(str(row.key)), *map(escape, row.cells)) for row in verdict.rows]
    parts = [f"<h1>{len(rows)} records</h1>", opening(verdict.sentences)]
    parts.append(section("All records", table("The clearest first.", heads, rows, (1,))))
    for key, one in worst.items():
        parts += [f"<h2>{escape(str(key))}</h2>", opening([headline(one)]), *body(one)]
    return document(f"{len(rows)} records", parts)

"""The answer in words: the headline, the lines of the terminal, the page with its picture, and plain data."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from itertools import groupby
from pathlib import PurePath
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.data.clock import Clock
from driftfit.fleets import Fleet
from driftfit.identify.judgement import Effect, Errors, Memory, Move, parts
from driftfit.identify.roles import Roles
from driftfit.identify.structure import TIED, Shape, Structure
from driftfit.identify.working_point import Cause
from driftfit.judge.fleet_verdict import ManyVerdicts
from driftfit.judge.verdict import Verdict, p_equals
from driftfit.models.arx import ARX, arx_text
from driftfit.models.hammerstein_wiener.basis import Legendre
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.results import Track
from driftfit.run.result import root_mean_square
from driftfit.show.axes import BLUE, RED, date_axis, draw_prediction, frame, panels, settled, time_label
from driftfit.show.page import document, opening, picture, points, section, table
from driftfit.show.report import written
from driftfit.show.text import WIDTH, Printed
from driftfit.streams import Live
from driftfit.trackers.rls import RLS
from driftfit.tracking import track
from driftfit.use.system import Response, spread, taken

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = "driftfit.identify/1"
KINDS = ("moves", "a static curve explains it", "both", "no drift found", "cannot decide")
PROPERTIES: dict[str, Any] = {
    "schema": {"const": NAME}, "answer": {"enum": KINDS}, "p": {"type": ["number", "null"]},
    **{key: {"type": "string"} for key in ("headline", "why", "model", "unit")},
    **{key: {"type": "object"} for key in ("roles", "structure", "memory", "cause")},
    **{key: {"type": "array"} for key in ("effects", "moves", "errors", "notes", "undecided", "commands")},
}  # fmt: skip
SCHEMA = {"title": NAME, "type": "object", "required": list(PROPERTIES), "properties": PROPERTIES}
"""JSON Schema of `Identification.json`."""
RECORD = {"moves": {"type": ["boolean", "null"]}, "p": PROPERTIES["p"], "q": PROPERTIES["p"]}
RECORDS = {key: PROPERTIES[key] for key in ("headline", "model", "roles", "notes")} | {
    "schema": {"const": f"{NAME}/records"}, "worst": {"type": "object", "additionalProperties": SCHEMA},
    "records": {"type": "object", "additionalProperties": {"type": "object", "properties": RECORD}},
}  # fmt: skip
SCHEMA_OF_RECORDS = {"title": f"{NAME}/records", "type": "object", "required": list(RECORDS), "properties": RECORDS}
"""JSON Schema of `ManyIdentified.json`."""
SERVICE = '[source.web]\nkind = "http"\n\n'
"""What a configuration of a service needs beside a unit: samples come by HTTP."""
CAPTION = """Above: the output (dots) and its prediction one sample before. Below: the {} of each input with its 95 %
band, from the past only. Red: when it changed, of a gradual change the beginning and the end."""


def number(value: float) -> str:
    """Three digits, without an exponent below a million."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def delay(answer: Identification, name: str) -> str:
    """The delay of an input, a range where several are as good."""
    if name == answer.roles.output:
        return "without inputs"
    low, high = answer.structure.delays[answer.roles.inputs.index(name)]
    clock = Clock.of(answer.roles.dt or 1.0)
    first = f"{clock.lasting(low)} to " if low < high else ""
    return f"delay {first}{clock.lasting(high)}" if high else "at once"


def conclusion(answer: Identification) -> str:
    """The answer in one sentence or two."""
    output, rms, said = answer.roles.output, answer.errors[0].rms, sentences(answer)
    if answer.kind == "cannot decide":
        return f"Cannot decide: {answer.why}."
    if answer.kind == "a static curve explains it":
        return f"A static curve explains it, nothing moves in time: {curve(answer)}."
    if answer.kind == "no drift found":
        least = "; ".join(f"{one.name} by {number(one.least)} from {number(one.gain)}" for one in answer.effects)
        seen = f"The smallest change of the {answer.effect}, half-way, that is found with 80 % probability: {least}."
        return f"No drift found in {output} ({p_equals(answer.verdict.p)}). {seen}"
    change = 100.0 * (1.0 - rms["driftfit"] / rms["constants"]) if rms["constants"] > 0.0 else 0.0
    gain = f"lowers the error {change:.0f} %" if change >= 0.5 else "does not lower the error"
    more = f"; and {len(said) - 2} more change{'' if len(said) == 3 else 's'}" if len(said) > 2 else ""
    text = f"{'; '.join(said[:2])}{more}; tracking {gain}{''.join(others(answer))}."
    return (f"Both: {curve(answer)}. Besides this: " if answer.kind == "both" else "") + text[0].upper() + text[1:]


def others(answer: Identification) -> list[str]:
    """The inputs that matter and do not move, and those that do not matter."""
    names, moving = answer.roles.inputs, {move.what for move in answer.moves}
    steady = [names[j] for j in sorted(answer.structure.lags) if names[j] not in moving]
    idle = [name for j, name in enumerate(names) if j not in answer.structure.lags]
    said = (steady, ("matters and is", "matter and are"), " constant"), (idle, ("does", "do"), " not matter")
    return [f"; {', '.join(each)} {verbs[len(each) > 1]}{rest}" for each, verbs, rest in said if each]


def curve(answer: Identification) -> str:
    """What the curve is made of."""
    first, rest = ", ".join(answer.cause.products[:2]), len(answer.cause.products) - 2
    nats = f"{answer.cause.curve[0]:.0f} nats over a straight line"
    return f"the effects depend on the working point ({first}{f' and {rest} more' if rest > 0 else ''}; {nats})"


def sentences(answer: Identification) -> list[str]:
    """What every event did."""
    return [_event(answer, [*own]) for _, own in groupby(answer.moves, lambda move: (move.kind, move.at))]


def _event(answer: Identification, own: list[Move]) -> str:
    one, output = own[0], answer.roles.output
    whats = {"memory": f"the memory of {output} (sum of its lags)", "level": f"the level of {output} (at mean inputs)"}
    whats |= {name: f"the effect of {name} on {output} ({delay(answer, name)})" for name in answer.model.input_names}
    bent = {move.what: f"the curve of {move.what} on {output} (its standard deviation)" for move in own if move.bent}
    parts = (
        f"{(whats | bent)[move.what]} {verb(move)} from {number(move.before)} to {number(move.after)}" for move in own
    )
    when = {"wandering": "over the whole record", "gradual": f"gradually from {one.first} to {one.last}"}
    date = f"on {one.first}" if one.first == one.last else f"between {one.first} and {one.last}"
    back = ", and was then as before" if one.kind == "temporary" else ""
    instead = f" (or {' or '.join(one.instead)} changed)" if one.instead else ""
    return f"{', '.join(parts)} {when.get(one.kind, date)}{back}{instead}"


def verb(move: Move) -> str:
    """fell or rose; a negative effect weakened or grew stronger, because it has no plain direction."""
    up, down = ("weakened", "grew stronger") if max(move.before, move.after) < 0.0 else ("rose", "fell")
    return "wandered" if move.kind == "wandering" else up if move.after > move.before else down


def structure_text(answer: Identification, shape: Shape) -> str:
    """A structure in short."""
    each = (f", {answer.roles.inputs[j]} {nk}{f' to {nk + nb - 1}' if nb > 1 else ''}" for j, nb, nk in shape[1])
    return f"{shape[0]} lag{'' if shape[0] == 1 else 's'} of {answer.roles.output}{''.join(each)}"


def chosen(answer: Identification) -> list[str]:
    """What was chosen, and what came second."""
    found, names, memory, output = answer.structure, answer.roles.inputs, answer.memory, answer.roles.output
    root = ": perhaps a unit root" if memory.root else ""
    idle = ", ".join(name for j, name in enumerate(names) if j not in found.lags and not answer.moves)
    other = found.forecast and structure_text(answer, found.forecast.shape)
    lags = f"; sum of the lags of {output} {memory.value:.3f} +- {memory.std:.2g}{root}" if found.na else ""
    logged = f"the same of the logarithm of {output}, {found.log[0]:.1f} +- {found.log[1]:.1f} nats ahead"
    said = [f"Second: {structure_text(answer, shape)}, {abs(b):.1f} +- {e:.1f} nats {'behind' if b >= 0 else 'ahead'}."
            for shape, b, e in found.second]  # fmt: skip
    told = (
        f"Chosen: {structure_text(answer, found.shape)} (lags in samples){lags}.", *said[:1],
        found.log[0] > TIED and f"Better: {logged}, on the scale of {output}.",
        idle and f"Not needed: {idle}.",
        other and f"An input at once explains {output} and does not forecast it. A forecast: {other}.",
    )  # fmt: skip
    return [one for one in told if one]


def columns(roles: Roles) -> list[str]:
    """The roles, with the options that change them."""
    inputs = f"inputs {', '.join(roles.inputs) or 'none'} (--u, --not-u)"
    clock = f"{roles.clock}, every {interval(roles)} (--time, --dt)" if roles.clock else "none, rows are even (--time)"
    by = f"; records by {roles.by} (--by)" if roles.by else ""
    left = ", ".join(f"{name} ({why})" for name, why in roles.why.items())
    return [f"Output {roles.output} (--y); {inputs}; time {clock}{by}.", *([f"Not inputs: {left}."] if left else [])]


def commands(answer: Identification) -> list[str]:
    """Three lines to copy."""
    model, roles = answer.model, answer.roles
    each = {"y": roles.output, "u": ",".join(model.input_names), "model": arx_text(model), "time": roles.clock}
    each |= {"dt": interval(roles)} if roles.clock else {}
    given = {name: f"--{name} {shlex.quote(value)}" for name, value in each.items() if value}
    files, options, toml = (
        shlex.join(answer.source),
        roles.options,
        shlex.quote(f"{PurePath(answer.source[0]).stem}.toml"),
    )
    found = " ".join(text for name, text in given.items() if name != "model")
    return [
        *(f"driftfit {verb} {files} {' '.join(given.values())}{options}" for verb in ("track", "detect")),
        f"driftfit identify {files} {found}{options} --quiet --serve {toml} && driftfit serve {toml}",
    ]


def interval(roles: Roles) -> str:
    """The interval as the option --dt."""
    return roles.dt if isinstance(roles.dt, str) else f"{roles.dt:g}"


def unit(answer: Identification | ManyIdentified) -> str:
    """The unit of a service, as TOML; of records a pattern, which makes one of every topic."""
    roles, match = answer.roles, PurePath(answer.source[0]).stem if isinstance(answer, Identification) else "{unit}"
    own = dict[str, Any](match=match, y=roles.output, u=answer.model.input_names)
    timed = roles.clock is not None and isinstance(roles.dt, str) and Clock.of(roles.dt).duration is not None
    own |= {"time": roles.clock, "dt": roles.dt} if timed else {}
    own |= {"model": repr(answer.model), "tracker": "AdaptiveKalman()"}
    text = "".join(f"{name} = {json.dumps(value, ensure_ascii=False)}\n" for name, value in own.items())
    every = ' every = "1 week" ' if timed else ""
    return f"[[unit]]\n{text}alarm = {{{every}}}\n"


def effect(answer: Identification, one: Effect) -> str:
    """The size of an effect, with its units where both are known, and whether it moves."""
    moved = ", moves" if any(move.what == one.name for move in answer.moves) else ""
    known = [answer.roles.units.get(name) for name in dict.fromkeys((answer.roles.output, one.name))]
    units = f" {' per '.join(filter(None, known))}" if all(known) else ""
    return f"{answer.effect} {number(one.gain)} +- {one.std:.2g}{units}, {delay(answer, one.name)}{moved}"


def lines(answer: Identification) -> list[tuple[str, str]]:
    """The lines of the terminal, each with its style."""
    found = [("bold", line) for line in wrap(conclusion(answer), WIDTH - 1)]
    found += [("", f"{one.name:<20} {effect(answer, one)}") for one in answer.effects]
    for steps, rms, _ in answer.errors:
        each = ", ".join(f"{name} {number(value)}" for name, value in rms.items() if name != "tracked")
        found.append(("", f"Error {steps} step{'' if steps == 1 else 's'} ahead: {each}"))
    said = [f"{head}: {'; '.join(each)}." for head, each in
            (("Data", answer.notes), ("Not decided", answer.undecided)) if each]  # fmt: skip
    said = [line for text in (*chosen(answer), *columns(answer.roles), *said) for line in wrap(text, WIDTH - 1)]
    copied = [("dim", one) for one in commands(answer)]
    return [(style, f" {line}") for style, line in (*found, *(("", one) for one in said), *copied)]


def finite(value: Any) -> Any:
    """Plain data: lists, strings, numbers, and None for numbers that are not finite."""
    value = value._asdict() if hasattr(value, "_asdict") else value
    if isinstance(value, Mapping):
        return {str(key): finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


def as_json(answer: Identification) -> dict[str, Any]:
    """The answer as plain data, in the form of `driftfit.identify.page.SCHEMA`."""
    roles, structure = answer.roles, answer.structure
    second = [(structure_text(answer, shape), *behind) for shape, *behind in structure.second]
    inputs = {roles.inputs[j]: {"nb": nb, "nk": nk, "delays": structure.delays[j]} for j, nb, nk in structure.shape[1]}
    return dict(finite({
        "schema": NAME, "answer": answer.kind, "headline": conclusion(answer),
        "model": repr(answer.model), "p": answer.verdict.p, "roles": roles.plain,
        "structure": {"na": structure.na, "inputs": inputs, "second": second, "log": structure.log},
        "cause": {name: value for name, value in vars(answer.cause).items() if name != "columns"},
        "commands": commands(answer), "unit": unit(answer),
        "why": answer.why,
        **{name: getattr(answer, name) for name in ("effects", "moves", "errors", "memory", "notes", "undecided")},
    }))  # fmt: skip


def figure(answer: Identification) -> Figure:
    """The picture of the page: the output with its prediction, and the effects of the first four inputs."""
    run, shown = answer.track, answer.model.input_names[:4]
    drawn, axes = panels(None, (9.5, 2.4 + 1.6 * max(len(shown), 1)), 1 + len(shown), sharex=True)
    draw_prediction(axes[0], run)
    at = np.arange(settled(run).start, len(run), -(-len(run) // 200))
    own = np.reshape([x for what, x in parts(run).items() if what in shown], (-1, run.model.n)).T
    sums = Response(*spread(lambda theta: theta @ own, *taken(run, at)))
    gains = sums if answer.memory.root or not shown else run.dc_gain(at)
    for axis, name, *band in zip(axes[1:], shown, *(x.T for x in gains.band()), strict=False):
        axis.fill_between(run.time[at], *band, color=BLUE, alpha=0.2, lw=0)
        axis.plot(run.time[at], np.mean(band, axis=0), color=BLUE, lw=1.3)
        axis.set_ylabel(f"effect of\n{name}")
        axis.grid(alpha=0.25, lw=0.5)
        frame(axis, np.clip(band, *np.nanpercentile(band, (2.0, 98.0))))
        for move in (one for one in answer.moves if one.what == name and one.kind != "wandering"):
            for t in (move.at, move.end) if move.kind == "gradual" else (move.at,):
                axis.axvline(run.time[t], color=RED, lw=1.0)
    axes[-1].set_xlabel(time_label(run))
    for axis in axes:
        date_axis(axis, run)
    drawn.align_ylabels(axes)
    return drawn


def html(answer: Identification, path: Any = None) -> str:
    """The answer as one self-contained HTML page; with a ``path`` it is written there."""
    heading = f"{answer.roles.output} from {', '.join(answer.model.input_names) or 'its own past'}"
    subtitle = escape(f"{', '.join(answer.source)}, {len(answer.track)} samples, answer: {answer.kind}")
    first = f'<h1>{escape(heading)}</h1><p class="soft">{subtitle}</p>{opening([conclusion(answer)])}'
    return written(document(heading, [first, *body(answer)]), path)


def body(answer: Identification) -> list[str]:
    """The sections of a page below the headline."""
    cause, curve = answer.cause, ""
    leads = (f"{name} {one[0]:.1f} +- {one[1]:.1f}" for name, one in
             (("tracked parameters", cause.tracked), ("a curve", cause.curve), ("both", cause.joint)))  # fmt: skip
    if answer.kind in KINDS[1:3] and answer.model.input_names:
        run, roles, source = answer.curve, answer.roles, [*answer.source]
        own = dict[str, Any](y=roles.output, u=[*answer.model.input_names])
        own |= {"data": source[0] if len(source) == 1 else source}
        own |= {"time": roles.clock, "dt": roles.dt} if roles.clock else {}
        given = "".join(f", {name}={one!r}" for name, one in own.items())
        error = root_mean_square((run.y - run.prediction)[settled(run)])
        curve = f"<p>That curve, fitted; its error one step ahead is {error:.4g}:</p>"
        curve += f"<pre>{escape(f'track({run.model!r}, RLS(1.0){given})')}</pre>"
    copied = "".join(f"<pre>{escape(one)}</pre>" for one in (*commands(answer), SERVICE + unit(answer)))
    each = (f"{one.name}: {effect(answer, one)}; smallest change that would have been found {number(one.least)}"
            for one in answer.effects)  # fmt: skip
    open_ = [*answer.undecided, f"{p_equals(answer.verdict.p)} is that of a test after a selection"]
    return [
        section("What, since when, how large", _listed([*sentences(answer), *each])),
        section("The picture", picture(figure(answer), answer.track, CAPTION.format(answer.effect))),
        section("How good", _errors(answer)),
        section("Time or working point", f"<p>Nats over constants: {escape(', '.join(leads))}.</p>{curve}"),
        section("What was chosen, and what came second", _listed([*chosen(answer), *columns(answer.roles)])),
        section("Problems of the data", _listed(answer.notes) or "<p>None.</p>"),
        section("What it could not decide", _listed(open_)),
        section(
            "To go on",
            f"{copied}<p>The last is the configuration that <code>--serve</code> writes. In Python, "
            f"<code>answer.live()</code> continues the record with an alarm armed.</p>",
        ),
    ]


def _listed(sentences: Any) -> str:
    return points([escape(one) for one in sentences])


def _errors(answer: Identification) -> str:
    heads, rows = tuple(answer.errors[0].rms), []
    for steps, rms, samples in answer.errors:
        style = {name: ' class="bad"' if value < rms["driftfit"] else "" for name, value in rms.items()}
        cells = (f"<span{style[name]}>{rms[name]:.4g}</span>" if name in rms else "" for name in heads)
        rows.append((f"{steps} ahead", *cells, str(samples)))
    caption = "Root mean square errors of predictions before the sample; driftfit mixes both of the next. Red: lower."
    return table(caption, ("", *heads, "samples"), rows)


def page_of_many(answer: ManyIdentified, path: Any = None) -> str:
    """One page: the table of all records, then the three that move most clearly."""
    heads, verdict = ("record", "what moves", "p", "q", "error", "of constants", "pays"), answer.verdict
    rows = [(escape(str(row.key)), *map(escape, row.cells)) for row in verdict.rows]
    shown = table("The clearest first.", heads, rows, (1,)) + _listed([*columns(answer.roles), *answer.notes])
    parts = [f"<h1>{len(rows)} records</h1>", opening(verdict.sentences), section("All records", shown)]
    for key, one in answer.worst.items():
        parts += [f"<h2>{escape(str(key))}</h2>", opening([conclusion(one)]), *body(one)]
    return written(document(f"{len(rows)} records", parts), path)


@dataclass(frozen=True)
class Identification(Printed):
    """The result of `identify` for one record; printing it shows some 25 lines.

    Attributes
    ----------
    kind, why : str
        "moves", "a static curve explains it", "both", "no drift found", or "cannot decide" and why.
    model, track, verdict
        The `ARX` model that was chosen, its run with the default tracker, and the verdict on its parameters.
    roles, structure, cause
        What each column is; what was chosen and what came second; what explains the record, in nats.
    effects, moves, memory, errors
        Effects of the inputs with constants; what changed; the lags of y; errors one step and ``horizon`` steps ahead.
    notes, undecided : tuple of str
        Problems of the data; what could not be decided.
    """

    kind: str
    why: str
    model: ARX
    track: Track = field(repr=False)
    verdict: Verdict = field(repr=False)
    roles: Roles = field(repr=False)
    structure: Structure
    cause: Cause = field(repr=False)
    effects: tuple[Effect, ...]
    moves: tuple[Move, ...]
    memory: Memory
    errors: tuple[Errors, ...]
    notes: tuple[str, ...]
    undecided: tuple[str, ...]
    source: tuple[str, ...]

    @property
    def code(self) -> int:
        """Exit code of the command: 0 answered, 1 undecided."""
        return int(self.kind == "cannot decide")

    @property
    def effect(self) -> str:
        """What the effects are: there may be no long run, and without inputs there is only a level."""
        lasting = "static gain" if self.model.input_names else "level"
        return "effect in a sample" if self.memory.root else lasting

    @cached_property
    def curve(self) -> Track:
        """A Hammerstein-Wiener model with constants and a curve of each input that bends, of all if the output does."""
        model, bent = self.model, "".join(self.cause.of)
        ends = {name: (float(np.nanmin(x)), float(np.nanmax(x)))
                for name, x in zip(model.input_names, self.track.u.T, strict=True)}  # fmt: skip
        bases = [Legendre(3, ends[name]) if f"[{name}]" in bent or "[" not in bent else None for name in ends]
        nb, nk = zip(*model.lags, strict=True)
        curved = HammersteinWiener(model.na, nb, nk, input=bases, inputs=model.input_names, intercept=True)
        fitted: Track = track(curved, RLS(1.0), **self.roles.signals(model.input_names))
        return fitted

    def live(self, **settings: Any) -> Live:
        """The stream that continues the record, with an alarm armed: what came after the last change is its reference.

        ``settings`` are those of `Track.detect`. ValueError where too few samples came after the change.
        """
        run, since = self.track, max((move.end for move in self.moves), default=0)
        stream = Live(run.model, run.tracker, self.roles.dt if self.roles.clock else None, warm_start=run)
        stream.detect(run.detect(reference=(since, len(run)), **settings).rule)
        return stream

    headline = property(conclusion)
    json, plot, page = as_json, figure, html

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for style, line in lines(self):
            yield Text(line, style, no_wrap=style == "dim", overflow="ignore")


@dataclass(frozen=True)
class ManyIdentified(Printed):
    """The result of `identify` for records with one structure: the fleet, its verdicts, the clearest three by key."""

    model: ARX
    track: Fleet = field(repr=False)
    verdict: ManyVerdicts = field(repr=False)
    worst: Mapping[Any, Identification]
    roles: Roles = field(repr=False)
    notes: tuple[str, ...]
    source: tuple[str, ...]
    page = page_of_many

    @property
    def headline(self) -> str:
        """The answer in a sentence."""
        return self.verdict.sentences[0]

    @property
    def code(self) -> int:
        """Exit code of the command: 1 if no record could be judged."""
        return int(all(row.drifts is None for row in self.verdict.rows))

    def json(self) -> dict[str, Any]:
        """The records by key, and in ``worst`` the clearest as for one record."""
        rows = {str(row.key): {"moves": row.drifts, "p": row.verdict.p, "q": row.q} for row in self.verdict.rows}
        worst = {str(key): one.json() for key, one in self.worst.items()}
        shown = {"schema": f"{NAME}/records", "headline": self.headline, "model": repr(self.model), "notes": self.notes}
        return dict(finite(shown | {"roles": self.roles.plain, "records": rows, "worst": worst}))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        first = f"{len(self.verdict)} records with one structure: {self.model!r}"
        said = (first, *columns(self.roles), f"Data: {'; '.join(self.notes)}." if self.notes else "")
        yield Text("\n".join(f" {line}" for text in said for line in wrap(text, WIDTH - 1)))
        yield self.verdict
        for key, one in self.worst.items():
            yield Text("\n " + "\n ".join(wrap(f"{key}: {one.headline}", WIDTH - 1)))

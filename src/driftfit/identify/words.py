"""The answer in words: the headline, and the lines of the terminal."""

from __future__ import annotations

from pathlib import PurePath
from textwrap import wrap
from typing import TYPE_CHECKING

from driftfit.identify.judgement import Move
from driftfit.identify.structure import Shape
from driftfit.judge.verdict import p_equals
from driftfit.show.text import WIDTH

if TYPE_CHECKING:
    from driftfit.identify.answer import Identification

UNITS = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))


def number(value: float) -> str:
    """Three digits, without an exponent below a million."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def duration(answer: Identification, samples: int) -> str:
    """A number of samples, where the record has dates as a time."""
    if not answer.roles.dated:
        return f"{samples} sample{'' if samples == 1 else 's'}"
    seconds = samples * answer.roles.step
    size, unit = next((one for one in UNITS if seconds >= 2.0 * one[0]), UNITS[-1])
    return f"{seconds / size:.3g} {unit}"


def delay(answer: Identification, name: str) -> str:
    """The delay of an input, a range where several are as good."""
    low, high = answer.structure.delays[answer.roles.inputs.index(name)]
    if high == 0:
        return "at once"
    return (
        f"delay {duration(answer, high)}"
        if low == high
        else f"delay {duration(answer, low)} to {duration(answer, high)}"
    )


def headline(answer: Identification) -> str:
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
    more = f"; and {len(said) - 2} more changes" if len(said) > 2 else ""
    text = f"{'; '.join(said[:2])}{more}; tracking {gain}."
    return (f"Both: {curve(answer)}. Besides this: " if answer.kind == "both" else "") + text[0].upper() + text[1:]


def curve(answer: Identification) -> str:
    """What the curve is made of."""
    nats = f"{answer.cause.curve[0]:.0f} nats over a straight line"
    return f"the effects depend on the working point ({', '.join(answer.cause.products)}; {nats})"


def sentences(answer: Identification) -> list[str]:
    """What every event did."""
    events: dict[tuple[str, int], list[Move]] = {}
    for move in answer.moves:
        events.setdefault((move.kind, move.at), []).append(move)
    return [_event(answer, own) for own in events.values()]


def _event(answer: Identification, own: list[Move]) -> str:
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


def structure_text(answer: Identification, shape: Shape) -> str:
    """A structure in short."""
    each = (f", {answer.roles.inputs[j]} {nk}{f' to {nk + nb - 1}' if nb > 1 else ''}" for j, nb, nk in shape[1])
    return f"{shape[0]} lag{'' if shape[0] == 1 else 's'} of {answer.roles.output}{''.join(each)}"


def chosen(answer: Identification) -> list[str]:
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


def columns(answer: Identification) -> list[str]:
    """The roles, with the options that change them."""
    roles = answer.roles
    step = duration(answer, 1) if roles.dated else f"{roles.step:g}"
    clock = f"{roles.clock}, every {step} (--time, --dt)" if roles.clock else "none, rows are even (--time)"
    said = [f"Output {roles.output} (--y); inputs {', '.join(roles.inputs) or 'none'} (--u, --not-u); time {clock}."]
    left = ", ".join(f"{name} ({why})" for name, why in roles.why.items())
    return [*said, f"Not inputs: {left}."] if left else said


def commands(answer: Identification) -> list[str]:
    """Three lines to copy."""
    model, roles = answer.model, answer.roles
    nb, nk = ("/".join(str(one[i]) for one in model.lags) for i in (0, 1))
    inputs = f" --u '{','.join(model.input_names)}'" if model.input_names else ""
    given = f"{answer.source} --y {roles.output}{inputs} --model arx:{model.na},{nb or 0}{nk and f',nk={nk}'},intercept"
    given += f" --time {roles.clock} --dt {roles.step:g}{'s' if roles.dated else ''}" if roles.clock else ""
    served = f"driftfit serve {PurePath(answer.source).stem}.toml   # the unit is on the page"
    return [f"driftfit track {given}", f"driftfit detect {given}", served]


def unit(answer: Identification) -> str:
    """The unit of a service, as TOML."""
    names = ", ".join(f'"{name}"' for name in answer.model.input_names)
    dt = f'dt = "{answer.roles.step:g}s"\n' if answer.roles.dated else ""
    return (f'[[unit]]\nname = "{PurePath(answer.source).stem}"\ny = "{answer.roles.output}"\nu = [{names}]\n{dt}'
            f'model = "{answer.model!r}"\ntracker = "AdaptiveKalman()"\nalarm = {{ every = "1 week" }}\n')  # fmt: skip


def lines(answer: Identification) -> list[tuple[str, str]]:
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

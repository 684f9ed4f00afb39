"""The answer in words: the headline, and the lines of the terminal."""

from __future__ import annotations

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
    """Three digits, and no exponent for ordinary numbers."""
    text = f"{value:.3g}"
    return f"{value:.0f}" if "e+" in text and abs(value) < 1e6 else text


def duration(answer: Identification, samples: int) -> str:
    """A number of samples as a time, where the record has dates."""
    roles = answer.roles
    if roles.time is None or roles.time.dtype.kind != "M":
        return f"{samples} sample{'' if samples == 1 else 's'}"
    seconds = samples * roles.step
    size, unit = next((one for one in UNITS if seconds >= 2.0 * one[0]), UNITS[-1])
    return f"{seconds / size:.3g} {unit}"


def effect(answer: Identification) -> str:
    """What the effects of inputs are: those in a sample where there may be no long run."""
    return "effect in a sample" if answer.memory.root else "static gain"


def delay(answer: Identification, name: str) -> str:
    j = answer.roles.inputs.index(name)
    low, high = answer.structure.delays.get(j, (answer.structure.lags[j][1],) * 2)
    if high == 0:
        return "at once"
    most = duration(answer, high)
    return f"delay {most}" if low == high else f"delay {duration(answer, low).split()[0] if low else 0} to {most}"


def headline(answer: Identification) -> str:
    """The answer in one sentence or two."""
    output, gain = answer.roles.output, _gain(answer)
    if answer.kind == "cannot decide":
        return f"Cannot decide: {answer.why}."
    if answer.kind == "a static curve explains it":
        return f"A static curve explains it, and nothing moves in time: {curve(answer)}."
    if answer.kind == "no drift found":
        least = [f"that of {one.name} by {number(one.least)} from {number(one.gain)}" for one in answer.effects]
        seen = (
            f" Seen would have been a change of the effect, half-way and in 4 of 5 records, {'; '.join(least)}."
            if least
            else ""
        )
        return f"No drift found in {output} ({p_equals(answer.verdict.p)}).{seen}"
    said = sentences(answer)
    text = f"{'; '.join(said[:2])}{f'; and {len(said) - 2} more changes' if len(said) > 2 else ''}; {gain}."
    text = text[0].upper() + text[1:]
    return f"Both: {curve(answer)}. Besides this: {text}" if answer.kind == "both" else text


def curve(answer: Identification) -> str:
    """What the curve is made of."""
    made = ", ".join(answer.cause.products) or "products of regressors and signals"
    return f"the effects depend on the working point ({made}; {answer.cause.curve[0]:.0f} nats over a straight line)"


def _gain(answer: Identification) -> str:
    rms = answer.errors[0].rms
    change = 100.0 * (1.0 - rms["driftfit"] / rms["constants"]) if rms["constants"] > 0.0 else 0.0
    return f"tracking lowers the error {change:.0f} %" if change >= 0.5 else "tracking does not lower the error"


def sentences(answer: Identification) -> list[str]:
    """What every event did, in static gains."""
    events: dict[tuple[str, int], list[Move]] = {}
    for move in answer.moves:
        events.setdefault((move.kind, move.at), []).append(move)
    return [_event(answer, own) for own in events.values()]


def _event(answer: Identification, own: list[Move]) -> str:
    one, output = own[0], answer.roles.output
    whats = {"memory": f"the memory of {output} (sum of its lags)", "level": f"the level of {output} (at mean inputs)"}
    parts = []
    for move in own:
        what = whats.get(move.what) or f"the effect of {move.what} on {output} ({delay(answer, move.what)})"
        does = "wandered" if one.kind == "wandering" else verb(move)
        parts.append(f"{what} {does} from {number(move.before)} to {number(move.after)}")
    when = f"on {one.first}" if one.first == one.last else f"between {one.first} and {one.last}"
    when = {"gradual": f"gradually from {one.first} to {one.last}", "wandering": "over the whole record"}.get(
        one.kind, when
    )
    back = ", and was then as before" if one.kind == "temporary" else ""
    instead = f" (or {' or '.join(one.instead)} did)" if one.instead else ""
    return f"{', '.join(parts)} {when}{back}{instead}"


def verb(move: Move) -> str:
    """fell or rose; of a negative effect, which has no plain direction, weakened or grew stronger."""
    if move.before < 0.0 and move.after < 0.0:
        return "grew stronger" if move.after < move.before else "weakened"
    return "rose" if move.after > move.before else "fell"


def structure_text(answer: Identification, shape: Shape) -> str:
    """A structure in short."""
    na, inputs = shape
    names = answer.roles.inputs
    each = (f"{names[j]} {nk}" + (f" to {nk + nb - 1}" if nb > 1 else "") for j, nb, nk in inputs)
    return f"{na} lags of {answer.roles.output}" + "".join(f", {one}" for one in each)


def chosen(answer: Identification) -> list[str]:
    """What was chosen, and what came second."""
    found, names = answer.structure, answer.roles.inputs
    lines = [f"Chosen: {structure_text(answer, found.shape)} (lags in samples); sum of the lags of "
             f"{answer.roles.output} {answer.memory[0]:.3f} +- {answer.memory[1]:.2g}."]  # fmt: skip
    if found.second:
        shape, behind, error = found.second[0]
        lines.append(f"Second: {structure_text(answer, shape)}, {behind:.1f} +- {error:.1f} nats behind.")
    moving = {move.what for move in answer.moves}
    idle = [name for j, name in enumerate(names) if j not in found.lags]
    steady = [names[j] for j in sorted(found.lags) if names[j] not in moving]
    if steady and moving:
        lines.append(f"Constant: {', '.join(steady)}.")
    if idle:
        lines.append(f"Not needed: {', '.join(idle[:8])}{f' and {len(idle) - 8} more' if len(idle) > 8 else ''}.")
    if found.forecast is not None:
        other = structure_text(answer, found.forecast.shape)
        lines.append(f"An input at once explains {answer.roles.output}, it does not forecast it; for that: {other}.")
    return lines


def columns(answer: Identification) -> list[str]:
    """The roles, with the options that change them."""
    roles = answer.roles
    step = (
        ""
        if roles.time is None
        else f", every {duration(answer, 1)} (--dt)"
        if roles.time.dtype.kind == "M"
        else f", every {roles.step:g} (--dt)"
    )
    lines = [f"Output {roles.output} (--y); inputs {', '.join(roles.inputs) or 'none'} (--u, --not-u); "
             f"time {roles.clock or 'none: rows are even'}{step} (--time)."]  # fmt: skip
    if roles.why:
        lines.append("Not inputs: " + ", ".join(f"{name} ({why})" for name, why in roles.why.items()) + ".")
    return lines


def commands(answer: Identification) -> list[str]:
    """Three lines to copy."""
    model, roles = answer.model, answer.roles
    inputs = f" --u '{','.join(model.input_names)}'" if model.input_names else ""
    nb, nk = ("/".join(map(str, one)) for one in ([a for a, _ in model.lags], [b for _, b in model.lags]))
    text = f"arx:{model.na},{nb or 0}" + (f",nk={nk}" if nk else "") + ",intercept"
    dt = "" if roles.time is None else f" --dt {roles.step:g}{'s' if roles.time.dtype.kind == 'M' else ''}"
    given = f"{answer.source} --y {roles.output}{inputs} --model {text}" + (
        f" --time {roles.clock}{dt}" if roles.clock else ""
    )
    return [
        f"driftfit track {given}",
        f"driftfit detect {given}",
        f"driftfit serve {_stem(answer)}.toml   # its unit is on the page",
    ]


def _stem(answer: Identification) -> str:
    return answer.source.replace("\\", "/").rsplit("/", 1)[-1].rsplit(".", 1)[0]


def unit(answer: Identification) -> str:
    """The unit of a service, as TOML."""
    model, roles = answer.model, answer.roles
    names = ", ".join(f'"{name}"' for name in model.input_names)
    dt = f'\ndt = "{roles.step:g}s"' if roles.time is not None and roles.time.dtype.kind == "M" else ""
    return (f'[[unit]]\nname = "{_stem(answer)}"\ny = "{roles.output}"\nu = [{names}]{dt}\nmodel = "{model!r}"\n'
            'tracker = "AdaptiveKalman()"\nalarm = { on = "glr" }\n')  # fmt: skip


def lines(answer: Identification) -> list[tuple[str, str]]:
    """The lines of the terminal, each with its style."""
    found = [("bold", f" {line}") for line in wrap(headline(answer), WIDTH - 1)]
    found.append(("", ""))
    for one in answer.effects:
        moved = any(move.what == one.name for move in answer.moves)
        found.append(
            (
                "",
                f" {one.name:<20} {effect(answer)} {number(one.gain):>9} +- {one.std:.2g}, {delay(answer, one.name)}{', moves' if moved else ''}",
            )
        )
    found.append(("", ""))
    for errors in answer.errors:
        rms = errors.rms
        each = ", ".join(f"{name} {number(value)}" for name, value in rms.items() if name != "tracked")
        found.append(("", f" Error {errors.steps} step{'' if errors.steps == 1 else 's'} ahead: {each}"))
    rest = [*chosen(answer), *columns(answer)]
    if answer.notes:
        rest.append(f"Data: {'; '.join(answer.notes)}.")
    if answer.undecided:
        rest.append(f"Not decided: {'; '.join(answer.undecided)}.")
    for text in rest:
        found += [("", f" {line}") for line in wrap(text, WIDTH - 1)]
    found.append(("", ""))
    return found + [("dim", f" {line}") for line in commands(answer)]

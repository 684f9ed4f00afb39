"""The files of an exported tracker: its source, a self-test, a block for Simulink and ``README.md``."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from driftfit.embedded import templates
from driftfit.embedded.functions import Translation, translation
from driftfit.embedded.values import Unit, as_code, assigned, comment, identifier, number
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.readings.first_samples import CODES, DRIFT, DT, NOISE, READING, TIMES
from driftfit.readings.first_samples import U as INPUTS
from driftfit.readings.gate import Gate
from driftfit.run.program import Program
from driftfit.streams import Live
from driftfit.trackers.base import Tracker

SAMPLES = 200
"""Of the self-test."""
BOUND = 0.001
"""Largest error of single precision, as a share of the largest usual result or of the result itself."""


def files_of(program: Program, what: str, fixed_rate: bool) -> dict[str, str]:
    """The text of every file, by its name."""
    from driftfit import __version__

    made, m = translation(program, fixed_rate), program.model.m
    header = templates.HEADER.format(
        what=comment(what), version=__version__, n=made.start["theta"].shape[1], m=m,
        names=comment(", ".join(program.names)), fields=_fields(made, made.names),
        known=templates.FIXED_RATE if fixed_rate else templates.KNOWN,
    )  # fmt: skip
    source = templates.SOURCE.format(what=comment(what)) + _source(made, program)
    readme = templates.README.format(
        what=as_code(what), names=", ".join(map(as_code, program.names)), doubles=made.layout(8).itemsize,
        singles=made.layout(4).itemsize, ops=_counted(made.entry.operations), ordinary=_after_the_start(made),
        gate="" if program.gate is None else templates.GATED.format(rows=made.start["gate_first"].shape[1]),
    )  # fmt: skip
    test = selftest(program.model, program.tracker, program.gate)
    return {
        "tracker.h": header, "tracker.c": source, "selftest.c": test, "tracker_sfun.c": templates.SFUNCTION,
        "README.md": readme,
    }  # fmt: skip


def _fields(made: Translation, names: tuple[str, ...]) -> str:
    sized = [(name, made.start[name][0].size) for name in names]
    return "\n".join(
        f"    {made.type_of(name)} {identifier(name)}{'' if size == 1 else f'[{size}]'};" for name, size in sized
    )


def _source(made: Translation, program: Program) -> str:
    """Tables, functions and the public interface."""
    memory = set(program.model.memory_for(program.steps))
    steps = "\n\n".join(function.text for function in made.unit.functions.values())
    support = _support(steps)
    start = f"static const tracker_state START = {{\n{_initial(made)}\n}};"
    tables = [body % name for body, name in made.unit.tables.items()]
    if made.scratch:
        tables.append(templates.SCRATCH.format(fields=_fields(made, made.scratch)))
    again = [] if program.gate is None else [_again(made, program)]
    return "\n\n".join([*support, *tables, start, steps, *again, _face(made, memory, bool(again))]) + "\n"


def _again(made: Translation, program: Program) -> str:
    """The function that takes in the first samples once more; settings that the caller has changed stay."""
    kept, restored = [], []
    for name in (one for one in made.names if one in program.tracker.settings()):
        name, size = identifier(name), made.start[name][0].size
        kept += [f"    const real {name} = s->{name};"] if size == 1 else [
            f"    real {name}[{size}];", f"    {_copied(name, f's->{name}', size)}"]  # fmt: skip
        restored.append(f"    {_copied(f's->{name}', name, size)}")
    columns = {"interval": DT, "noise": NOISE, "drift": DRIFT}
    factors = [f"            s->{name} = rows[k][{column}];" for name, column in columns.items() if name in made.names]
    rows, width = made.start["gate_first"].shape[1:3]
    return templates.AGAIN.format(
        rows=rows, columns=width, m=max(program.model.m, 1), kept="\n".join(kept), restored="\n".join(restored),
        codes=CODES, reading=READING, inputs=INPUTS, times=TIMES, factors="\n".join(factors), sample=_sample(made),
    ).rstrip()  # fmt: skip


def _support(steps: str) -> list[str]:
    """The functions that the steps call; those that only the double-precision build calls are not in the other."""
    in_single = re.sub(r"^#else\n.*?^#endif", "", steps, flags=re.S | re.M)
    used = {name: text for name, text in templates.SUPPORT.items() if re.search(rf"\b{name}\b", steps)}
    return [text if re.search(rf"\b{name}\b", in_single) else f"#ifndef TRACKER_SINGLE\n{text}\n#endif"
            for name, text in used.items()]  # fmt: skip


def _initial(made: Translation) -> str:
    lines = []
    for name in made.names:
        kind = "flag" if name in made.unit.flags else "real"
        values = ", ".join(assigned(number(one), kind) for one in made.start[name][0].ravel().tolist())
        lines.append(f"    {values}," if made.start[name][0].size == 1 else f"    {{{values}}},")
    return "\n".join(lines)


def _face(made: Translation, memory: set[str], gated: bool) -> str:
    copies = []
    for name in (one for one in made.names if one not in memory):
        field = identifier(name)
        copies.append(f"    {_copied(f's->{field}', f'START.{field}', made.start[name][0].size)}")
    return "\n".join([
        "void tracker_init(tracker_state *s) {", "    *s = START;", "}", "",
        "NOT_INLINED tracker_step tracker_update(tracker_state *s, tracker_real y, const tracker_real *u) {",
        "    tracker_step step;", f"    {_sample(made)}",
        *(["    if (s->gate_replay > 0) { first_samples_again(s); }"] if gated else []), "    return step;", "}", "",
        "tracker_step tracker_predict(const tracker_state *s, tracker_state *scratch, const tracker_real *u) {",
        "    *scratch = *s;", "    return tracker_update(scratch, NAN, u);", "}", "",
        "void tracker_reset(tracker_state *s) {", *copies, "}",
    ])  # fmt: skip


def _sample(made: Translation) -> str:
    """The statements that take in a sample."""
    declared, state = ("scratch_fields scratch; ", "s, &scratch") if made.scratch else ("", "s")
    return f"{declared}{made.entry.name}({state}, y, u, &step.y_hat, &step.e, &step.variance, &step.ok);"


def _copied(to: str, source: str, size: int) -> str:
    return f"{to} = {source};" if size == 1 else f"for (int i = 0; i < {size}; i++) {{ {to}[i] = {source}[i]; }}"


def _after_the_start(made: Translation) -> str:
    """The operations of an ordinary sample after the start, if others take more."""
    ordinary = _counted(_ordinary(made.unit))
    differs = ordinary != _counted(made.entry.operations)
    return f" An ordinary sample after the start takes at\n  most {ordinary}." if differs else ""


def _ordinary(unit: Unit) -> Counter[str]:
    """Operations of an ordinary sample after the start: those of routines that only others call are left out."""
    operations = {function.name: function.operations for function in unit.functions.values()}
    if "advance" not in operations:
        return operations["sample"]
    parts = (operations.get(name, Counter()) for name in ("regress", "clean", "advance", "push"))
    return sum(parts, Counter[str]())


def _counted(ops: Counter[str]) -> str:
    """Operations in words."""
    kinds = {
        "multiply": "multiplication",
        "add": "addition",
        "divide": "division",
        "square root": "square root",
        "sine": "sine",
    }
    parts = [f"{ops[kind]} {name}{'s' * (ops[kind] > 1)}" for kind, name in kinds.items() if ops[kind]]
    return ", ".join(parts[:-1]) + f" and {parts[-1]}" if len(parts) > 1 else "".join(parts)


def write(path: Path, texts: dict[str, Any]) -> None:
    """Write the files into a folder, which is created if it does not exist."""
    path.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (path / name).write_text(text, encoding="utf-8")


def record(model: Model, T: int = SAMPLES, seed: int = 0, codes: bool = False) -> tuple[Array, Array]:
    """y (T,), u (T, m): a stable system whose gain doubles, with missing data, an outage and constant inputs, and with
    fault codes, some of them among the first samples.
    """
    rng = np.random.default_rng(seed)
    m = max(model.m, 1)
    u = rng.standard_normal((T, m))
    u[T // 2 : T // 2 + T // 8] = 0.0
    y = np.zeros(T)
    for t in range(2, T):
        gain = 1.0 if t < T // 3 else 2.0
        y[t] = 0.6 * y[t - 1] - 0.1 * y[t - 2] + gain * u[t - 1].sum() + 0.1 * rng.standard_normal()
    y[rng.random(T) < 0.03] = np.nan
    y[3 * T // 4 : 3 * T // 4 + 5] = np.inf
    u[rng.random((T, m)) < 0.01] = np.nan
    if codes:
        y[[5, T // 4, T // 4 + 1, T // 2 + 40]], u[[8, T // 3 + 20], 0] = 9999.0, -999.0
    return y, u


def selftest(model: Model, tracker: Tracker, gate: Gate | None) -> str:
    """The text of the test program."""
    y, u = record(model, codes=gate is not None)
    live = Live(model, tracker, gate=gate or False)
    steps = np.array([live.update(float(y[t]), u[t, : model.m]) for t in range(SAMPLES)], dtype=float)
    scales = [
        max(float(np.max(np.abs(_finite(part)), initial=0.0)), 1e-30)
        for part in (record(model)[0], steps[:, 2], live.theta)
    ]  # without codes; fmt: skip
    last = "state.theta[i]" if len(live.theta) > 1 else "state.theta"
    return templates.SELFTEST.format(
        T=SAMPLES, m=max(model.m, 1), bound=BOUND, y=_listed(y), u=_listed(u), steps=_listed(steps), last=last,
        theta=_listed(live.theta), y_scale=repr(scales[0]), s_scale=repr(scales[1]), theta_scale=repr(scales[2]),
    )  # fmt: skip


def _finite(values: Array) -> Array:
    kept: Array = values[np.isfinite(values)]
    return kept


def _listed(values: Any) -> str:
    return ", ".join(_number(one) for one in np.ravel(values).tolist())


def _number(x: float) -> str:
    if np.isnan(x):
        return "NAN"
    return repr(x) if np.isfinite(x) else "INFINITY" if x > 0 else "-INFINITY"

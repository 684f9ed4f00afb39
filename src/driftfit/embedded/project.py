"""The files of an exported tracker: its source, a self-test, a block for Simulink and ``README.md``."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from driftfit.data.storage import fields
from driftfit.embedded.functions import as_argument, translate
from driftfit.embedded.values import (
    Function,
    Unit,
    Value,
    as_code,
    assigned,
    begin_of,
    comment,
    identifier,
    number,
    strides_of,
)
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.readings.first_samples import CODES, DRIFT, DT, NOISE, READING, TIMES
from driftfit.readings.first_samples import U as INPUTS
from driftfit.readings.gate import Gate
from driftfit.run.program import Program, State
from driftfit.streams import Live
from driftfit.trackers.base import Tracker
from driftfit.use.control import plan, room, spread_of_state, terms_of

FACTORS = ("interval", "noise", "drift")
"""Fields that describe the next sample."""

RESULTS = ("theta", "var")


@dataclass(frozen=True)
class Planning:
    """Planning inputs: the fields of its structure with their shapes, calls that return points of theta at sample k and
    a plan, and the operations of both."""

    fields: dict[str, tuple[int, ...]]
    points: str
    plan: str
    operations: tuple[Counter[str], Counter[str]]


@dataclass(frozen=True)
class Translation:
    """The functions in C, the one that takes a sample, the operations of an ordinary sample after the start, and the
    record's fields that the structure has."""

    unit: Unit
    entry: Function
    ordinary: Counter[str]
    names: tuple[str, ...]
    scratch: tuple[str, ...]
    planning: Planning | None = None

    @property
    def start(self) -> Array:
        """The record before the first sample."""
        return self.unit.record

    def type_of(self, name: str) -> str:
        """The type of a field's numbers in C."""
        if name in self.unit.flags:
            return "int"
        return "int64_t" if self.start[name].dtype.kind == "i" else "tracker_real"

    def layout(self, real: int) -> np.dtype[Any]:
        """The structure as the C compiler lays it out, when a real number has so many bytes."""
        types = {"int": "i4", "int64_t": "i8", "tracker_real": f"f{real}"}
        return np.dtype([(name, types[self.type_of(name)], self.start.dtype[name].shape[:-1]) for name in self.names],
                        align=True)  # fmt: skip

    def bytes_of(self, state: State) -> bytes:
        """The structure of the double-precision build with this state.

        Raises
        ------
        ValueError
            If a field whose value is a constant in C has another value.
        """
        for name in sorted(self.unit.replaced):
            if not np.array_equal(state[name], self.start[name][0, ..., 0], equal_nan=True):
                raise ValueError(
                    f"to_struct: the field {name!r} is {state[name].tolist()} in this stream; the exported tracker "
                    f"has {self.start[name][0, ..., 0].tolist()} as a constant."
                )
        structure = np.zeros(1, self.layout(8))
        for name in self.names:
            structure[name][0] = state[name]
        return structure.tobytes()

    def read(self, state: State, data: bytes) -> None:
        """Write the structure's bytes into the fields of a record."""
        structure = np.frombuffer(data, self.layout(8))
        for name in self.names:
            state[name][...] = structure[name][0]


@lru_cache(maxsize=16)
def translation(program: Program, fixed_rate: bool = False, horizon: int | None = None) -> Translation:
    """Translate the steps of a model and a tracker, and what plans inputs for ``horizon`` samples.

    A field that no step writes keeps the value that it starts with. Where all its entries are equal, that value becomes
    a constant of the text, and branches that it excludes are left out. A field to which steps assign only 0 and 1
    becomes an integer, because comparing numbers in double precision takes 50 cycles on a processor that does it in
    software. To find these fields we assume that none is written, and that all contain 0 or 1, translate, give up the
    assumptions that turned out wrong, and repeat until none does. Everything that the caller may change remains a
    field: the settings of the tracker and, unless the samples come at a fixed rate, the known factors of the next one.
    """
    tile = program.tile()
    update = program.drivers().update.function
    u = Value("array", "u", shape=(program.model.m,), strides=(1,))
    factors = () if fixed_rate else FACTORS
    constant = frozenset(fields(tile)) - {*factors, *RESULTS, *program.tracker.settings()}
    flags = frozenset(name for name in constant if _may_be_flag(tile[name][0]))
    scratch = frozenset(program.scratch) & {*fields(tile)}
    while True:
        unit, ordinary = (Unit(tile, constant, flags, scratch, ordinary) for ordinary in (False, True))
        entry, usual = (translate(one, update, [Value("tile"), Value("real", "y"), u]) for one in (unit, ordinary))
        if not (constant & unit.written or flags & unit.beyond):
            break
        constant, flags = constant - unit.written, flags - unit.beyond
    planning = None if horizon is None else _planning(program, unit, horizon)
    text = "\n".join(function.text for function in unit.functions.values())
    read = {*re.findall(r"\bs->(\w+)", text), *factors, *RESULTS}
    names = [name for name in fields(tile) if identifier(name) in read]
    names.sort(key=lambda name: name in flags)  # no gaps: integers last
    return Translation(unit, entry, usual.operations, tuple(names), tuple(sorted(scratch)), planning)


def _planning(program: Program, unit: Unit, h: int) -> Planning:
    """Translate `driftfit.use.control`; everything that is chosen on the controller is a field of the structure."""
    model: Any = program.model
    m, own = model.m, room(model, program.tracker, h)
    shapes: dict[str, tuple[int, ...]] = {
        "target": (h,), "given": (h, m), "low": (m,), "high": (m,), "move": (m,), "effort": (), "caution": (),
        "probe": (), **own, "P": (model.n, model.n),
    }  # fmt: skip
    p = {
        name: Value("array" if shape else "real", f"p->{name}", shape=shape, strides=strides_of(shape))
        for name, shape in shapes.items()
    }
    lanes = [
        Value("array", begin_of(one), shape=one.shape[:-1], strides=one.strides[:-1])
        for one in map(unit.field, ("y_lag", "u_lag"))
    ]
    lags, wanted, limits, work = (
        Value("items", constant=list(one))
        for one in (lanes, (p["target"], p["given"]),
                    (p["low"], p["high"], p["move"]), (p[name] for name in own))
    )  # fmt: skip
    looking = [Value("record"), p["P"], p["caution"], Value("int", "k"), p["points"]]
    planned = [Value("table", constant=terms_of(model)), lags, number(0), wanted, limits, p["effort"], p["probe"], work]
    calls, operations = [], []
    for source, arguments in ((spread_of_state, looking), (plan.function, planned)):
        made = translate(unit, source, arguments)
        calls.append(f"{made.name}({', '.join(text for one in arguments if (text := as_argument(one)))})")
        operations.append(made.operations)
    return Planning(shapes, calls[0], calls[1], (operations[0], operations[1]))


def _may_be_flag(start: Array) -> bool:
    """Whether a field is one floating-point number that starts as 0 or 1."""
    return start.size == 1 and start.dtype.kind == "f" and start.item() in (0.0, 1.0) and not np.signbit(start.item())


PLACE = Path(__file__).parent / "c"
"""Texts of the files, in which a name between two @ stands for what is written there."""
SAMPLES = 200
"""Of the self-test."""
BOUND = 0.001
"""Largest error of single precision, as a share of the largest usual result or of the result itself."""


def files_of(program: Program, what: str, fixed_rate: bool, horizon: int | None) -> dict[str, str]:
    """The text of every file, by its name."""
    from driftfit import __version__

    made, m = translation(program, fixed_rate, horizon), program.model.m
    header = filled(
        "tracker.h", what=comment(what), version=__version__, n=made.start["theta"].shape[1], m=m,
        names=comment(", ".join(program.names)), fields=_fields(made, made.names),
        known=FIXED_RATE if fixed_rate else KNOWN, control=_control(made, program, "control.h"),
    )  # fmt: skip
    readme = filled(
        "README.md", what=as_code(what), names=", ".join(map(as_code, program.names)), doubles=made.layout(8).itemsize,
        singles=made.layout(4).itemsize, ops=_counted(made.entry.operations), ordinary=_after_the_start(made),
        gate="" if program.gate is None else GATED % made.start["gate_doubt"].shape[1],
        control=_control(made, program, "control.md"),
    )  # fmt: skip
    return {
        "tracker.h": header, "tracker.c": filled("tracker.c", what=comment(what)) + _source(made, program),
        "selftest.c": selftest(program.model, program.tracker, program.gate),
        "tracker_sfun.c": filled("tracker_sfun.c"), "README.md": readme,
    }  # fmt: skip


def filled(name: str, **values: Any) -> str:
    """The text of a file with these values."""
    return re.sub(r"@(\w+)@", lambda found: str(values[found[1]]), (PLACE / name).read_text(encoding="utf-8"))


KNOWN = """Known of the next samples, and kept until changed: interval (nominal intervals since
   the sample before), noise (factor of the noise variance; INFINITY: do not use the sample) and drift (factor of the
   drift)."""
FIXED_RATE = """Samples come at a fixed rate and are all alike: one is left out by passing NAN,
   not by leaving out the call."""
GATED = """
* A gate stands before the tracker: it leaves out fault codes, spikes and frozen readings. Once, after the first
  samples, it may take them in again without the codes among them: up to %d different samples, each as often as it
  came."""


def _fields(made: Translation, names: tuple[str, ...]) -> str:
    sized = [(name, made.start[name][0].size) for name in names]
    return "\n".join(
        f"    {made.type_of(name)} {identifier(name)}{'' if size == 1 else f'[{size}]'};" for name, size in sized
    )


def _source(made: Translation, program: Program) -> str:
    """Tables, functions and the public interface."""
    memory = set(program.model.fitted_to(program.steps)[0])
    steps = "\n\n".join(function.text for function in made.unit.functions.values())
    support = _support(steps)
    start = f"static const tracker_state START = {{\n{_initial(made)}\n}};"
    tables = [body % name for body, name in made.unit.tables.items()]
    scratch = filled("scratch.c", fields=_fields(made, made.scratch) or "    int none;").rstrip()
    again = [] if program.gate is None else [_again(made, program)]
    copies = ((identifier(one), made.start[one][0].size) for one in made.names if one not in memory)
    face = filled(
        "interface.c", entry=made.entry.name,
        again="    if (s->gate_replay > 0) { first_samples_again(s); }\n" * bool(again),
        copies="\n".join(f"    {_copied(f's->{name}', f'START.{name}', size)}" for name, size in copies),
    )  # fmt: skip
    control = _control(made, program, "control.c")
    return "\n\n".join([*support, *tables, start, scratch, steps, *again, face, *([control] if control else [])])


def _control(made: Translation, program: Program, name: str) -> str:
    """A text about planning inputs, if they are planned."""
    if made.planning is None:
        return ""
    shapes, counts = made.planning.fields, made.planning.operations
    (h,), m, words = shapes["target"], program.model.m, sum(int(np.prod(shape)) for shape in shapes.values())
    first = list(shapes).index("points")
    rest = [f"    tracker_real {field}[{np.prod(shape, dtype=int)}];" for field, shape in list(shapes.items())[first:]]
    factors = [f"    scratch->{field} = 1;" for field in FACTORS if field in made.names]
    return filled(
        name, h=h, m=m, hm=h * m, doubles=8 * words, singles=4 * words, rest="\n".join(rest),
        factors="\n".join(factors),
        spread=made.planning.points.replace("s, scratch", "scratch, &work"), points=_counted(counts[0]),
        plan=_counted(counts[1]), call=made.planning.plan.replace("s->", "scratch->"),
        caution=int(program.tracker.covariance),
    ).rstrip()  # fmt: skip


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
    return filled(
        "first_samples.c", rows=rows, columns=width, m=max(program.model.m, 1), kept="\n".join(kept),
        restored="\n".join(restored),
        codes=width + CODES, reading=READING, inputs=INPUTS, times=TIMES, factors="\n".join(factors),
        entry=made.entry.name,
    ).rstrip()  # fmt: skip


def _support(steps: str) -> list[str]:
    """The functions that the steps call; those that only the double-precision build calls are not in the other."""
    in_single = re.sub(r"^#else\n.*?^#endif", "", steps, flags=re.S | re.M)
    parts = {}
    for text in (PLACE / "support.c").read_text(encoding="utf-8").strip().split("\n\n"):
        (name,) = re.findall(r"^.*?(\w+)(?:\([^)]*\) \{|;$)", text.splitlines()[0])
        parts[name] = text
    used = [(name, text) for name, text in parts.items() if re.search(rf"\b{name}\b", steps)]
    return [text if re.search(rf"\b{name}\b", in_single) else f"#ifndef TRACKER_SINGLE\n{text}\n#endif"
            for name, text in used]  # fmt: skip


def _initial(made: Translation) -> str:
    lines = []
    for name in made.names:
        kind = "flag" if name in made.unit.flags else "real"
        values = ", ".join(assigned(number(one), kind) for one in made.start[name][0].ravel().tolist())
        lines.append(f"    {values}," if made.start[name][0].size == 1 else f"    {{{values}}},")
    return "\n".join(lines)


def _copied(to: str, source: str, size: int) -> str:
    return f"{to} = {source};" if size == 1 else f"for (int i = 0; i < {size}; i++) {{ {to}[i] = {source}[i]; }}"


def _after_the_start(made: Translation) -> str:
    """The operations of an ordinary sample after the start, if others take more."""
    ordinary = _counted(made.ordinary)
    differs = ordinary != _counted(made.entry.operations)
    return f" An ordinary sample after the start takes at\n  most {ordinary}." if differs else ""


def _counted(ops: Counter[str]) -> str:
    """Operations in words."""
    kinds = {"multiply": "multiplication", "add": "addition", "divide": "division"}
    named = ((kind, kinds.get(kind, kind)) for kind in (*kinds, "square root", "sine"))
    parts = [f"{ops[kind]} {name}{'s' * (ops[kind] > 1)}" for kind, name in named if ops[kind]]
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
    usual = (record(model)[0], steps[:, 2], live.theta)  # without codes
    scales = [max(float(np.max(np.abs(part[np.isfinite(part)]), initial=0.0)), 1e-30) for part in usual]
    last = "state.theta[i]" if len(live.theta) > 1 else "state.theta"
    return filled(
        "selftest.c", T=SAMPLES, m=max(model.m, 1), bound=BOUND, y=_listed(y), u=_listed(u),
        steps=_listed(steps), last=last,
        theta=_listed(live.theta), y_scale=repr(scales[0]), s_scale=repr(scales[1]), theta_scale=repr(scales[2]),
    )  # fmt: skip


def _listed(values: Any) -> str:
    return ", ".join(_number(one) for one in np.ravel(values).tolist())


def _number(x: float) -> str:
    if np.isnan(x):
        return "NAN"
    return repr(x) if np.isfinite(x) else "INFINITY" if x > 0 else "-INFINITY"

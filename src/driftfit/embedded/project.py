"""The files of an exported tracker: its source, a self-test, a block for Simulink and ``README.md``."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

from driftfit.embedded.selftest import selftest
from driftfit.embedded.simulink import SFUNCTION
from driftfit.embedded.translation import Translation, translation
from driftfit.embedded.unit import Unit
from driftfit.embedded.values import assigned, number
from driftfit.run.program import Program

HEADER = """\
/* {what}

   Written by driftfit {version}: standalone C99 without heap and without global state. Compile with -ffp-contract=off:
   the double build then gives the same bits as driftfit. -DTRACKER_SINGLE computes in single precision. */
#ifndef DRIFTFIT_TRACKER_H
#define DRIFTFIT_TRACKER_H

#include <stdint.h>

#ifdef TRACKER_SINGLE
typedef float tracker_real;
#else
typedef double tracker_real;
#endif

#define TRACKER_PARAMETERS {n}
#define TRACKER_INPUTS {m}
/* theta: {names} */

/* The state of one stream, which the caller owns. Results: theta and var (the variances of theta, INFINITY for what the
   data have not distinguished yet). {known} */
typedef struct {{
{fields}
}} tracker_state;

typedef struct {{
    tracker_real y_hat;    /* prediction of y before it came; NAN where there is none */
    tracker_real e;        /* innovation y - y_hat; NAN where the sample was not used */
    tracker_real variance; /* of the innovation */
    int ok;                /* 1 where the sample was used */
}} tracker_step;

/* The state before the first sample. */
void tracker_init(tracker_state *s);

/* Take in one sample: y (NAN where it is missing) and TRACKER_INPUTS inputs. */
tracker_step tracker_update(tracker_state *s, tracker_real y, const tracker_real *u);

/* What tracker_update would predict for these inputs; only *scratch is changed. */
tracker_step tracker_predict(const tracker_state *s, tracker_state *scratch, const tracker_real *u);

/* Forget what is known of theta and keep the past signals, as after maintenance. */
void tracker_reset(tracker_state *s);

#endif
"""

KNOWN = """Known of the next samples, and kept until changed: interval (nominal intervals since
   the sample before), noise (factor of the noise variance; INFINITY: do not use the sample) and drift (factor of the
   drift)."""
FIXED_RATE = """Samples come at a fixed rate and are all alike: one is left out by passing NAN,
   not by leaving out the call."""

SOURCE = """\
/* {what}; see tracker.h. */
#include "tracker.h"

#include <math.h>

typedef tracker_real real;

#define R(x) ((real)(x))
#ifdef TRACKER_SINGLE
#define WIDE(wide, narrow) ((real)(narrow))
#define R_SQRT(x) sqrtf(x)
#define R_ABS(x) fabsf(x)
#else
#define WIDE(wide, narrow) ((real)(wide))
#define R_SQRT(x) sqrt(x)
#define R_ABS(x) fabs(x)
#endif

#if defined(__GNUC__) /* a copy of tracker_update in tracker_predict would cost code, and a call per sample */
#define NOT_INLINED __attribute__((noinline))
#else
#define NOT_INLINED
#endif

"""

SUPPORT = {
    "real_minimum": "static real real_minimum(real a, real b) { return b < a ? b : a; }",
    "real_maximum": "static real real_maximum(real a, real b) { return b > a ? b : a; }",
    "whole_minimum": "static int64_t whole_minimum(int64_t a, int64_t b) { return b < a ? b : a; }",
    "whole_maximum": "static int64_t whole_maximum(int64_t a, int64_t b) { return b > a ? b : a; }",
    "whole_abs": "static int64_t whole_abs(int64_t a) { return a < 0 ? -a : a; }",
    "real_square": "static real real_square(real a) { return a * a; }",
    "from_bits": """static double from_bits(int64_t bits) {
    union { int64_t whole; double number; } both;
    both.whole = bits;
    return both.number;
}""",
    "bits_of": """static int64_t bits_of(double number) {
    union { int64_t whole; double number; } both;
    both.number = number;
    return both.whole;
}""",
    "four": "typedef struct { real at[4]; } four;",
    "four_of": "static four four_of(real x) { four v = {{x, x, x, x}}; return v; }",
    "four_at": "static four four_at(const real *x) { four v = {{x[0], x[1], x[2], x[3]}}; return v; }",
    "four_plus": """static four four_plus(four a, four b) {
    for (int i = 0; i < 4; i++) { a.at[i] = a.at[i] + b.at[i]; }
    return a;
}""",
    "four_times": """static four four_times(four a, four b) {
    for (int i = 0; i < 4; i++) { a.at[i] = a.at[i] * b.at[i]; }
    return a;
}""",
    "four_reached": """static int64_t four_reached(four a, four b) {
    int64_t count = 0;
    for (int i = 0; i < 4; i++) { count += a.at[i] >= b.at[i]; }
    return count;
}""",
}
"""The functions that translated steps may call."""

README = """\
# {what}

`tracker.h`, `tracker.c`: the tracker in C99; `selftest.c`: recorded samples and the bits that they must give;
`tracker_sfun.c`: an S-function that makes it a Simulink block.

    cc -std=c99 -O2 -ffp-contract=off -o selftest tracker.c selftest.c -lm && ./selftest

* Parameters: {names}.
* State: {doubles} bytes in double precision, {singles} with `-DTRACKER_SINGLE`. No heap, no global state, no recursion.
* An update takes at most {ops}.
  Loops are counted at their longest, and of two branches the dearer.{ordinary}
* From the library: `sqrt` and `fabs` where they are used; with `-DTRACKER_SINGLE` also `expf` and `logf`.
* `-ffp-contract=off` keeps products and sums apart, which gcc in its default mode may fuse; never use `-ffast-math`.

```c
tracker_state state;
tracker_init(&state);
for (;;) {{
    tracker_step step = tracker_update(&state, y, u); /* then use state.theta, state.var, step.e */
}}
```

`driftfit.embedded.from_struct(model, tracker, bytes)` opens a state of the double build in Python, and
`to_struct(live)` gives the bytes back.
"""


def files_of(program: Program, what: str, fixed_rate: bool) -> dict[str, str]:
    """The text of every file, by its name."""
    from driftfit import __version__

    made, m = translation(program, fixed_rate), program.model.m
    names = ", ".join(program.names)
    header = HEADER.format(
        what=what, version=__version__, n=made.start["theta"].shape[1], m=m, names=names, fields=_fields(made),
        known=FIXED_RATE if fixed_rate else KNOWN,
    )  # fmt: skip
    source = SOURCE.format(what=what) + _source(made, set(program.model.memory_for(program.steps)))
    readme = README.format(
        what=what, names=names, doubles=made.layout(8).itemsize, singles=made.layout(4).itemsize,
        ops=_counted(made.entry.operations), ordinary=_after_the_start(made),
    )  # fmt: skip
    test = selftest(program.model, program.tracker)
    return {
        "tracker.h": header, "tracker.c": source, "selftest.c": test, "tracker_sfun.c": SFUNCTION, "README.md": readme
    }  # fmt: skip


def _fields(made: Translation) -> str:
    lines = []
    for name in made.names:
        size = made.start[name][0].size
        lines.append(f"    {made.type_of(name)} {name}{'' if size == 1 else f'[{size}]'};")
    return "\n".join(lines)


def _source(made: Translation, memory: set[str]) -> str:
    """Tables, functions and the public interface."""
    steps = "\n\n".join(function.text for function in made.unit.functions.values())
    support = _support(steps)
    start = f"static const tracker_state START = {{\n{_initial(made)}\n}};"
    tables = [body % name for body, name in made.unit.tables.items()]
    return "\n\n".join([*support, *tables, start, steps, _face(made, memory)]) + "\n"


def _support(steps: str) -> list[str]:
    """The functions that the steps call; those that only the double-precision build calls are not in the other."""
    in_single = re.sub(r"^#else\n.*?^#endif", "", steps, flags=re.S | re.M)
    used = {name: text for name, text in SUPPORT.items() if re.search(rf"\b{name}\b", steps)}
    return [text if re.search(rf"\b{name}\b", in_single) else f"#ifndef TRACKER_SINGLE\n{text}\n#endif"
            for name, text in used.items()]  # fmt: skip


def _initial(made: Translation) -> str:
    lines = []
    for name in made.names:
        kind = "flag" if name in made.unit.flags else "real"
        values = ", ".join(assigned(number(one), kind) for one in made.start[name][0].ravel().tolist())
        lines.append(f"    {values}," if made.start[name][0].size == 1 else f"    {{{values}}},")
    return "\n".join(lines)


def _face(made: Translation, memory: set[str]) -> str:
    copies = []
    for name in made.names:
        if name in memory:
            continue
        size = made.start[name][0].size
        line = f"s->{name} = START.{name};" if size == 1 else (
            f"for (int i = 0; i < {size}; i++) {{ s->{name}[i] = START.{name}[i]; }}"
        )  # fmt: skip
        copies.append(f"    {line}")
    return "\n".join([
        "void tracker_init(tracker_state *s) {", "    *s = START;", "}", "",
        "NOT_INLINED tracker_step tracker_update(tracker_state *s, tracker_real y, const tracker_real *u) {",
        "    tracker_step step;",
        f"    {made.entry.name}(s, y, u, &step.y_hat, &step.e, &step.variance, &step.ok);",
        "    return step;", "}", "",
        "tracker_step tracker_predict(const tracker_state *s, tracker_state *scratch, const tracker_real *u) {",
        "    *scratch = *s;", "    return tracker_update(scratch, NAN, u);", "}", "",
        "void tracker_reset(tracker_state *s) {", *copies, "}",
    ])  # fmt: skip


def _after_the_start(made: Translation) -> str:
    """The operations of an ordinary sample after the start, if others take more."""
    ordinary = _counted(_ordinary(made.unit))
    differs = ordinary != _counted(made.entry.operations)
    return f" An ordinary sample after the start takes at\n  most {ordinary}." if differs else ""


def _ordinary(unit: Unit) -> Counter[str]:
    """Operations of an ordinary sample after the start: those of routines that only others call are left out, as are
    those of a `late` sample."""
    operations = {function.name: function.operations for function in unit.functions.values()}
    if "advance" not in operations:
        return operations["sample"]
    parts = (operations.get(name, Counter()) for name in ("regress", "clean", "advance", "push"))
    return sum(parts, Counter[str]()) - operations.get("late", Counter())


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

"""The page and the picture of the contests of speed, written from their results only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.show.axes import BLUE, GREY, new_figure
from lab.bench.causes import SPEED_CAUSES
from lab.bench.computer import computer, markdown, versions
from lab.bench.contest import SAME, Finish, Line
from lab.bench.speed import SEED, slope
from lab.bench.speed_process import Start

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Slopes = dict[str, tuple[Array, Array, str]]

INTRODUCTION = f"""\
Written by `python -m lab bench speed --out docs`, which prints every figure. Linear algebra uses one thread. The
compared programs take turns within one process, and figures are medians, so that a busy machine slows all of them.

| column | meaning |
|---|---|
| *times ours* | above 1 slower than driftfit, below 1 faster |
| *same numbers* | largest difference of the estimates relative to the largest estimate; above {SAME:g} they differ |
| other | a different algorithm, shown only for its cost |"""

FLOORS, FIXED, BYTES = "Floors", "C, fixed n", "streaming the bytes"
"""How titles of the contests with the compiled loop begin, and the lines below it."""

OTHERS = "## What a user waits for"
"""From this heading on the page holds what scripts in ``benchmarks/`` print."""

FACTORS = """\
Seconds are medians over fresh processes in which numpy is already imported; MB are sizes of files without numpy.
The first result is that of a thousand samples."""


def duration(ns: float) -> str:
    """Nanoseconds in a unit that reads well."""
    return f"{ns:.1f} ns" if ns < 1e3 else f"{ns / 1e3:.1f} µs" if ns < 1e6 else f"{ns / 1e6:.1f} ms"


def agreement(line: Line) -> str:
    """How the numbers compare."""
    if np.isnan(line.difference):
        return "other"
    return f"{'yes' if line.difference < SAME else 'DIFFER'}, {line.difference:.0e}"


def section(finish: Finish) -> str:
    """One contest."""
    parts = [f"## {finish.title}"]
    if finish.note:
        parts.append(f"{finish.note[0].upper()}{finish.note[1:]}.")
    if finish.lines:
        rows = [[x.name, duration(x.ns), f"{x.ratio:.2f}", agreement(x)] for x in finish.lines]
        rows[0][-1] = ""
        parts.append(markdown(["", "a step", "times ours", "same numbers"], rows))
    if finish.absent:
        parts.append(f"Absent, left out: {', '.join(finish.absent)}.")
    return "\n\n".join(parts)


def floors(finishes: Sequence[Finish]) -> str:
    """The compiled loop, what its arithmetic takes in C, and what its memory takes, in one table."""
    rows = []
    for finish in finishes:
        others = {line.name: line for line in finish.lines[1:]}
        cells = [duration(others[name].ns) if name in others else "–" for name in (FIXED, BYTES)]
        ratio = f"{others[FIXED].ratio:.2f}" if FIXED in others else "–"
        rows.append([finish.title.removeprefix(f"{FLOORS}, "), duration(finish.lines[0].ns), cells[0], ratio, cells[1]])
    heads = ["", "compiled loop", FIXED, "times ours", BYTES]
    return f"## {FLOORS}\n\nThe compiled loop alone, including the ARX memory; a step.\n\n{markdown(heads, rows)}"


def losses(finishes: Sequence[Finish]) -> list[str]:
    """Every line of a peer that is faster than ours, floors and ourselves left out."""
    return [
        f"* {finish.title}: {line.name} needs {line.ratio:.2f} of our time."
        for finish in finishes
        for line in finish.lines[1:]
        if line.ratio < 1.0 and not line.name.startswith(("driftfit", "C,", "streaming"))
    ]


def start_table(starts: tuple[Sequence[Start], Sequence[str]]) -> str:
    """Import, first result and size."""
    rows = [
        [s.name, f"{s.seconds_import:.2f}", f"{s.seconds_first:.2f}", f"{s.own:.1f}", f"{s.closure:.0f}"]
        for s in starts[0]
    ]
    text = markdown(["", "import, s", "first result, s", "own, MB", "with all it needs, MB"], rows)
    return f"{text}\n\nAbsent, left out: {', '.join(starts[1])}." if starts[1] else text


def growth_table(slopes: Slopes) -> str:
    """Exponents."""
    rows = [
        [name, what, f"{sizes[0]:,.0f} to {sizes[-1]:,.0f}", f"{slope(sizes, seconds):.2f}"]
        for name, (sizes, seconds, what) in slopes.items()
    ]
    return markdown(["cost against", "of", "sizes", "slope"], rows)


def page(finishes: Sequence[Finish], slopes: Slopes, starts: tuple[Sequence[Start], Sequence[str]], quick: bool) -> str:
    """The whole page as markdown."""
    lost = losses(finishes)
    parts = ["# Scoreboard: speed", INTRODUCTION, f"{computer()}. {versions()}. Seed {SEED}."]
    if quick:
        parts.append("**Quick form: small sizes, few repeats; not to be quoted.**")
    parts += ["## Where we lose", "\n".join(lost) or "In no contest was a peer faster.", SPEED_CAUSES]
    below = [finish for finish in finishes if finish.lines and finish.title.startswith(FLOORS)]
    parts += [section(finish) for finish in finishes if finish not in below]
    parts += [floors(below)] if below else []
    parts += ["## Import, first result, size", FACTORS, start_table(starts)]
    parts += ["## How cost grows", "Slopes on log axes over the larger half of the sizes.", growth_table(slopes)]
    parts += ["![Cost against size, log axes](figures/scoreboard_speed.png)"]
    return "\n\n".join(part for part in parts if part) + "\n"


def draw(slopes: Slopes) -> Figure:
    """Seconds against every size, with the slope."""
    figure = new_figure(11.0, 3.4)
    panels = figure.subplots(1, len(slopes), squeeze=False)[0]
    for axis, (name, (sizes, seconds, what)) in zip(panels, slopes.items(), strict=True):
        axis.loglog(sizes, seconds, "o-", color=BLUE, ms=4, lw=1.2)
        exponent = slope(sizes, seconds)
        axis.loglog(sizes, seconds[-1] * (sizes / sizes[-1]) ** exponent, "--", color=GREY, lw=0.9)
        axis.set_title(f"{what}\nslope {exponent:.2f}", fontsize=8)
        axis.set_xlabel(name)
        axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
        axis.minorticks_off()
        axis.grid(alpha=0.25, lw=0.5)
    panels[0].set_ylabel("seconds")
    return figure


def write(folder: Path, text: str, slopes: Slopes) -> Path:
    """Write ``scoreboard_speed.md`` and its picture into a folder; the page's path. The end of the page stays."""
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    draw(slopes).savefig(folder / "figures" / "scoreboard_speed.png", dpi=100)
    target = folder / "scoreboard_speed.md"
    _, mark, others = target.read_text().partition(OTHERS) if target.exists() else ("", "", "")
    target.write_text(text + (f"\n{mark}{others}" if mark else ""))
    return target

"""What the pages of the docs show, compared with what their scripts print: a page that no longer holds fails.

    python -m lab pages           # a sample of the rows of each script, and the examples, as the tests do
    python -m lab pages --full    # all rows, in half an hour, and those of all benchmarks, in hours

A text block right after "Printed by `examples/NAME.py`:" is all that this example prints. A text block after
`python -m lab reproduce NAME` or a benchmark, and before another script is named, is a part of what that script prints,
unless a Python block precedes it, which prints it. A line of three dots stands for rows that are printed and that the
page leaves out. Tables of times, whose titles begin with their unit, and benchmarks that read a clock or records that
are no part of the project are not compared.
"""

from __future__ import annotations

import contextlib
import io
import re
import runpy
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated
from unittest.mock import patch

import typer
from rich.console import Console

from lab.structure import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PARTS = re.compile(
    r"```(\w*)\n(.*?)```|`(?:python\s)?((?:-m\s(?:lab\s(?!pages)|benchmarks)|examples/|benchmarks/)[^`]*)`", re.S
)
TIMES = re.compile(r"\s*(Milli|Micro|Nano)?seconds\b", re.I)
CLOCKS = re.compile(
    r"\b(perf_counter|process_time|peak_memory|getrusage|records_of|cppcheck|SparkSession|VmRSS)\b|--data"
)
SAMPLED = (
    "coarse_coverage", "coverage_of_models", "curved_outputs", "diagnose_constancy", "event_dates",
    "jump_control", "output_error", "smoothing_coverage", "smoothing_over_hypotheses",
)  # fmt: skip
"""Benchmarks of which ``--quick`` prints rows of the page, in a few seconds; others have fewer records then."""


def name_of(command: str) -> str:
    """The module of a benchmark whose rows are the same on any computer; nothing for other commands."""
    found = re.match(r"(?:-m benchmarks\.|benchmarks/)(\w+)", command)
    path = ROOT / "benchmarks" / f"{found[1]}.py" if found else ROOT
    return found[1] if found and path.is_file() and not CLOCKS.search(path.read_text(encoding="utf-8")) else ""


def shown() -> dict[str, list[str]]:
    """The text blocks of every script on all pages, by its command."""
    found: dict[str, list[str]] = {}
    for text in (page.read_text(encoding="utf-8") for page in PAGES):
        command, kind, end = "", "", 0
        for part in PARTS.finditer(text):
            if part[3]:
                command = " ".join(part[3].split())
                kind, end = ("named" if text[: part.start()].split()[-2:] == ["Printed", "by"] else ""), part.end()
                continue
            between = text[end : part.start()].strip()
            own = command.startswith("-m lab reproduce ") or bool(name_of(command))
            own = own and not (kind == "python" and not between)
            if part[1] == "text" and (own or (command.startswith("examples/") and (kind, between) == ("named", ":"))):
                found.setdefault(command, []).append(part[2])
            kind, end = part[1], part.end()
    return found


def rows(text: str) -> list[str]:
    """Lines without the spaces that depend on widths, but for tables of times."""
    tables = (table.splitlines() for table in re.split(r"\n\s*\n", text.strip()) if not TIMES.match(table))
    lines = (" ".join(line.strip("─\n ").split()) for table in tables for line in table)
    return [line for line in lines if line]


def printed(command: str, quick: bool) -> str:
    """What a script prints, all of it or, of a reproduction, a sample."""
    text, given = io.StringIO(), command.split()[1 + command.startswith("-m") :]
    argv = [command, *given, *(["--quick"] if quick else [])] if name_of(command) else [command]
    folder = patch.object(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    with contextlib.redirect_stdout(text), patch.object(sys, "argv", argv), folder, contextlib.suppress(SystemExit):
        if command.startswith("examples/") or name_of(command):
            path = f"benchmarks/{name_of(command)}.py" if name_of(command) else command
            runpy.run_path(str(ROOT / path), run_name="__main__")
        else:
            import_module(f"lab.reproduce.{command.split()[-1].replace('-', '_')}").main(quick=quick)
    return text.getvalue()


def pattern(block: str) -> str:
    """A regular expression of the lines of a block, with any lines in the place of three dots."""
    return "\n" + re.escape("\n".join([*rows(block), ""])).replace(re.escape("...\n"), r"(?:.*\n)*?")


def differences(text: str, blocks: Sequence[str], sample: bool) -> list[str]:
    """Lines of what was printed (+) that no block shows, and unless it is a sample those of a block (-) that were not
    printed, or not in its order.
    """
    lines, parts = rows(text), [rows(block) for block in blocks]
    whole = "\n".join(["", *lines, ""])
    found = [re.search(pattern(block), whole) for block in blocks]
    known = {line for part in parts for line in part} | {line for one in found if one for line in one[0].split("\n")}
    more = [f"+ {line}" for line in lines if line not in known]
    if sample:
        return more
    lost = [part for part, one in zip(parts, found, strict=True) if not one]
    return more + [f"- {line}" for part in lost for line in ([x for x in part if x not in [*lines, "..."]] or part)]


def compared(command: str, quick: bool = True) -> list[str]:
    """The differences between what a script prints and the pages."""
    return differences(printed(command, quick), shown()[command], quick and not command.startswith("examples/"))


def show(
    full: Annotated[bool, typer.Option("--full/--quick", help="All rows, or a sample.")] = False,
    only: Annotated[str, typer.Option(help="Only scripts whose command contains this.")] = "",
) -> None:
    """Compare the pages of the docs with what their scripts print."""
    asked = (command for command in shown() if full or name_of(command) in ("", *SAMPLED))
    found = {command: compared(command, not full) for command in asked if only in command}
    out = Console(width=200, highlight=False)
    for command, lines in found.items():
        out.print(f"{command}: {len(lines) or 'no'} differences", *lines, sep="\n", markup=False)
    if any(found.values()):
        raise typer.Exit(1)

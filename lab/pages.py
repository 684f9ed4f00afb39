"""What the pages of the docs show, compared with what their scripts print: a page that no longer holds fails.

    python -m lab pages           # a sample of the rows of each reproduction, and the examples, as the tests do
    python -m lab pages --full    # all rows, in half an hour

A text block right after "Printed by `examples/NAME.py`:" is all that this example prints. A text block after
`python -m lab reproduce NAME`, and before another script is named, is a part of what that reproduction prints, unless
a Python block precedes it, which prints it. Tables of times, whose titles begin with their unit, are not compared.
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
            own = command.startswith("-m lab reproduce ") and not (kind == "python" and not between)
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
    text = io.StringIO()
    with contextlib.redirect_stdout(text), patch.object(sys, "argv", [command]):
        if command.startswith("examples/"):
            runpy.run_path(str(ROOT / command), run_name="__main__")
        else:
            import_module(f"lab.reproduce.{command.split()[-1].replace('-', '_')}").main(quick=quick)
    return text.getvalue()


def differences(text: str, blocks: Sequence[str], sample: bool) -> list[str]:
    """Lines of what was printed (+) that no block shows, and unless it is a sample those of a block (-) that were not
    printed, or not in its order.
    """
    lines, parts = rows(text), [rows(block) for block in blocks]
    more = [f"+ {line}" for line in lines if not any(line in part for part in parts)]
    if sample:
        return more
    whole = "\n".join(["", *lines, ""])
    lost = [part for part in parts if "\n".join(["", *part, ""]) not in whole]
    return more + [f"- {line}" for part in lost for line in ([x for x in part if x not in lines] or part)]


def compared(command: str, quick: bool = True) -> list[str]:
    """The differences between what a script prints and the pages."""
    return differences(printed(command, quick), shown()[command], quick and command.startswith("-m lab"))


def show(
    full: Annotated[bool, typer.Option("--full/--quick", help="All rows, or a sample.")] = False,
    only: Annotated[str, typer.Option(help="Only scripts whose command contains this.")] = "",
) -> None:
    """Compare the pages of the docs with what their scripts print."""
    found = {command: compared(command, not full) for command in shown() if only in command}
    out = Console(width=200, highlight=False)
    for command, lines in found.items():
        out.print(f"{command}: {len(lines) or 'no'} differences", *lines, sep="\n", markup=False)
    if any(found.values()):
        raise typer.Exit(1)

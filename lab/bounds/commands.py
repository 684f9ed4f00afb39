"""Every option of every reduction of a bank, and its tests, in compiled routines that check their array bounds.

    python -m lab bounds                                   the tests of banks, and 60 banks drawn at random
    python -m lab bounds --banks 0 tests/test_bank_gaps.py    some tests only; of any tracker
    python -m lab bounds --first 500 --banks 250 none      banks 500 to 749, no tests
    python -m lab bounds --planted                         see that faults are found

Compiled code does not check whether an index is within its array. Here it does: a separate process with its own cache
compiles with a check at every index, of scalars and of SIMD vectors, which records the line of a violation and
continues. A test in which there was one fails. Compiling takes most of the time, and is kept for the next run.
The exit status is 1 if anything was found.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from lab.bounds.checks import settings

ROOT = Path(__file__).parents[2]
CONTRACT = ["tests/contract", "-k", "Bank or test_bank"]
"""Arguments of pytest for the tests that every tracker passes, those of banks only."""

PLANTED = {
    "an off-by-one in the reduction Decide": (
        "bank/reducing/selection.py", "for k in range(held - 1):", "for k in range(held):",
    ),
    "a table of leaves with half the room": (
        "bank/memory.py", "np.zeros((rows, children + WIDTH))", "np.zeros((rows, children // 2))",
    ),
}  # fmt: skip
"""Faults to plant: the file, a line of it, and what replaces that."""


def bounds(
    tests: Annotated[list[str] | None, typer.Argument(help="Files of tests; none: no tests.")] = None,
    banks: Annotated[int, typer.Option(help="How many banks are drawn.")] = 60,
    first: Annotated[int, typer.Option(help="The seed of the first bank.")] = 0,
    quick: Annotated[bool, typer.Option("--quick", help="Banks of one form and size.")] = False,
    planted: Annotated[bool, typer.Option("--planted", help="Plant faults, and see that they are found.")] = False,
) -> None:
    """Run banks and tests in compiled routines that check every index."""
    if planted:
        raise typer.Exit(_plant(banks))
    if tests is None:
        tests = [str(path.relative_to(ROOT)) for path in sorted((ROOT / "tests").glob("test_bank*.py"))] + CONTRACT
    raise typer.Exit(_run(ROOT, first, banks, quick, [name for name in tests if name != "none"]))


def _run(root: Path, first: int, banks: int, quick: bool, tests: list[str]) -> int:
    """In a process of its own, from the sources below ``root``."""
    own = {**os.environ, **settings(), "PYTHONPATH": f"{root / 'src'}:{root}"}
    command = [sys.executable, "-m", "lab.bounds.work", str(first), str(banks), str(quick), *tests]
    return subprocess.run(command, env=own, cwd=root, check=False).returncode


def _plant(banks: int) -> int:
    """Run banks on copies of the sources, each with a fault; returns 1 if one was not found."""
    missed = 0
    for what, (name, line, instead) in PLANTED.items():
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            for part in ("src", "lab"):
                shutil.copytree(ROOT / part, root / part, ignore=shutil.ignore_patterns("__pycache__"))
            file = root / "src" / "driftfit" / name
            text = file.read_text()
            assert text.count(line) == 1, f"{line!r} is not in {name}"
            file.write_text(text.replace(line, instead))
            found = _run(root, 0, banks, False, []) != 0
        print(f"{what}: {'found' if found else 'NOT FOUND'}", flush=True)
        missed += not found
    return int(missed > 0)

"""Planted faults: whether tests find each of them, which is to be asked before and after a test is deleted.

    python -m lab faults                  # all of them, in about an hour: a fault of a compiled step compiles it
    python -m lab faults --only gate      # those whose line in tests/faults.txt contains this

A line of the list is ``MODULE TESTS: TEXT => FAULT``, the module below src/driftfit and the tests below the root. The
text must be there once. The fault is planted in a copy of the project, and the tests must fail.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

import typer

from lab.structure import PACKAGE, ROOT

LIST = ROOT / "tests" / "faults.txt"
COPIED = ("src", "tests", "lab", "benchmarks", "examples", "docs", "pyproject.toml", "README.md")


class Fault(NamedTuple):
    """A line of the list."""

    module: str
    tests: str
    text: str
    fault: str


def faults(only: str = "") -> list[Fault]:
    """The list."""
    found = []
    for line in LIST.read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#") and only in line:
            where, change = line.split(": ", 1)
            found.append(Fault(*where.split(" "), *change.split(" => ")))
    return found


def outcome(home: Path, one: Fault) -> str:
    """Whether the tests of a fault find it, in a copy of the project."""
    path = home / PACKAGE / one.module
    whole = path.read_text(encoding="utf-8")
    if whole.count(one.text) != 1:
        return f"not planted: the text is there {whole.count(one.text)} times"
    path.write_text(whole.replace(one.text, one.fault), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-n0", "-x", "-q", "-p", "no:cacheprovider", *one.tests.split(",")]
    places = os.pathsep.join((str(home / "src"), str(home)))
    try:
        done = subprocess.run(command, cwd=home, env={**os.environ, "PYTHONPATH": places}, capture_output=True)
    finally:
        path.write_text(whole, encoding="utf-8")
    return {0: "NOT FOUND", 1: "found"}.get(done.returncode, f"pytest ended with {done.returncode}")


def show(only: Annotated[str, typer.Option(help="Only lines that contain this.")] = "") -> None:
    """Plant every fault of the list, and say which the tests find."""
    with TemporaryDirectory() as folder:
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, Path(folder) / name)
        asked = faults(only)
        found = 0
        for one in asked:
            said = outcome(Path(folder), one)
            found += said == "found"
            print(f"{said:<12}{one.module}: {one.text} => {one.fault}", flush=True)
        print(f"{found} of {len(asked)} found")
    if found < len(asked):
        raise typer.Exit(1)

"""Does the library still give the same results, to the last bit? A check for internal changes.

    python -m lab same-numbers record FOLDER      run every configuration and store its results
    python -m lab same-numbers compare FOLDER     run them again and compare bit for bit

Keep FOLDER outside the checkout. The numbers belong to one processor and one set of packages.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track as with_progress

from lab.configurations import Arrays, Configuration, configurations

app = typer.Typer(help="Run random configurations and compare what they report bit for bit.")
out, err = Console(), Console(stderr=True)

Folder = Annotated[Path, typer.Argument(help="Where results are kept; outside the checkout.")]
Only = Annotated[str, typer.Option(help="Only configurations whose name contains this.")]


def file_of(name: str) -> str:
    """A file name for a configuration that is valid on any disk."""
    return hashlib.sha256(name.encode()).hexdigest()[:16] + ".npz"


def outcome(run: Configuration) -> Arrays:
    """The results of a configuration; an error is a result too."""
    try:
        return run()
    except Exception as error:
        return {"error": np.array(f"{type(error).__name__}: {error}")}


def differences(before: Arrays, now: Arrays) -> list[str]:
    """Names of arrays that are not equal bit for bit, NaN being equal to NaN."""
    names = sorted(before.keys() | now.keys())
    return [name for name in names if not _equal(before.get(name), now.get(name))]


def _equal(one: Any, other: Any) -> bool:
    if one is None or other is None or one.shape != other.shape:
        return False
    return bool(np.array_equal(one, other, equal_nan=one.dtype.kind == "f"))


def chosen(only: str) -> list[tuple[str, Configuration]]:
    return [(name, run) for name, run in configurations() if only in name]


@app.command()
def record(folder: Folder, only: Only = "") -> None:
    """Run every configuration and store its results."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, run in with_progress(chosen(only), "recording", console=err):
        arrays = outcome(run)
        if "error" in arrays:
            err.print(f"{name}: {arrays['error']}", markup=False)
        np.savez(folder / file_of(name), **arrays)  # type: ignore[arg-type]


@app.command()
def compare(folder: Folder, only: Only = "") -> None:
    """Run them again; exit with 1 if a bit differs."""
    wrong = 0
    ran = chosen(only)
    for name, run in with_progress(ran, "comparing", console=err):
        with np.load(folder / file_of(name)) as kept:
            found = differences(dict(kept), outcome(run))
        wrong += bool(found)
        if found:
            out.print(f"{name}: {', '.join(found)}", markup=False)
    out.print(f"{len(ran) - wrong} of {len(ran)} configurations say the same.")
    raise typer.Exit(1 if wrong else 0)

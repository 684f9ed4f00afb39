"""What the default tracker consists of, and the tracker without a piece of it.

A piece is left out in one of two ways. Modes and fields of the state are changed before the first sample, by a
subclass. Rules are changed in a copy of the source, by text that must occur in it exactly once, and run in a process of
their own. So the tracker itself has no switches.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import driftfit
from driftfit import AdaptiveKalman
from driftfit.engine.kernel import Array

HOME = Path(driftfit.__file__).parent
ROOT = Path(__file__).parent.parent.parent
BANK, LEARNED = (f"trackers/mixture/{name}.py" for name in ("filters", "learned"))
State = Mapping[str, Any]
NEXT_TO_NEVER = 1e-30
"""Probability of entering a mode that is left out; at 0 its moments would be 0 / 0."""


@dataclass(frozen=True)
class Piece:
    """``modes`` (K,) tells which modes to leave out; or ``edits`` of a file, an old text and a new one. ``functions``
    are those that would go with the piece, "file:name"."""

    modes: Callable[[State], Array] | None = None
    edits: tuple[tuple[str, str, str], ...] = ()
    functions: tuple[str, ...] = ()

    def lines(self) -> int:
        """Lines of the functions that would go."""
        total = 0
        for one in self.functions:
            name, function = one.split(":")
            nodes = ast.walk(ast.parse((HOME / name).read_text()))
            (found,) = (node for node in nodes if isinstance(node, ast.FunctionDef) and node.name == function)
            total += (found.end_lineno or found.lineno) - found.lineno + 1 + len(found.decorator_list)
        return total


def never(state: dict[str, Any], out: Array) -> None:
    """Change transitions so that modes are never entered; jumps together stay as likely as they were."""
    jump = state["ratio"] >= 1.0
    before = state["arrive"][jump].sum()
    arrive = np.where(out, NEXT_TO_NEVER, state["arrive"])
    arrive[jump] *= before / arrive[jump].sum() if (jump & ~out).any() else 1.0
    start = np.where(out, NEXT_TO_NEVER, state["mu"])
    state["arrive"] = arrive
    state["mu"] = start / start.sum()


@dataclass(frozen=True)
class Without(AdaptiveKalman):
    """The default without a piece that is not a rule."""

    piece: str = ""

    def state(self, n: int) -> Mapping[str, Any]:
        from driftfit.trackers.mixture.filters import table

        state, piece, modes = dict(super().state(n)), PIECES[self.piece], table(n, self.groups)
        if piece.modes is not None:
            never(state, piece.modes(modes))
        return state


def largest(modes: State) -> Array:
    """The largest ratio of each ladder that jumps."""
    return np.asarray((modes["ratio"] >= 1.0) & (np.diff(modes["ladder"], append=-9) != 0))


def of(file: str, *names: str) -> tuple[str, ...]:
    """Names of functions of a file."""
    return tuple(f"{file}:{name}" for name in names)


PIECES: dict[str, Piece] = {
    "trend": Piece(lambda modes: modes["ladder"] == -2),
    "learned drift": Piece(
        lambda modes: modes["ladder"] == -1,
        functions=of(
            LEARNED,
            "step_back",
            "look_back",
            "diagonal",
            "whitened",
            "rotate",
            "turn",
            "remember",
            "learn_drift",
        ),
    ),
    "single ladders": Piece(lambda modes: modes["ladder"] >= 0),
    "jumps": Piece(lambda modes: modes["ratio"] >= 1.0),
    "common jumps": Piece(lambda modes: (modes["ladder"] == -3) & (modes["ratio"] >= 1.0)),
    "jumps of size 1": Piece(lambda modes: modes["ratio"] == 1.0),
    "largest jumps": Piece(lambda modes: modes["ratio"] > 1.0),
    "leading direction": Piece(
        edits=((LEARNED, "share = t[N + 6 * best, best] / positive if sound else 0.0", "share = 0.0"),),
        functions=of(LEARNED, "whitened", "rotate", "turn"),
    ),
    "arrivals in all modes": Piece(edits=((BANK, "\nJUMP, DRIFT = 2e-3, 6e-4\n", "\nJUMP, DRIFT = 2e-3, 1e-9\n"),)),
    "down the ladders": Piece(edits=((BANK, "\nDOWN, AFTER, ENDS = 1e-3,", "\nDOWN, AFTER, ENDS = 0.0,"),)),
    "jumps of any size": Piece(edits=((BANK, "    leaps = (size > 0.0) &", "    leaps = (size != size) &"),)),
    "Student's density": Piece(edits=((BANK, "\nSTUDENT = 60.0\n", "\nSTUDENT = 0.0\n"),)),
    "drift about means": Piece(
        edits=((BANK, "\nFAR = 9.0\n", "\nFAR = 1e300\n"),), functions=of(LEARNED, "learn_means")
    ),
    "coloured noise": Piece(
        edits=((LEARNED, "s.colour[l] = max(-MOST, min(MOST, known))", "s.colour[l] = 0.0 * known"),),
        functions=of(LEARNED, "whiten_noise", "learn_colour", "colour"),
    ),
    "restless noise": Piece(edits=((BANK, "\nSTAY, CALM = 0.995, 0.98\n", "\nSTAY, CALM = 1.0 - 1e-9, 1e-9\n"),)),
    "outliers": Piece(
        edits=(
            (BANK, "\nOUTLIER = 0.035\n", "\nOUTLIER = 1e-9\n"),
            (LEARNED, "RARITY, OFTEN = 70.0, 2.0, 50.0,", "RARITY, OFTEN = 70.0, 2.0, 1e12,"),
        )
    ),
    "learned rate of outliers": Piece(
        edits=((LEARNED, "RARITY, OFTEN = 70.0, 2.0, 50.0,", "RARITY, OFTEN = 70.0, 2.0, 1e12,"),)
    ),
    "repeated rounding": Piece(
        edits=(
            (BANK, "return s.alike[l] * min(", "return 0.0 * min("),
            (LEARNED, "    if s.alike[l] > 0.0:\n        return\n", ""),
        ),
        functions=of(BANK, "repeated_rounding"),
    ),
}


def copied(piece: Piece, folder: Path) -> Path:
    """The source with the edits of a piece."""
    shutil.copytree(HOME, folder / "driftfit", ignore=shutil.ignore_patterns("__pycache__"))
    for name, old, new in piece.edits:
        path = folder / "driftfit" / name
        text = path.read_text()
        if text.count(old) != 1:
            raise ValueError(f"{name} has {text.count(old)} times the text that a piece replaces: {old!r}.")
        path.write_text(text.replace(old, new))
    return folder


def run_without(piece: Piece, arguments: Iterable[str]) -> None:
    """``python -m benchmarks.ablation`` with these arguments on the source without a piece."""
    with TemporaryDirectory() as folder:
        source = copied(piece, Path(folder))
        paths = [str(source), os.environ.get("PYTHONPATH", "")]
        command = [sys.executable, "-m", "benchmarks.ablation", *arguments]
        subprocess.run(
            command, cwd=ROOT, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, check=True,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip

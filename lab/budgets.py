"""The budgets of the house: what there is of the library, computed from its source and its programs, with limits.

    python -m lab budgets

A limit is lowered when something is earned and is not raised; `docs/design.md` says which additions were allowed for.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from rich.console import Console

import driftfit
from driftfit import ARX, FLS, RLS, AdaptiveKalman, Gate, Kalman, track
from driftfit.engine.drivers import TrackerSteps
from driftfit.models.base import Model
from driftfit.run.program import Program
from driftfit.show.text import table_of
from driftfit.trackers.base import Tracker
from lab.structure import ROOT, present

LIMITS = {
    "lines of the library": 66_173,
    "statements": 42_972,
    "modules": 324,
    "levels of folders": 2,
    "constants of modules with numbers": 604,
    "numbers in the source": 2_309,
    "private names of Numba and llvmlite": 27,
    "modules that the Kalman filter imports": 24,
    "lines of them": 5_126,
    "modules that detection imports": 93,
    "modules that a second call of track passes": 9,
    "members of Tracker": 38,
    "members of Model": 26,
    "members of TrackerSteps": 17,
    "state fields of Kalman": 36,
    "state fields of RLS": 46,
    "state fields of FLS": 39,
    "state fields of AdaptiveKalman": 72,
    "state fields of a gate": 31,
    "bytes of state of Kalman": 840,
    "bytes of state of AdaptiveKalman": 11_256,
    "lines of tests": 33_004,
}
"""State is that of ARX(2, 2) with n = 4, fields of the model and of the driver included, without a gate."""

CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")
PRIVATE = re.compile(r"(numba\.(core|np|typed|misc|cpython)|llvmlite)\b")
PLAIN = (0, 1, 2, 0.5)
TRACKERS = (Kalman(q=1e-4, r=1.0), RLS(forgetting=0.99), FLS(mu=1.0), AdaptiveKalman())


def budgets() -> dict[str, int]:
    """What there is, by the names of `LIMITS`."""
    house = present()
    trees = [ast.parse(text) for text in house.sources.values()]
    lines = {name: len(text.splitlines()) for name, text in house.modules.items()}
    kalman, detect = (house.reached(module) for module in ("trackers.kalman", "judge.alarms.detect"))
    programs = {type(one).__name__: Program(ARX(2, 2), one) for one in TRACKERS}
    gated = Program(ARX(2, 2), TRACKERS[0], gate=Gate())
    fields = {f"state fields of {name}": len(one.layout.shapes) for name, one in programs.items()}
    tests = [file for place in ("tests", "lab/tests") for file in (ROOT / place).rglob("*.py")]
    return {
        "lines of the library": sum(lines.values()),
        "statements": sum(isinstance(node, ast.stmt) for tree in trees for node in ast.walk(tree)),
        "modules": len(house.modules),
        "levels of folders": max(path.count("/") for path in house.sources),
        "constants of modules with numbers": sum(_holds_number(node) for tree in trees for node in tree.body),
        "numbers in the source": sum(_is_number(node) and node.value not in PLAIN for node in _constants(trees)),
        "private names of Numba and llvmlite": sum(_private(node) for tree in trees for node in ast.walk(tree)),
        "modules that the Kalman filter imports": len(kalman),
        "lines of them": sum(lines[name] for name in kalman),
        "modules that detection imports": len(detect),
        "modules that a second call of track passes": _passed(),
        "members of Tracker": _members(Tracker),
        "members of Model": _members(Model),
        "members of TrackerSteps": len(TrackerSteps._fields),
        **fields,
        "state fields of a gate": len(gated.layout.shapes) - fields["state fields of Kalman"],
        "bytes of state of Kalman": 8 * programs["Kalman"].layout.size,
        "bytes of state of AdaptiveKalman": 8 * programs["AdaptiveKalman"].layout.size,
        "lines of tests": sum(len(one.read_text(encoding="utf-8").splitlines()) for one in tests),
    }


def _constants(trees: list[ast.Module]) -> Iterator[ast.Constant]:
    yield from (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant))


def _is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def _holds_number(node: ast.stmt) -> bool:
    """Whether a statement gives a constant a value in which there is a number."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return False
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    names = [one.id for one in getattr(target, "elts", [target]) if isinstance(one, ast.Name)]
    return bool(names) and all(map(CONSTANT.fullmatch, names)) and any(map(_is_number, ast.walk(node.value)))


def _private(node: ast.AST) -> int:
    """How many private names of the compiler a node takes."""
    if isinstance(node, ast.ImportFrom):
        return len(node.names) if PRIVATE.match(node.module or "") else 0
    if isinstance(node, ast.Import):
        return sum(bool(PRIVATE.match(one.name)) for one in node.names)
    return int(isinstance(node, ast.Attribute) and bool(PRIVATE.match(ast.unparse(node))))


def _passed() -> int:
    """How many modules of the library the second call of `track` on one series of arrays passes."""
    files: set[str] = set()

    def see(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            files.add(frame.f_code.co_filename)

    given = ARX(2, 2), TRACKERS[0], *np.random.default_rng(0).normal(size=(2, 100))
    track(*given)
    sys.setprofile(see)
    try:
        track(*given)
    finally:
        sys.setprofile(None)
    return sum(Path(driftfit.__file__).parent in Path(file).parents for file in files)


def _members(kind: type[Any]) -> int:
    return sum(not name.startswith("__") for name in vars(kind))


def show() -> None:
    """The budgets of the house: what there is, and the limit."""
    table = table_of("Budgets", "", "now", "limit")
    for name, count in budgets().items():
        table.add_row(name, f"{count:,}", f"{LIMITS[name]:,}")
    Console(width=72).print(table)

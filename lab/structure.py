"""The structure of the library, from its source: modules, layers, imports that point up, circles, lines by folder.

    python -m lab structure                        the present source
    python -m lab structure --before REVISION      next to another revision of the repository
    python -m lab structure --picture FILE.png     and a picture of both

Every import counts: also those inside functions, and those for types only. A module of an old revision has the layer of
the file that it became, by git's detection of renames; where it became none, its imports are not judged.
"""

from __future__ import annotations

import ast
import io
import subprocess
import tarfile
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from driftfit.show.text import table_of

ROOT = Path(__file__).parent.parent
PACKAGE = "src/driftfit"
MOVED = "fbfc0a9"
"""The revision in which modules moved into folders by layer; the one before it is what the present is compared with."""

LAYERS = (
    ("engine",),
    ("models", "systems", "readings"),
    ("trackers", "bank", "models.hammerstein_wiener.extended_kalman", "models.hammerstein_wiener.output_error"),
    # the arithmetic of smoothers works on arrays and not on runs: a stream smooths its last samples with it
    ("data", "smooth.solvers"),
    ("run",),
    # how tables and pictures of all results look, which each verb's result needs to print and draw itself
    ("show.text", "show.axes"),
    ("smooth", "tune", "judge", "use", "bank.results"),
    ("show",),
    # the facade binds verbs to results
    ("", "results", "fleets", "streams", "tracking", "checks", "extend", "parsing", "identify"),
    ("demo", "embedded", "bridges", "service", "cli", "__main__"),
)
"""Folders and modules by layer, the lowest first; the longest prefix of a module's name counts."""


def layer_of(module: str) -> int:
    """The layer of a module."""
    fits = [(len(prefix), layer) for layer, names in enumerate(LAYERS) for prefix in names
            if module == prefix or (prefix and module.startswith(f"{prefix}."))]  # fmt: skip
    return max(fits)[1] if fits else layer_of("")


def name_of(path: str) -> str:
    """The name of a module below the package, from its path in the package."""
    return path.removesuffix(".py").replace("/", ".").removesuffix("__init__").removesuffix(".")


@dataclass(frozen=True)
class Structure:
    """Sources by path in the package, and the layer of each module."""

    sources: Mapping[str, str]
    layers: Mapping[str, int]

    @cached_property
    def modules(self) -> dict[str, str]:
        """Sources by the name of the module."""
        return {name_of(path): text for path, text in self.sources.items()}

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """The modules of the library that each module imports, anywhere in its source."""
        return {module: self._targets(module) for module in self.modules}

    def _targets(self, module: str) -> set[str]:
        found = set()
        for node in ast.walk(ast.parse(self.modules[module])):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{module}: imports name their module in full"
                found |= {f"{node.module}.{alias.name}" for alias in node.names}
        inside = {name.removeprefix("driftfit").removeprefix(".") for name in found if name.split(".")[0] == "driftfit"}
        return {name if name in self.modules else name.rpartition(".")[0] for name in inside} - {module}

    def reached(self, module: str) -> set[str]:
        """The modules that one imports, directly or through others."""
        reached: set[str] = set()
        waiting = list(self.imports[module])
        while waiting:
            one = waiting.pop()
            if one not in reached:
                reached.add(one)
                waiting += self.imports.get(one, ())
        return reached

    @cached_property
    def circles(self) -> list[tuple[str, ...]]:
        """Groups of modules that import each other, directly or through others."""
        reached = {module: self.reached(module) for module in self.imports}
        knots = {tuple(sorted(o for o in reached[m] if m in reached.get(o, ()))) for m in reached if m in reached[m]}
        return sorted(knots)

    @property
    def upward(self) -> list[str]:
        """Imports that point from a layer to a higher one."""
        pairs = ((one, other) for one, found in self.imports.items() for other in sorted(found))
        return [f"{a} -> {b}" for a, b in pairs if self.layers.get(a, 99) < self.layers.get(b, -1)]

    @property
    def files(self) -> Counter[str]:
        """Modules in each folder, without ``__init__``."""
        folders = (path.rpartition("/")[0] for path in self.sources if not path.endswith("__init__.py"))
        return Counter(folders)

    @property
    def lines(self) -> Counter[str]:
        """Lines by the first folder of a file; "" is the top of the package."""
        found: Counter[str] = Counter()
        for path, text in self.sources.items():
            found[path.partition("/")[0] if "/" in path else ""] += len(text.splitlines())
        return found

    def facts(self) -> dict[str, int]:
        """What the table shows."""
        sizes = [len(text.splitlines()) for text in self.sources.values()]
        return {
            "modules": len(self.modules),
            "lines": sum(sizes),
            "modules at the top": self.files[""],
            "modules in the largest folder": max(self.files.values()),
            "lines of the longest module": max(sizes),
            "imports": sum(map(len, self.imports.values())),
            "imports that point up": len(self.upward),
            "circles": len(self.circles),
            "modules in circles": sum(map(len, self.circles)),
        }


def present() -> Structure:
    """The structure of the working tree."""
    home = ROOT / PACKAGE
    sources = {file.relative_to(home).as_posix(): file.read_text(encoding="utf-8") for file in home.rglob("*.py")}
    return Structure(sources, {name_of(path): layer_of(name_of(path)) for path in sources})


def of_revision(revision: str) -> Structure:
    """The structure of a revision before modules moved, with the layers of what its modules became."""
    with tarfile.open(fileobj=io.BytesIO(_git("archive", revision, PACKAGE))) as archive:
        members = [one for one in archive if one.isfile() and one.name.endswith(".py")]
        sources = {one.name.removeprefix(f"{PACKAGE}/"): _text(archive, one) for one in members}
    named = _git("diff", "--find-renames=40%", "--name-status", revision, MOVED, "--", PACKAGE).decode().splitlines()
    moves = {old: new for _, old, new in (line.split("\t") for line in named if line.startswith("R"))}
    gone = {line.split("\t")[1] for line in named if line.startswith("D")}
    became = {path: moves.get(f"{PACKAGE}/{path}", f"{PACKAGE}/{path}") for path in sources}
    known = {path: new.removeprefix(f"{PACKAGE}/") for path, new in became.items() if new not in gone}
    return Structure(sources, {name_of(path): layer_of(name_of(new)) for path, new in known.items()})


def _text(archive: tarfile.TarFile, member: tarfile.TarInfo) -> str:
    file = archive.extractfile(member)
    assert file is not None
    return file.read().decode("utf-8")


def _git(*words: str) -> bytes:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True).stdout


def show(
    before: Annotated[str, typer.Option(help=f"A revision to compare with, such as {MOVED}^.")] = "",
    picture: Annotated[str, typer.Option(help="A file for the picture of both.")] = "",
) -> None:
    """The structure of the library, computed from its source."""
    out = Console(width=64)
    found = {"before": of_revision(before)} if before else {}
    found["now"] = present()
    table = table_of("Structure", "", *found)
    facts = [one.facts() for one in found.values()]
    for name in facts[-1]:
        table.add_row(name, *(f"{one[name]:,}" for one in facts))
    out.print(table)
    table = table_of("Lines by folder", "", *found)
    lines = [one.lines for one in found.values()]
    for folder in sorted(set().union(*lines)):
        table.add_row(folder or "(top)", *(f"{one[folder]:,}" if one[folder] else "" for one in lines))
    out.print(table)
    for name, one in found.items():
        for circle in one.circles:
            out.print(f" {name}, a circle of {len(circle)}: {', '.join(circle)}", markup=False)
    if picture:
        draw(found, picture)


Room = tuple[str, int]
"""A folder, and one of the layers that its modules have."""


def draw(found: Mapping[str, Structure], file: str) -> None:
    """Folders as boxes in their layers, and imports between them: red where they point up, wider where more go."""
    from driftfit.show.axes import GREY, RED, new_figure

    figure = new_figure(6.4 * len(found), 7.0)
    for axis, (name, one) in zip(figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True):
        counts, arrows = _rooms(one)
        places = _places(counts)
        for (a, b), count in arrows.items():
            up = b[1] > a[1]
            style = {
                "arrowstyle": "-|>", "color": RED if up else GREY, "alpha": 0.8 if up else 0.25,
                "lw": 0.4 + 0.25 * count**0.5, "shrinkA": 12, "shrinkB": 12, "connectionstyle": "arc3,rad=0.12",
            }  # fmt: skip
            axis.annotate("", places[b], places[a], arrowprops=style, zorder=1 + up)
        for room, (x, y) in places.items():
            box = {"boxstyle": "round,pad=0.35", "fc": "white", "ec": GREY}
            axis.text(
                x, y, f"{room[0]}\n{counts[room]}", ha="center", va="center", fontsize=7, bbox=box, zorder=5
            )  # fmt: skip
        facts = one.facts()
        axis.set_title(
            f"{name}: {facts['modules']} modules, {facts['imports that point up']} imports point up,\n"
            f"{facts['modules in circles']} modules in circles", fontsize=9,
        )  # fmt: skip
        axis.set_xlim(-0.1, 1.1)
        axis.set_ylim(-0.6, len(LAYERS) - 0.4)
        axis.axis("off")
    figure.savefig(file, dpi=110)


def _rooms(one: Structure) -> tuple[Counter[Room], Counter[tuple[Room, Room]]]:
    """How many modules of a folder a layer has, and how many imports go from one of these groups to another."""
    rooms: dict[str, Room] = {}
    for path in one.sources:
        name = name_of(path)
        if name in one.layers:
            rooms[name] = (path.partition("/")[0] if "/" in path else "(top)", one.layers[name])
    pairs = ((rooms.get(a), rooms.get(b)) for a, found in one.imports.items() for b in found)
    return Counter(rooms.values()), Counter((a, b) for a, b in pairs if a is not None and b is not None and a != b)


def _places(rooms: Iterable[Room]) -> dict[Room, tuple[float, float]]:
    """The rooms of a layer side by side; every other layer is moved a little, so that arrows pass between boxes."""
    rows: dict[int, list[Room]] = {}
    for room in sorted(rooms):
        rows.setdefault(room[1], []).append(room)
    return {
        room: ((k + 0.5 + 0.15 * (-1) ** layer) / len(row), float(layer))
        for layer, row in rows.items()
        for k, room in enumerate(row)
    }

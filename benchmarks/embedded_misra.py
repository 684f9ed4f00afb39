"""What cppcheck's MISRA addon reports for exported trackers.

    python -m benchmarks.embedded_misra            half a minute

cppcheck must be installed; the addon names rules by number only, because their texts are MISRA's.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, RLS, Kalman
from driftfit.embedded import export_c

EXPORTED: dict[str, tuple[Any, bool]] = {
    "Kalman, p0, fixed rate": (Kalman(q=1e-4, r=0.1, p0=1.0), True),
    "Kalman, p0": (Kalman(q=1e-4, r=0.1, p0=1.0), False),
    "Kalman": (Kalman(q=1e-4, r=0.1), False),
    "RLS": (RLS(0.98), False),
}


def reported(tracker: Any, fixed_rate: bool) -> Counter[str]:
    """How often the addon reports each rule in tracker.c and tracker.h, in the double- and single-precision builds."""
    with tempfile.TemporaryDirectory() as place:
        export_c(ARX(2, 2), tracker, place, fixed_rate=fixed_rate)
        source, found = str(Path(place) / "tracker.c"), Counter[str]()
        for build in ("-DTRACKER_SINGLE", "-UTRACKER_SINGLE"):
            command = ["cppcheck", "--addon=misra", "--std=c99", "--quiet", build, source]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            found |= Counter(re.findall(r"\[misra-c2012-([\d.]+)\]", done.stderr))
    return found


def main(quick: Annotated[bool, typer.Option(help="Only the first export.")] = False) -> None:
    """Print the table."""
    out = Console(width=110)
    if shutil.which("cppcheck") is None:
        out.print("cppcheck is not installed.")
        return
    version = subprocess.run(["cppcheck", "--version"], capture_output=True, text=True, check=True).stdout.strip()
    table = Table(title=f"Reports by rule of MISRA C:2012, {version}", show_edge=False, box=SIMPLE_HEAD)
    table.add_column("rule")
    chosen = list(EXPORTED.items())[: 1 if quick else None]
    counts = {name: reported(*settings) for name, settings in chosen}
    for name in counts:
        table.add_column(name, justify="right")
    rules = {rule for count in counts.values() for rule in count}
    for rule in sorted(rules, key=lambda rule: [int(part) for part in rule.split(".")]):
        table.add_row(rule, *(str(count[rule] or "-") for count in counts.values()))
    out.print(table)


if __name__ == "__main__":
    typer.run(main)

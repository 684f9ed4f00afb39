"""The alarms and the report of a fleet: processor time per series, and what judging clear series early saves.

Pumps as in `benchmarks/fleet_verdict.py`, 1,200 samples each; the gain of one in ten falls by 15 % half-way. "in
stages" is `Fleet.detect` as it is, "all records" with the 64 simulated records of a single run for every series
(``records=64``). Processor time is that of all threads, and 20,000 series take so many times more.

Run: python benchmarks/fleet_alarms.py [--quick]
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fleet_verdict
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

fleet_verdict.T = 1200


def spent(job: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of processor time, and the result."""
    begun = time.process_time()
    result = job()
    return time.process_time() - begun, result


def main(units: int) -> None:
    fleet = fleet_verdict.tracked(fleet_verdict.pumps(units))
    fleet_verdict.tracked(fleet_verdict.pumps(2)).detect()  # compiles
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"{units} series of {fleet_verdict.T} samples")
    for head in ("", "ms a series", "min for 20,000", "with an alarm", "with a fault"):
        table.add_column(head, justify="right" if head else "left")
    for name, given in (("detect, in stages", {}), ("detect, all records", {"records": 64})):
        seconds, said = spent(lambda: fleet.detect(**given))  # noqa: B023
        found = str(len(said.alarmed)), str(len(said.faulty))
        table.add_row(name, f"{1e3 * seconds / units:.1f}", f"{seconds / units * 20_000 / 60.0:.0f}", *found)
    with tempfile.TemporaryDirectory() as folder:
        seconds, _ = spent(lambda: fleet.report(Path(folder) / "fleet.html"))
    table.add_row("report", f"{1e3 * seconds / units:.1f}", f"{seconds / units * 20_000 / 60.0:.0f}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main(10 if "--quick" in sys.argv[1:] else 200)

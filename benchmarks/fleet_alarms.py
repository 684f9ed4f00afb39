"""Verdict, alarms and report of a fleet: processor time per series, memory, and what groups of like series save.

Pumps as in `benchmarks/fleet_verdict.py`, 1,200 samples each; the gain of one in ten falls by 15 % half-way. "detect"
is `Fleet.detect` as it is; "detect, each with limits of its own" simulates 64 records for each of the first hundred
series (``records=64``). Processor time is that of all threads and processes. Memory is the largest that the process
had until then, with the records and the results of the tracker.

Run: python benchmarks/fleet_alarms.py [series, 20000 by default] [--quick]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import fleet_verdict
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

fleet_verdict.T = 1200


def spent(job: Callable[[], Any]) -> tuple[float, float, Any]:
    """Seconds by the clock and of processor time, and the result."""
    begun, at = fleet_verdict.processor(), perf_counter()
    result = job()
    return perf_counter() - at, fleet_verdict.processor() - begun, result


def main(units: int) -> None:
    small = fleet_verdict.tracked(fleet_verdict.pumps(2))
    small.detect(), small.verdict()  # compiles
    fleet, alone = (fleet_verdict.tracked(fleet_verdict.pumps(count)) for count in (units, min(units, 100)))
    table = Table(box=SIMPLE_HEAD, show_edge=False, title=f"{units} series of {fleet_verdict.T} samples")
    for head in (
        "",
        "elapsed, s",
        "processor, s",
        "processor a series, ms",
        "peak, MB",
        "with an alarm",
        "with a fault",
    ):
        table.add_column(head, justify="right" if head else "left")
    with tempfile.TemporaryDirectory() as folder:
        jobs = {
            "verdict": fleet.verdict,
            "detect": fleet.detect,
            "report": lambda: fleet.report(Path(folder) / "fleet.html"),
            "detect, each with limits of its own": lambda: alone.detect(records=64),
        }
        for name, job in jobs.items():
            elapsed, seconds, alarms = spent(job)
            each = seconds / len(alone if "own" in name else fleet)
            found = (str(len(alarms.alarmed)), str(len(alarms.faulty))) if "detect" in name else ("", "")
            cells = (f"{elapsed:.1f}", f"{seconds:.1f}", f"{1e3 * each:.1f}", f"{fleet_verdict.peak():.0f}")
            table.add_row(name, *cells, *found)
    Console(width=110).print(table)


if __name__ == "__main__":
    counts = [int(one) for one in sys.argv[1:] if one.isdigit()]
    main(10 if "--quick" in sys.argv[1:] else counts[0] if counts else 20_000)

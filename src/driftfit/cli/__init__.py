"""The command line, one file per command; `driftfit --help` lists them, docs/command_line.md shows each in use."""

from driftfit.cli import cache, demo, detect, export, forecast, select, smooth, track, trackers, tune, verdict, warm
from driftfit.cli.parts.program import app, main

__all__ = [
    "app", "cache", "demo", "detect", "export", "forecast", "main", "select", "smooth", "track", "trackers", "tune",
    "verdict", "warm",
]  # fmt: skip

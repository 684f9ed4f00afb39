"""The command line, one file per command; `driftfit --help` lists them, docs/command_line.md shows each in use."""

from driftfit.cli import demo, detect, export, forecast, select, serve, smooth, track, trackers, tune, verdict
from driftfit.cli.compiled import cache, warm
from driftfit.cli.parts.program import app, main

__all__ = [
    "app", "cache", "demo", "detect", "export", "forecast", "main", "select", "serve", "smooth", "track", "trackers",
    "tune", "verdict", "warm",
]  # fmt: skip

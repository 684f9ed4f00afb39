"""The command line; `driftfit --help` lists the commands, docs/command_line.md shows each in use."""

from driftfit.cli import compiled, detect, export, forecast, serve, track, trackers, tune
from driftfit.cli.program import app, main

__all__ = ["app", "compiled", "detect", "export", "forecast", "main", "serve", "track", "trackers", "tune"]

"""The command line; `driftfit --help` lists the commands, docs/command_line.md shows each in use."""

from driftfit.cli import compiled, detect, export, forecast, identify, serve, track, trackers, tune
from driftfit.cli.program import app, main

__all__ = ["app", "compiled", "detect", "export", "forecast", "identify", "main", "serve", "track", "trackers", "tune"]

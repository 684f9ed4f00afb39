"""The command line; `driftfit --help` lists the commands, docs/command_line.md shows each in use."""

from driftfit.cli import records, tools
from driftfit.cli.program import app, main

__all__ = ["app", "main", "records", "tools"]

"""``python -m driftfit``: the command line."""

from driftfit.cli import main

main()

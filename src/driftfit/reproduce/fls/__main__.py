"""``python -m driftfit.reproduce.fls``."""

import typer

from driftfit.reproduce.fls import main

typer.run(main)

"""``python -m driftfit.reproduce.hypotheses``."""

import typer

from driftfit.reproduce.hypotheses import main

typer.run(main)

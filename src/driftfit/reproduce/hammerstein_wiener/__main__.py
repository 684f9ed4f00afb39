"""``python -m driftfit.reproduce.hammerstein_wiener``."""

import typer

from driftfit.reproduce.hammerstein_wiener import main

typer.run(main)

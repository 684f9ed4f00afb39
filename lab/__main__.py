"""``python -m lab``."""

from lab.program import app

app(prog_name="python -m lab")

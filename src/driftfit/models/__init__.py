"""Models turn signals into a regression and name its parameters. Any module here that defines a `Model` is found."""

from __future__ import annotations

from driftfit.engine.settings import classes_in
from driftfit.models.base import Model


def found() -> dict[str, type[Model]]:
    """Every model in this folder, by class name."""
    return classes_in(__name__, __path__, Model)

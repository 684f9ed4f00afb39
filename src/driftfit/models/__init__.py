"""Models: signals to a regression, and what theta means. A module in this folder that defines a `Model` is found."""

from __future__ import annotations

from driftfit.engine.settings import classes_in
from driftfit.models.base import Model


def found() -> dict[str, type[Model]]:
    """Every model that this folder holds, by class name."""
    return classes_in(__name__, __path__, Model)

"""Trackers: algorithms that estimate theta. A module in this folder that defines a `Tracker` is found automatically."""

from __future__ import annotations

from driftfit import bank, models
from driftfit.engine.settings import classes_in
from driftfit.trackers.base import Tracker


def found() -> dict[str, type[Tracker]]:
    """Every tracker of the package by class name: those of this folder, of the bank, and of one model only."""
    homes = {__name__: __path__, bank.__name__: bank.__path__, models.__name__: models.__path__}
    each = (classes_in(package, path, Tracker) for package, path in homes.items())
    return dict(sorted({name: kind for some in each for name, kind in some.items()}.items()))

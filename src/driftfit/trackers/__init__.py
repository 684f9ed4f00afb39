"""Trackers: algorithms that estimate theta. A module in this folder that defines a `Tracker` is found automatically."""

from __future__ import annotations

from driftfit import models
from driftfit.engine.settings import classes_in
from driftfit.trackers.base import Tracker


def found() -> dict[str, type[Tracker]]:
    """Every tracker of the package by class name: those of this folder, and those that work with one model only."""
    everywhere = classes_in(__name__, __path__, Tracker) | classes_in(models.__name__, models.__path__, Tracker)
    return dict(sorted(everywhere.items()))

"""Trackers: how theta is followed. A module placed in this folder that defines a `Tracker` is found, not registered."""

from __future__ import annotations

from driftfit.settings import classes_in
from driftfit.trackers.base import Tracker


def found() -> dict[str, type[Tracker]]:
    """Every tracker that this folder holds, by class name."""
    return classes_in(__name__, __path__, Tracker)

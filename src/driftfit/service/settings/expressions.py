"""Models and trackers as text: ``ARX(2, [2, 2], intercept=True)``, or ``arx:2,2,intercept`` as on the command line."""

from __future__ import annotations

from driftfit.cli.parts.arguments import parse_model, parse_tracker
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker


def model_of(text: str) -> Model:
    """A model from text; ValueError says what is wrong."""
    return parse_model(text)


def tracker_of(text: str) -> Tracker:
    """A tracker from text, ``Kalman(q=1e-4, r=0.1)`` or ``kalman:q=1e-4;r=0.1``; ValueError says what is wrong."""
    if "(" in text:
        return parse_tracker(text, [])
    name, _, settings = text.partition(":")
    return parse_tracker(name, [one for one in settings.split(";") if one.strip()])

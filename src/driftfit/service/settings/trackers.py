"""Trackers with their settings as one text."""

from __future__ import annotations

from driftfit.parsing.settings import parse_tracker
from driftfit.trackers.base import Tracker


def tracker_of(text: str) -> Tracker:
    """A tracker from text, ``Kalman(q=1e-4, r=0.1)`` or ``kalman:q=1e-4;r=0.1``; ValueError with the reason if it is
    wrong.
    """
    if "(" in text:
        return parse_tracker(text, [])
    name, _, settings = text.partition(":")
    return parse_tracker(name, [one for one in settings.split(";") if one.strip()])

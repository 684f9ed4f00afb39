"""Inputs that come after the output of their sample, as in a control loop: y_t is read, then u_t is chosen and applied.

The model stores the same as if u_t and y_t had come in one row of a record (`driftfit.models.base.Model.apply`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from driftfit.engine.drivers import INPUTS
from driftfit.engine.kernel import Array, Driver, Step
from driftfit.engine.tiles import tile_type
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker


class _Later:
    """Represents an input that was left out, as opposed to None, which is a missing input."""

    def __repr__(self) -> str:
        return "LATER"


LATER: Any = _Later()

NOTHING, INPUT, IGNORED = 0, 1, 2
"""The input that `Live.apply` is expected to receive: nothing, the input of the last sample, or that of an ignored
sample.
"""


def applier(model: Model, tracker: Tracker, tile: Array) -> Any:
    """``apply(as_compiled(tile), u)`` for this type of tile; ValueError if outputs need the input of their sample."""
    step = tracker.apply_for(model)
    if step is None:
        raise ValueError(
            f"Live.update: no input was given, but {model!r} needs the input of a sample to predict its output "
            "(a regression, or nk = 0): update(y, u), with u=None if it is not known. In a control loop, where u is "
            "chosen after y has been read, use a model with nk of at least 1, and call update(y), then apply(u)."
        )
    return _compiled(step).entry(tile_type(tile), INPUTS)


@lru_cache(maxsize=256)
def _compiled(step: Step) -> Driver:
    @Driver
    def apply(tile: Array, u: Array) -> None:
        s = tile[0]
        for l in range(s.theta.shape[1]):
            for j in range(u.shape[0]):
                s.u[j, l] = u[j]
            step(s, l)

    return apply


def check_applied(expected: int) -> None:
    """Raise an error if a sample arrives while the input of the previous one is still outstanding."""
    if expected != NOTHING:
        raise ValueError(
            "Live.update: the input of the last sample has not been given yet: apply(u) after update(y), or "
            "apply(None) where it is not known."
        )


def check_expected(expected: int) -> None:
    """Raise an error if an input arrives although no sample is waiting for it."""
    if expected == NOTHING:
        raise ValueError(
            "Live.apply: no sample is waiting for its input. The order is update(y) without u, then apply(u), once per "
            "sample."
        )

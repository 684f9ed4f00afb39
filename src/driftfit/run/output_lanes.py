"""Several outputs as lanes of one tile: the program of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from driftfit.data.signals import check_ready
from driftfit.models.base import Model
from driftfit.run.program import Program
from driftfit.trackers.base import Tracker


def shown(trackers: Sequence[Tracker]) -> str:
    """The tracker of all outputs, or of each."""
    return repr(trackers[0]) if len(set(trackers)) == 1 else ", ".join(map(repr, trackers))


def programs_of(model: Model, tracker: Any) -> tuple[Program, ...]:
    """The program of each output (of a shared theta: the only one); ValueError where they cannot run together."""
    if isinstance(tracker, Mapping) and not model.shared:
        if set(tracker) != set(model.outputs):
            raise ValueError(
                f"trackers were given for {', '.join(map(str, tracker))}, but the outputs are "
                f"{', '.join(model.outputs)}."
            )
        trackers = tuple(tracker[name] for name in model.outputs)
    else:
        trackers = (tracker,) * (1 if model.shared else len(model.outputs))
    for one in trackers:
        if not isinstance(one, Tracker):
            raise ValueError(f"several outputs take one tracker, or one for each output by its name; got {tracker!r}.")
        check_ready(one)
    outputs = (None,) if model.shared else model.outputs
    programs = tuple(Program(model, one, output) for one, output in zip(trackers, outputs, strict=True))
    if len({one.steps for one in programs}) > 1 or len({one.shapes for one in programs}) > 1:
        raise ValueError(f"the trackers of several outputs must be of one kind and form; got {shown(trackers)}.")
    return programs

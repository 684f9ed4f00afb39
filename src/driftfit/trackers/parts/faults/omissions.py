"""What a tracker left out because it took it for a fault: the counts in its state, and the lines of its summary.

They are the same for all trackers that judge samples, whatever their rules:

    left_out      readings out of all proportion, and samples of the start that the others contradict
    inputs_out    samples with an input or a lag far outside its range, to which the output did not respond
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from driftfit.engine.kernel import Array

NOTHING_LEFT_OUT: Mapping[str, Any] = {"left_out": 0.0, "inputs_out": 0.0}
"""The counts before the first sample."""
LINES = {
    "left_out": ("Left out", "samples out of all proportion to those before"),
    "inputs_out": (
        "Inputs left out",
        "samples with an input or a lag far outside its range, to which the output did not respond",
    ),
}


def omissions(lane: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
    """The lines of a summary, given the state after the run; none of what did not happen, or was not judged."""
    counts = {name: int(lane[name]) for name in LINES if name in lane}
    return tuple((LINES[name][0], f"{count} {LINES[name][1]}") for name, count in counts.items() if count)

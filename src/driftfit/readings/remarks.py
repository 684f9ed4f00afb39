"""What a gate did, in words: for summaries, pages and warnings, from the numbers that stand beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.readings.gate import AT_START, FROZEN, INPUT, REFUSED

SAID: Mapping[int, tuple[str, str]] = {
    REFUSED: ("Left out", "far outside the range of the others, which the model did not predict"),
    FROZEN: ("Frozen", "repeating the one before although the forecast moved"),
    INPUT: ("Inputs left out", "with an input far outside its range to which the output did not respond"),
    AT_START: ("Left out at the start", "contradicted by the others among the first"),
}
"""For each reason its label in a summary, and what is said of the samples."""
SHOWN = 3
"""Values that a warning names at most."""


def counts(reason: Array) -> dict[int, int]:
    """How many samples (T,) there are for each reason but USED."""
    return {one: count for one in SAID if (count := int(np.count_nonzero(reason == one)))}


def remarks(count: Mapping[int, int]) -> tuple[tuple[str, str], ...]:
    """The lines of a summary: nothing if nothing was left out."""
    return tuple(
        (SAID[one][0], f"{k} sample{'s' if k > 1 else ''} {SAID[one][1]}: not used") for one, k in count.items()
    )


def floor_remark(floor: float) -> tuple[tuple[str, str], ...]:
    """The line on a coarse meter, given the floor of the noise variance: nothing if there is none."""
    step = np.sqrt(12.0 * floor)
    said = f"steps of {step:.4g}: the noise variance is taken to be at least {floor:.3g}"
    return (("Resolution", said),) if floor > 0.0 else ()


def ungated(found: Mapping[str, Sequence[float]], linear: bool) -> str:
    """What is warned of after a run without a gate, given the values of each signal that look like codes, and whether
    the model is linear in theta."""
    said = "; ".join(_codes(name, values) for name, values in found.items())
    lasting = "" if linear else " An estimate of a model that is not linear in theta may not come back from them."
    return f"{said}. Such readings enter the estimate; gate=True leaves them out.{lasting}"


def _codes(name: str, values: Sequence[float]) -> str:
    different = list(dict.fromkeys(values))
    named = ", ".join(f"{value:g}" for value in different[:SHOWN]) + (", .." if len(different) > SHOWN else "")
    which = "value looks like a fault code" if len(values) == 1 else "values look like fault codes"
    return f"{name}: {len(values)} {which} ({named})"

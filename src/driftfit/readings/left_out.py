"""What a gate left out: in words, and as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

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
NONE = np.empty(0, int)
KEPT = 16
"""Decisions that a stream keeps, and rows of a printed table at most."""


class Decision(NamedTuple):
    """One sample that was not used: its number (in a stream its time, if it has one), the signal, its reading of y,
    why, and the sample at which that was decided."""

    sample: Any
    signal: str
    value: float
    reason: str
    decided: Any


@dataclass(frozen=True, repr=False)
class LeftOut:
    """The decisions of a gate in the order of the samples: ``sample`` (k,), ``code`` (k,) of the reason
    (`driftfit.readings.gate`), ``value`` (k,), the readings of y there, ``signal`` (k,), the name of the signal, and
    ``decided`` (k,), the sample at which it was decided.
    ``refused`` (i,) are the samples whose reading was refused, and ``unused`` (j,) those that could not be used because
    a refused input is in their regressors. Given as ``gate=``, these decisions are applied again.
    """

    sample: Array
    code: Array
    value: Array
    signal: Array
    decided: Array
    refused: Array
    unused: Array

    def __len__(self) -> int:
        return len(self.sample)

    def __iter__(self) -> Iterator[Decision]:
        columns = (one.tolist() for one in (self.sample, self.signal, self.value, self.code, self.decided))
        for sample, signal, value, code, when in zip(*columns, strict=True):
            yield Decision(sample, signal, value, SAID[code][1], when)

    @property
    def counts(self) -> dict[str, int]:
        """How many samples there are for each reason, by the name that summaries use."""
        return {label: count for code, (label, _) in SAID.items() if (count := int(np.sum(self.code == code)))}

    def applied(self, y: Array, noise: Array) -> tuple[Array, Array]:
        """Readings y (T,) and factors of the noise variance (T,) with these decisions: refused readings are NaN, and
        samples with a refused input have an infinite variance."""
        y, noise = y.copy(), np.array(np.broadcast_to(noise, len(y)))
        y[self.refused] = np.nan
        noise[self.unused] = np.inf
        return y, noise

    def __repr__(self) -> str:
        return table(list(self))


def table(decisions: Sequence[Decision]) -> str:
    """Decisions as text, at most `KEPT` of them."""
    rows, count = decisions[:KEPT], len(decisions)
    if count == 0:
        return "nothing left out"
    wide = max(6, *(len(str(row.sample)) for row in rows))
    lines = [f"{'sample':>{wide}}  signal    reading of y  reason"]
    lines += [f"{row.sample!s:>{wide}}  {row.signal:<6}  {row.value:>14.6g}  {row.reason}" for row in rows]
    more = [f"{'':>{wide}}  and {count - len(rows)} more"] if count > len(rows) else []
    return "\n".join([*lines, *more])


NOTHING_LEFT_OUT = LeftOut(NONE, NONE, np.empty(0), np.empty(0, "<U1"), NONE, NONE, NONE)


def remarks_of(found: LeftOut | Mapping[Any, LeftOut]) -> tuple[tuple[str, str], ...]:
    """The lines on what was left out of a record, or of several together."""
    several = [found] if isinstance(found, LeftOut) else found.values()
    total = sum((Counter(one.counts) for one in several), Counter[str]())
    rows = [(label, total[label], said) for label, said in SAID.values() if total[label]]
    return tuple((label, f"{count} sample{'s' if count > 1 else ''} {said}: not used") for label, count, said in rows)

"""Inputs far outside their range to which the output does not respond: fault codes, such as 0 where a meter shows 50.

An input is judged as a signal, never as a regressor. It is *outside* if it is more than `Gate.away` half ranges from
the middle of the range of its earlier values. It is blamed if it is in the model's memory when

    the sample contradicts its forecast    and    the output itself is as usual, |y - m| <= RARE v^(1/2)

A large input to which the output responds is never blamed: a step of a set point, a flood, a rare pulse. A blamed input
is missing from the model's memory, and the sample is not used. After `Gate.trust` samples in a row inputs are believed.
What leaves the memory without blame, or stays there when trust is spent, widens the range.

Source: ours. Cost per sample: a few operations for each input.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel

LONGEST = 60
"""Samples that a mask of 64 bits can hold."""


def no_inputs(m: int) -> Mapping[str, Any]:
    """Fields before the first sample: ranges, what would widen them, a bit for each sample that is outside."""
    low, high = np.full(max(m, 1), np.inf), np.full(max(m, 1), -np.inf)
    return {
        "gate_low": low, "gate_high": high, "gate_lowest": low, "gate_highest": high,
        "gate_outside": np.zeros(max(m, 1), np.int64), "gate_blamed": 0,
    }  # fmt: skip


@kernel
def forget(s: State, j: int, l: int) -> None:
    """Nothing is outside any more."""
    s.gate_outside[j, l], s.gate_lowest[j, l], s.gate_highest[j, l] = 0, np.inf, -np.inf


@kernel
def widen(s: State, j: int, u: float, l: int) -> None:
    """The range of input j takes in a value that was believed."""
    s.gate_low[j, l], s.gate_high[j, l] = min(s.gate_low[j, l], u), max(s.gate_high[j, l], u)


def input_rules(gate: Any) -> tuple[Any, Any]:
    """``notice(s, ages, known, l)``, which takes in the inputs of a sample if the model remembers those of ``ages``
    others, and ``blame(s, contradicts, usual, l)``, the number of the first input that is blamed for it, from 1, or 0.
    """
    away, trust = float(gate.away), gate.trust

    @kernel
    def notice(s: State, ages: int, known: bool, l: int) -> None:
        for j in range(s.gate_low.shape[0]):
            if (s.gate_outside[j, l] >> min(ages, LONGEST)) & 1 > 0:  # leaves the memory without blame
                widen(s, j, s.gate_lowest[j, l], l)
                widen(s, j, s.gate_highest[j, l], l)
                forget(s, j, l)
            u, low, high = s.u[j, l], s.gate_low[j, l], s.gate_high[j, l]
            strange = known & (abs(u) < np.inf) & (abs(2.0 * u - (low + high)) > away * (high - low))
            s.gate_outside[j, l] = (s.gate_outside[j, l] << 1) | (1 if strange else 0)
            if strange:
                s.gate_lowest[j, l], s.gate_highest[j, l] = min(s.gate_lowest[j, l], u), max(s.gate_highest[j, l], u)
            elif abs(u) < np.inf:
                widen(s, j, u, l)

    @kernel
    def blame(s: State, contradicts: bool, usual: bool, l: int) -> int:
        first = 0
        for j in range(s.gate_low.shape[0] - 1, -1, -1):
            first = j + 1 if s.gate_outside[j, l] != 0 else first
        if first == 0:
            s.gate_blamed[l] = s.gate_blamed[l] if contradicts else 0
            return 0
        if not (contradicts & usual & (s.gate_blamed[l] < trust)):
            return 0
        s.gate_blamed[l] += 1
        return first

    return notice, blame


def taking_out(refuse: Callable[[State, int, int, int], None], blamed: int) -> Any:
    """``take_out(s)``: the model refuses inputs that were outside, if the reason is one, from ``blamed`` on."""

    @kernel
    def take_out(s: State) -> None:
        for l in range(s.reason.shape[0]):
            for j in range(s.gate_low.shape[0] if s.reason[l] >= blamed else 0):
                for age in range(LONGEST, -1, -1):
                    if (s.gate_outside[j, l] >> age) & 1 > 0:
                        refuse(s, j, age, l)
                forget(s, j, l)

    return take_out

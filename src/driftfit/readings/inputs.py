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


def input_rules(gate: Any) -> tuple[Any, Any]:
    """``notice(s, l, g, k, ages, known)``, which takes in the inputs of a sample if the model remembers those of
    ``ages`` others, and ``blame(g, k, contradicts, usual)``, the number of the first that is blamed for it, or 0.
    """
    away, trust = float(gate.away), gate.trust

    @kernel
    def notice(s: State, l: int, g: State, k: int, ages: int, known: bool) -> None:
        for j in range(g.gate_low.shape[0]):
            u, low, high = s.u[j, l], g.gate_low[j, k], g.gate_high[j, k]
            if (g.gate_outside[j, k] >> min(ages, LONGEST)) & 1 > 0:  # leaves the memory without blame
                low, high = min(low, g.gate_lowest[j, k]), max(high, g.gate_highest[j, k])
                g.gate_outside[j, k], g.gate_lowest[j, k], g.gate_highest[j, k] = 0, np.inf, -np.inf
            strange = known & (abs(u) < np.inf) & (abs(2.0 * u - (low + high)) > away * (high - low))
            g.gate_outside[j, k] = (g.gate_outside[j, k] << 1) | (1 if strange else 0)
            if strange:
                g.gate_lowest[j, k], g.gate_highest[j, k] = min(g.gate_lowest[j, k], u), max(g.gate_highest[j, k], u)
            elif abs(u) < np.inf:
                low, high = min(low, u), max(high, u)
            g.gate_low[j, k], g.gate_high[j, k] = low, high

    @kernel
    def blame(g: State, k: int, contradicts: bool, usual: bool) -> int:
        first = 0
        for j in range(g.gate_low.shape[0] - 1, -1, -1):
            first = j + 1 if g.gate_outside[j, k] != 0 else first
        g.gate_blamed[k] = g.gate_blamed[k] if contradicts | (first > 0) else 0
        first = first if contradicts & usual & (g.gate_blamed[k] < trust) else 0
        g.gate_blamed[k] += 1 if first > 0 else 0
        return first

    return notice, blame


def taking_out(refuse: Callable[[State, int, int, int], None], blamed: int, memory: Any, rows: int) -> Any:
    """``take_out(s)``: the model refuses inputs that were outside, if one is a reason, from ``blamed`` on."""

    @kernel
    def take_out(s: State) -> None:
        g, k = memory(s), 0
        if rows:  # a constant
            k = s.output[0]
        for l in range(s.reason.shape[0]):
            for j in range(g.gate_low.shape[0] if s.reason[l] >= blamed else 0):
                for age in range(LONGEST, -1, -1):
                    if (g.gate_outside[j, k + l] >> age) & 1 > 0:
                        refuse(s, j, age, l)
                g.gate_outside[j, k + l], g.gate_lowest[j, k + l], g.gate_highest[j, k + l] = 0, np.inf, -np.inf

    return take_out

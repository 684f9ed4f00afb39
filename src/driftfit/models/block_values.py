"""The functions of a block at a number, into the memory of a Hammerstein-Wiener model.

Any basis is evaluated by its machine (`driftfit.models.curve_kernels`), called by symbol. Raw powers, the most usual,
are computed on the spot.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from driftfit.kernel import Array, named, part
from driftfit.models.block_memory import (
    CURVE,
    D_NOW,
    INTO,
    N_IN,
    N_OUT,
    OUT,
    TRIAL,
    TRIAL_BEND,
    Places,
)
from driftfit.models.curve_kernels import POWERS
from driftfit.models.curve_kernels import evaluate as built_in


@lru_cache
def values_of(evaluate: Any, numbers: int, following: int, count: int) -> Any:
    """A part (m, p, x, at, slopes) that fills two arrays with the functions of a block at x, and their slopes."""

    def values(m: Array, p: Places, x: float, at: int, slopes: int) -> None:
        own, L = p[numbers], m.shape[1]
        base, size = m.ctypes.data, 8 * L
        evaluate(x, base + size * own, p[following] - own, base + size * at, base + size * slopes, p[count], L)

    found = part(named(values, evaluate, numbers))
    if evaluate is not built_in:
        return found

    def powers_first(m: Array, p: Places, x: float, at: int, slopes: int) -> None:
        if m[p[numbers], 0] != POWERS:
            found(m, p, x, at, slopes)
        else:
            power, k = 1.0, 0.0
            for i in range(p[count]):
                k += 1.0
                m[slopes + i, 0] = k * power
                power = power * x
                m[at + i, 0] = power

    return part(named(powers_first, evaluate, numbers))


def input_values(evaluate: Any) -> Any:
    """Those of the input block."""
    return values_of(evaluate, INTO, OUT, N_IN)


def output_values(evaluate: Any) -> Any:
    """Those of the output block."""
    return values_of(evaluate, OUT, CURVE, N_OUT)


@lru_cache
def level_of(evaluate: Any) -> Any:
    """A part (m, p, y) that says the level of the output block at y, and its slope; it fills trial and trial_bend."""
    fill_trial = output_values(evaluate)

    def at_output(m: Array, p: Places, y: float) -> tuple[float, float]:
        n_out, d, g, h = p[N_OUT], p[D_NOW], p[TRIAL], p[TRIAL_BEND]
        fill_trial(m, p, y, g, h)
        value, slope = m[g, 0], m[h, 0]
        for k in range(1, n_out):
            value += m[d + k, 0] * m[g + k, 0]
            slope += m[d + k, 0] * m[h + k, 0]
        return value, slope

    found = part(named(at_output, evaluate))
    if evaluate is not built_in:
        return found

    def horner_first(m: Array, p: Places, y: float) -> tuple[float, float]:
        if m[p[OUT], 0] != POWERS:
            return found(m, p, y)  # type: ignore[no-any-return]
        value, slope = 0.0, 0.0
        for k in range(p[N_OUT] - 1, -1, -1):
            slope = slope * y + value
            value = value * y + (m[p[D_NOW] + k, 0] if k > 0 else 1.0)
        return value * y, slope * y + value

    return part(named(horner_first, evaluate))

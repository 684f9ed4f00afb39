"""Evaluate the functions of a block at a number and store them in the memory of a Hammerstein-Wiener model.

Every basis is evaluated by its compiled routine (`driftfit.models.hammerstein_wiener.curves.kernels`), called by
symbol. Raw powers and Legendre polynomials, the most common ones, are computed inline with the same operations.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, part
from driftfit.models.hammerstein_wiener.curves.kernels import LEGENDRE, POWERS
from driftfit.models.hammerstein_wiener.step_memory import (
    CURVE,
    D_NOW,
    EACH,
    N_OUT,
    OUT,
    OWN,
    OWN_END,
    OWN_INTO,
    OWN_N_IN,
    TRIAL,
    TRIAL_BEND,
    Places,
)

DIGITS = 1e13
"""Largest ratio of the functions of a reading to the first of them, or to 1. Beyond it an absurd reading would leave
too few of sixteen digits for ordinary readings in the same columns."""
CURVED = 1e19
"""Largest function of a reading if there are several functions, which are nearly proportional for large readings. The
product of two stays below LARGEST."""

Kind = tuple[Any, int]
"""The compiled routine of a basis, and its code."""


@part
def usable(m: Array, at: int, count: int) -> bool:
    """Whether the functions of a reading, stored from ``at`` on, are numbers of comparable size."""
    top = min(DIGITS * max(abs(m[at, 0]), 1.0), CURVED) if count > 1 else LARGEST
    beyond = 0
    for k in range(count):
        beyond += 0 if abs(m[at + k, 0]) < top else 1
    return beyond == 0


@lru_cache
def values_of(kind: Kind, numbers: int, following: int, count: int, bends: bool = True) -> Any:
    """A part (m, p, x, at, slopes) that fills two arrays with the functions of a block at x, and their slopes.

    Without ``bends`` the slopes are not needed and may be left unchanged.
    """
    evaluate, code = kind

    def values(m: Array, p: Places, x: float, at: int, slopes: int) -> None:
        own, L = p[numbers], m.shape[1]
        base, size = m.ctypes.data, 8 * L
        evaluate(x, base + size * own, p[following] - own, base + size * at, base + size * slopes, p[count], L)

    def powers(m: Array, p: Places, x: float, at: int, slopes: int) -> None:
        power, k = 1.0, 0.0
        for i in range(p[count]):
            k += 1.0
            if bends:
                m[slopes + i, 0] = k * power
            power = power * x
            m[at + i, 0] = power

    def legendre(m: Array, p: Places, x: float, at: int, slopes: int) -> None:
        own = p[numbers] + 1
        s, scale = (x - m[own, 0]) / m[own + 1, 0], 1.0 / m[own + 1, 0]
        before, now = 1.0, s
        slope_before, slope = 0.0, 1.0
        for k in range(p[count]):
            m[at + k, 0] = now
            if bends:
                m[slopes + k, 0] = slope * scale
            slope, slope_before = slope_before + (2 * k + 3) * now, slope
            now, before = s * now + (s * now - before) * ((k + 1) / (k + 2)), now

    return part({POWERS: powers, LEGENDRE: legendre}.get(code, values))


def input_values(kind: Kind, i: int) -> Any:
    """The values of the curve of input i, whose slopes are not needed."""
    own = OWN + EACH * i
    return values_of(kind, own + OWN_INTO, own + OWN_END, own + OWN_N_IN, bends=False)


def output_values(kind: Kind, bends: bool = True) -> Any:
    """The values of the output block."""
    return values_of(kind, OUT, CURVE, N_OUT, bends)


@lru_cache
def level_of(kind: Kind) -> Any:
    """A part (m, p, y) that returns the level of the output block at y and its slope; it may fill trial, trial_bend."""
    fill_trial = output_values(kind)

    def at_output(m: Array, p: Places, y: float) -> tuple[float, float]:
        n_out, d, g, h = p[N_OUT], p[D_NOW], p[TRIAL], p[TRIAL_BEND]
        fill_trial(m, p, y, g, h)
        value, slope = m[g, 0], m[h, 0]
        for k in range(1, n_out):
            value += m[d + k, 0] * m[g + k, 0]
            slope += m[d + k, 0] * m[h + k, 0]
        return value, slope

    def horner(m: Array, p: Places, y: float) -> tuple[float, float]:
        value, slope = 0.0, 0.0
        for k in range(p[N_OUT] - 1, -1, -1):
            slope = slope * y + value
            value = value * y + (m[p[D_NOW] + k, 0] if k > 0 else 1.0)
        return value * y, slope * y + value

    return part(horner if kind[1] == POWERS else at_output)

"""The memory of a Hammerstein-Wiener model's compiled steps: numbers and arrays one after the other in one field.

The field ``blocks`` (size, L) begins with the numbers named below. `places_of` returns the orders and where the arrays
begin. The compiled routines of the steps are given the address of ``blocks`` for one lane, in which element i is stored
L numbers after element i - 1. The places are constants of these routines, so that their loops can be unrolled.

    now, next (n)             regressors of this sample except those of its output, and of the next
    f_past  (nb + nk, n_in)   functions of the inputs t, t - 1, .., of a dead zone with the thresholds known then;
                              one array after the other where there are several inputs
    g_past  (1 + na, n_out)   functions of the outputs t, t - 1, ..; their slopes in h_past
    d_now   (n_out)           coefficients (1, d_2 ..) before the sample
    trial, trial_bend         functions and slopes at a trial y; spare, slopes that are not used
    into, out                 the numbers of the bases, those of all inputs first
    curve (n_out, ROW)        functions of the output block on the grid, and one level beyond all; bend, their slopes
    coarse (n_out, EIGHT)     the same functions at every eighth point of the grid
    level (GRID)              an envelope of the levels
    d_seen, reach (n_out)     coefficients for which the grid increases, and the safe distance from them
    spans (inputs, 2)         the range of each input
    us (inputs)               the inputs of this sample
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.products import Structure

GRID = 64
"""Points of the grid on which the output block is inverted."""
EIGHT = 8
"""Number of levels that are compared at once; GRID is its square."""
ROW = GRID + 1

(
    LOW, STEP, LOWEST, HIGHEST, BOTTOM, TOP, RISING, PREDICTED, STARTED, MINIMAL, GIVEN, RAW, VARIANCE, MOVED, LATE,
    CELL, Y, DT, BELIEVED, OK, FACTOR, LEAST, SCALE, HEAD,
) = range(24)  # fmt: skip
"""Numbers: the grid, the range of accepted outputs, where the output block is defined, results, whether all lags are
known, whether theta is xi, the given noise factor, the output as given, sigma^2 or 0, whether the range changed,
whether a level is stored in place of the prediction, its cell of the grid, what steps and compiled routine exchange, whether
the output becomes a lag, whether the sample was used, the noise factor of the equation, the least variance that sigma
adds to it, and the scale of y that the basis gives; HEAD is their number.
"""

(
    NA, NB, N_IN, N_OUT, N, NK, IDENTITY, ADAPTIVE, NOW, NEXT, F_PAST, G_PAST, H_PAST, SPARE, D_NOW, TRIAL,
    TRIAL_BEND, INTO, OUT, CURVE, BEND, COARSE, LEVEL, D_CHECKED, REACH, US, INPUTS, OWN,
) = range(28)  # fmt: skip
"""Places: orders, whether the output block is the identity and an input basis depends on its own coefficients, where
the arrays begin, and how many inputs there are. NB is the number of all b, NK the smallest delay; N_IN, F_PAST and INTO
are those of the first input.
"""
OWN_NB, OWN_N_IN, OWN_NK, OWN_F, OWN_INTO, OWN_ADAPTIVE, OWN_END, EACH = range(8)
"""From OWN on there are EACH numbers for every input: its orders, where its functions and the numbers of its basis
begin, whether the basis depends on its own coefficients, and where its numbers end.
"""


Places = Array
"""Whole numbers (28 + 7 per input,), a constant for the compiler."""


def room(p: Places | tuple[int, ...]) -> int:
    """Length of the memory of these places: the inputs are its last numbers."""
    return int(p[US] + p[INPUTS])


def _arrays(structure: Structure, nk: tuple[int, ...], into: tuple[Array, ...], out: Array) -> dict[int, Array]:
    """The arrays before the first sample, in their order."""
    na, nb, n_in, n_out, _ = structure
    lags = sum(width * (count + delay) for width, count, delay in zip(n_in, nb, nk, strict=True))
    outputs = np.full((1 + max(na, 1)) * n_out, np.nan)
    return {
        NOW: np.full(structure.n, np.nan), NEXT: np.full(structure.n, np.nan),
        F_PAST: np.full(lags, np.nan), G_PAST: outputs, H_PAST: outputs,
        SPARE: np.zeros(max(n_in)), D_NOW: np.eye(1, n_out)[0], TRIAL: np.zeros(n_out), TRIAL_BEND: np.zeros(n_out),
        INTO: np.concatenate(into), OUT: out,
        CURVE: np.zeros(ROW * n_out), BEND: np.zeros(ROW * n_out), COARSE: np.zeros(EIGHT * n_out),
        LEVEL: np.zeros(GRID), D_CHECKED: np.zeros(n_out), REACH: np.full(n_out, np.inf),
        US: np.zeros(len(nb)),
    }  # fmt: skip


def places_of(
    structure: Structure, nk: tuple[int, ...], into: tuple[Array, ...], out: Array, identity: bool,
    adaptive: tuple[bool, ...],
) -> tuple[int, ...]:  # fmt: skip
    """Orders, and where the arrays begin; ``into`` and ``out`` are the numbers of the bases."""
    na, nb, n_in, n_out, _ = structure
    arrays = _arrays(structure, nk, into, out)
    begins = np.cumsum([HEAD, *(array.size for array in arrays.values())])[:-1].tolist()
    head = (na, sum(nb), n_in[0], n_out, structure.n, min(nk), int(identity), int(any(adaptive)), *begins, len(nb))
    f, own, each = head[F_PAST], head[INTO], []
    for i in range(len(nb)):
        each += [nb[i], n_in[i], nk[i], f, own, int(adaptive[i]), own + into[i].size]
        f, own = f + n_in[i] * (nb[i] + nk[i]), own + into[i].size
    return (*head, *each)


def memory(
    structure: Structure, nk: tuple[int, ...], into: tuple[Array, ...], out: Array, limits: tuple[float, float],
    sigma: float | None, least: float, scale: float,
) -> Array:  # fmt: skip
    """``blocks`` before the first sample."""
    head = np.zeros(HEAD)
    head[[LOWEST, HIGHEST, BOTTOM, TOP]] = np.inf, -np.inf, *limits
    head[[RISING, PREDICTED]] = 1.0, np.nan
    head[[VARIANCE, LEAST, SCALE]] = 0.0 if sigma is None else sigma * sigma, least, scale
    return np.concatenate([head, *_arrays(structure, nk, into, out).values()])

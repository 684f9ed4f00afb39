"""The memory of a Hammerstein-Wiener model's compiled steps: numbers and arrays one after the other in one field.

The field ``blocks`` (size, L) begins with the numbers named below. `places_of` says the orders and where the arrays
begin. The machines behind the steps get the address of ``blocks`` for one lane, element i of which stands L numbers
after element i - 1; the places are constants to them, so that their loops unroll.

    now, next (n)             regressors of this sample but those of its output, and those of the next
    f_past  (nb + nk, n_in)   functions of the inputs t, t - 1, .., of a dead zone with the thresholds known then
    g_past  (1 + na, n_out)   functions of the outputs t, t - 1, ..; their slopes in h_past
    d_now   (n_out)           coefficients (1, d_2 ..) before the sample
    trial, trial_bend         functions and slopes at a y that is tried; spare, slopes that nobody needs
    into, out                 the numbers of the bases
    curve (n_out, ROW)        functions of the output block on the grid, and one level beyond all; bend, their slopes
    coarse (n_out, EIGHT)     the same functions at every eighth point of the grid
    level (GRID)              an envelope of the levels
    d_seen, reach (n_out)     coefficients for which the grid was found to rise, and how far it is safe to be from them
"""

from __future__ import annotations

import numpy as np

from driftfit.kernel import Array
from driftfit.models.block_products import Structure

GRID = 64
"""Points of the grid on which the output block is inverted."""
EIGHT = 8
"""Levels that are compared at once: GRID is its square."""
ROW = GRID + 1

(
    LOW, STEP, LOWEST, HIGHEST, BOTTOM, TOP, RISING, PREDICTED, STARTED, MINIMAL, GIVEN, RAW, VARIANCE, BEFORE, EARLIER,
    FIRM_LOW, FIRM_HIGH, MOVED, LATE, CELL, U, Y, DT, SEEN, OK, FACTOR, HEAD,
) = range(27)  # fmt: skip
"""Numbers: the grid, the range of outputs believed, where the output block is defined, results, whether all lags are
there, whether theta is xi, the noise factor given, the output as it came, sigma^2 or 0, the two outputs before, the
range of medians of three, whether the range moved, whether a level stands where the prediction
will, the cell of the grid that holds it, and what steps tell the machine and hear from it; HEAD is how many there are.
"""

(
    NA, NB, N_IN, N_OUT, N, NK, IDENTITY, ADAPTIVE, NOW, NEXT, F_PAST, G_PAST, H_PAST, SPARE, D_NOW, TRIAL,
    TRIAL_BEND, INTO, OUT, CURVE, BEND, COARSE, LEVEL, D_SEEN, REACH,
) = range(25)  # fmt: skip
"""Places: orders, whether the output block is the identity and the input basis depends on its own coefficients, and
where the arrays begin.
"""


Places = Array
"""Whole numbers (25,), a constant to the compiler."""


def _arrays(structure: Structure, nk: int, into: Array, out: Array) -> dict[int, Array]:
    """The arrays before the first sample, in their order."""
    na, nb, n_in, n_out, _ = structure
    outputs = np.full((1 + max(na, 1)) * n_out, np.nan)
    return {
        NOW: np.full(structure.n, np.nan), NEXT: np.full(structure.n, np.nan),
        F_PAST: np.full(n_in * (nb + nk), np.nan), G_PAST: outputs, H_PAST: outputs,
        SPARE: np.zeros(n_in), D_NOW: np.eye(1, n_out)[0], TRIAL: np.zeros(n_out), TRIAL_BEND: np.zeros(n_out),
        INTO: into, OUT: out,
        CURVE: np.zeros(ROW * n_out), BEND: np.zeros(ROW * n_out), COARSE: np.zeros(EIGHT * n_out),
        LEVEL: np.zeros(GRID), D_SEEN: np.zeros(n_out), REACH: np.full(n_out, np.inf),
    }  # fmt: skip


def places_of(
    structure: Structure, nk: int, into: Array, out: Array, identity: bool, adaptive: bool
) -> tuple[int, ...]:
    """Orders and beginnings; ``into`` and ``out`` are the numbers of the bases."""
    arrays = _arrays(structure, nk, into, out)
    ends = np.cumsum([HEAD, *(array.size for array in arrays.values())])
    return (*structure[:4], structure.n, nk, int(identity), int(adaptive), *(int(end) for end in ends[:-1]))


def memory(
    structure: Structure, nk: int, into: Array, out: Array, limits: tuple[float, float], sigma: float | None
) -> Array:
    """``blocks`` before the first sample."""
    head = np.zeros(HEAD)
    head[[LOWEST, HIGHEST, FIRM_LOW, FIRM_HIGH, BOTTOM, TOP]] = np.inf, -np.inf, np.inf, -np.inf, *limits
    head[[RISING, PREDICTED, BEFORE, EARLIER]] = 1.0, np.nan, np.nan, np.nan
    head[VARIANCE] = 0.0 if sigma is None else sigma * sigma
    return np.concatenate([head, *_arrays(structure, nk, into, out).values()])

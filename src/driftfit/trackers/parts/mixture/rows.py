"""Sum and minimum of the scratch row over the filters, in eight or four chains, none of which waits for the others.

The number of filters is a field of the state: the compiler keeps loops over it as loops, which it vectorises, while it
would unroll those of known length into single operations.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from driftfit.engine.kernel import State, kernel


@partial(kernel, inline=False)
def sum_of_row(s: State, l: int) -> float:
    """Sum of the scratch row over the filters: in eight chains, none of which waits for the others."""
    K = s.modes[l]
    for k in range(K, K + 8):
        s.row[k, l] = 0.0
    a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(0, K, 8):
        a += s.row[k, l]
        b += s.row[k + 1, l]
        c += s.row[k + 2, l]
        d += s.row[k + 3, l]
        e += s.row[k + 4, l]
        f += s.row[k + 5, l]
        g += s.row[k + 6, l]
        h += s.row[k + 7, l]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@partial(kernel, inline=False)
def least_of_row(s: State, l: int) -> float:
    """The smallest entry of the scratch row, in four chains."""
    K = s.modes[l]
    for k in range(K, K + 8):
        s.row[k, l] = np.inf
    a, b, c, d = np.inf, np.inf, np.inf, np.inf
    for k in range(0, K, 4):
        a = min(a, s.row[k, l])
        b = min(b, s.row[k + 1, l])
        c = min(c, s.row[k + 2, l])
        d = min(d, s.row[k + 3, l])
    return min(min(a, b), min(c, d))

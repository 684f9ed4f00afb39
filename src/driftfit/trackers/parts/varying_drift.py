"""A separate drift for every parameter at every sample: ``drift=`` of shape (T, n).

    q_t = diag(d_t)^(1/2) q diag(d_t)^(1/2),   d_t >= 0 known before sample t

For flexible least squares it is a separate weight for every step and parameter, mu_i / d_ti; d = 0 keeps a parameter
where it is. Trackers that support it have a field ``drift_root`` (n,), the square roots of d, which are 1 by default.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from driftfit.engine.drivers import COMMON
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.settings import as_numbers, factor


@kernel
def read_drift(s: State, known: Array, t: int, l: int) -> None:
    """Take the roots from the columns of ``known`` that only some trackers read."""
    for i in range(s.theta.shape[0]):
        s.drift_root[i, l] = known[t, COMMON + i, l]


def roots(owner: str, names: Sequence[str], T: int, drift: Any) -> Array:
    """The columns (T, n); ValueError if ``drift`` has another shape or cannot be a factor."""
    factors, n = as_numbers("drift", drift), len(names)
    if factors.shape != (T, n):
        raise ValueError(
            f"{owner}: drift with a column for each parameter must be ({T}, {n}), for {', '.join(names)}; got shape "
            f"{factors.shape}."
        )
    roots: Array = np.sqrt(factor("drift", factors.ravel(), factors.size)).reshape(T, n)
    return roots

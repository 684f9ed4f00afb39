"""What becomes of the signals of `driftfit.models.polynomial` if an input of an earlier sample is refused."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import State, kernel
from driftfit.models.polynomials.steps import EACH, HELD, OWN, SETTLING, WF, Places, U, W, credible


@kernel
def hold_before(s: State, signal: int, age: int, l: int) -> None:
    """The input before is held, also in the filters since then, as if this one had been missing."""
    own, oldest = OWN + EACH * signal, s.signals.shape[1] - 1
    s.signals[own + U, age, l] = np.nan
    for r in range(HELD, W):
        before = s.signals[own + r, age + 1, l] if age < oldest else s.left[signal, r - HELD, l]
        for i in range(age + 1):
            taken = (r > HELD) | (not abs(s.signals[own + U, i, l]) < LARGEST)
            s.signals[own + r, i, l] = before if taken else s.signals[own + r, i, l]
    s.last_input[signal, l] = s.signals[own + HELD, 0, l]


@lru_cache
def refusing(p: Places) -> Any:
    """`Model.refuse`: the input before is held, and the response w since then is without that to the difference."""
    n, m, nb, nf, nk, at_b, at_f = p.n, p.m, p.nb, p.nf, p.nk, p.at_b, p.at_f

    @kernel
    def subtract_response(s: State, j: int, age: int, l: int) -> None:
        own, first = OWN + EACH * j, age - nk[j]
        for i in range(first, -1, -1):
            w = 0.0
            for k in range(min(nb[j], first - i + 1)):
                at = i + nk[j] + k
                w += s.point[at_b[j] + k, l] * (s.recursion[0, at, l] - s.signals[own + HELD, at, l])
            for k in range(min(nf[j], first - i)):
                w += s.point[at_f[j] + k, l] * s.recursion[1, i + 1 + k, l]
            s.recursion[1, i, l] = w if credible(s, w, 0, l) else 0.0
            s.signals[own + W, i, l] -= s.recursion[1, i, l]
            s.signals[own + WF, i, l] = s.signals[own + WF, first + 1, l]

    @kernel
    def refuse(s: State, signal: int, age: int, l: int) -> None:
        for i in range(age + 1):
            s.recursion[0, i, l] = s.signals[OWN + EACH * signal + HELD, i, l]
        hold_before(s, signal, age, l)
        for j in range(m):  # the orders of an input are constants
            if (j == signal) & (s.usable[l] >= SETTLING * n):  # w of the first samples is what outputs say
                subtract_response(s, j, age, l)

    return refuse

"""A filter without drift that continues from one that has moved, because most changes end.

The filters of the ladders are mixed with all that may precede them. A filter without drift that could follow any jump
would take a share of the wide covariance of the filter that waits for jumps, at every sample, whether there was one or
not. So the last filter is not mixed with others: it continues from a single one. With e_j the probability that the
change that filter j follows is over, filter j of the largest e_j mu_j replaces the last one, a, if it is more probable:

    if e_j mu_j > mu_a:     m_a <- m_j,   C_a <- C_j,   (mu_a, mu_j) <- (e_j mu_j, mu_j - e_j mu_j + mu_a)

e_j is that of `OVER`, divided by how many times more often jumps end than expected
(`driftfit.trackers.parts.modes.ladder`): where they come every ten samples, none of them ends in rest.

The filter that took the last outlier for a jump (`driftfit.trackers.parts.modes.drifts.after_outlier`) has e_j = 1 as
soon as that is confirmed: it is free for the next outlier, and the jump is over.

While nothing changes, the last filter has hardly any probability, and costs nothing. After a jump it is the one that
learns the new level as fast as constant parameters are learned.

Source: keeping the more probable of two histories, instead of their mixture, is as in multiple hypothesis tracking
(Reid, 1979); a single history beside a mixture is ours. Cost per sample: O(K), and O(n^2) where it is replaced.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel

OVER = {1.0: 0.5, 0.2: 0.1}
"""Probability that a change of a drift ratio is over."""
CONFIRMED = 0.5
"""Probability from which on a jump at the last outlier is confirmed."""


def no_rest(rungs: Array) -> dict[str, Any]:
    """Fields before the first sample, for the rungs (K,) of the filters; the last filter is at rest."""
    return {"over": np.array([OVER.get(float(rung), 0.0) for rung in rungs]), "replaced_by": -1}


@partial(kernel, inline=False)
def come_to_rest(s: State, l: int) -> None:
    """Replace the last filter, if another has come to rest more probably."""
    last, best, most = s.modes[l] - 1, 0, 0.0
    for j in range(last):
        confirmed = (j == last - 1) & (s.mu[j, l] >= CONFIRMED)
        share = 1.0 if confirmed else s.over[j, l] / s.busy[l]
        if share * s.mu[j, l] > most:
            best, most = j, share * s.mu[j, l]
    gained = most - s.mu[last, l]
    s.replaced_by[l] = best if gained > 0.0 else -1
    if gained > 0.0:
        s.mu[last, l] = most
        s.mu[best, l] -= gained
        for i in range(s.theta.shape[0]):
            s.m[i, last, l] = s.m[i, best, l]
            for j in range(i + 1):
                s.C[i, j, last, l] = s.C[i, j, best, l]

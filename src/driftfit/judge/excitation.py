"""Excitation: do the regressors of a window distinguish the parameters?

    R_w = (1 / W) sum over a window of psi_t psi_t',     psi_ti = phi_ti / rms of regressor i over the record

The smallest eigenvalue of R_w over the largest is the reciprocal of the squared condition index of Belsley, Kuh and
Welsch (1980). Scaling makes it independent of units, and it is small in a window in which an input is constant. They
call dependence moderate to strong from 30; the limit here is 100, beyond which the parameters of that window are
determined by earlier samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.result import burn_in
from driftfit.smooth.parts.rank import column_sizes

INDEX = 100.0
"""Limit of the condition index."""


class Excitation(NamedTuple):
    """Windows of W samples, half overlapping."""

    at: Array
    """(w,): index of the last sample of each window, among the samples used."""
    eigenvalues: Array
    """(w, n) ascending."""
    direction: Array
    """(n,): the scaled combination of parameters that the worst window determines least."""

    @property
    def condition(self) -> Array:
        """(w,): condition index of each window; inf where a direction is not excited at all."""
        low, high = self.eigenvalues[:, 0], self.eigenvalues[:, -1]
        with np.errstate(divide="ignore", invalid="ignore"):
            condition: Array = np.sqrt(high / np.maximum(low, 0.0))
        return np.where(high > 0.0, condition, np.inf)


def excitation(phi: Array, window: int | None = None) -> Excitation:
    """Eigenvalues of windows of regressors phi (N, n), of max(50, 5 n) samples unless ``window`` is given."""
    N, n = phi.shape
    W = burn_in(n) if window is None else window
    ends = np.arange(W, N + 1, max(W // 2, 1))
    if not len(ends):
        return Excitation(np.zeros(0, int), np.zeros((0, n)), np.full(n, np.nan))
    scaled = phi / column_sizes(phi)
    R = np.array([scaled[end - W : end].T @ scaled[end - W : end] / W for end in ends])
    values, vectors = np.linalg.eigh(R)
    found = Excitation(ends - 1, np.maximum(values, 0.0), vectors[0, :, 0])
    return found._replace(direction=vectors[int(np.argmax(found.condition)), :, 0])

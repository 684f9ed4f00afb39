"""What the rows of a segment determine: an input that rests there, at 0 or beside an intercept, has no coefficient.

    X = rows of the segment;   theta = held + M beta,   M (n, r): directions in which X varies,   X M of full rank

beta is estimated; in all other directions theta is what it was before, and parameters with a component there have an
infinite standard error. The solution of least norm would be a number without meaning, with the error of what is
determined.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.statistics.robust import inverted, orthonormal

COMPONENT = 1e-6
"""Smallest component, in units of the regressors, that a direction has in a parameter."""
SHARE = 0.05
"""Least share of what rows tell about a direction that comes from those which certainly belong to the segment."""


class Determined(NamedTuple):
    """Directions that rows determine."""

    M: Array
    """(n, r): the identity if that is all of them."""
    unknown: Array
    """(n,): whether a parameter has a component in another direction."""

    @classmethod
    def of(cls, X: Array) -> Determined:
        """Those of rows X (N, n), N > 0."""
        n, basis = X.shape[1], orthonormal(X)
        _, size, directions = np.linalg.svd(basis.R)
        rank = int(np.sum(size > basis.negligible))
        if rank == n:
            return cls(np.eye(n), np.zeros(n, bool))
        M = directions[:rank].T / basis.size[:, None]
        return cls(M, np.linalg.norm(directions[rank:], axis=0) > COMPONENT)

    def errors(self, X: Array, variance: float) -> Array:
        """Standard errors (n,) from rows X (N, n) with noise of that variance."""
        share = np.sum((self.M @ inverted(X @ self.M)) * self.M, axis=1)
        return np.where(self.unknown, np.inf, np.sqrt(np.maximum(variance * share, 0.0)))


def doubtful(X: Array, first: int, last: int) -> bool:
    """Whether rows of X (N, n) outside of first .. last decide about some direction."""
    basis = orthonormal(X)
    left, size, _ = np.linalg.svd(basis.R)
    seen = basis.Q[first:last] @ left[:, : np.sum(size > basis.negligible)]
    return bool((np.linalg.eigvalsh(seen.T @ seen) < SHARE * len(X)).any())

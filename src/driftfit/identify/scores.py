"""Scores of regressions from block Gram matrices: how well does each predict what it has not seen, whatever its memory?

The record is cut into B blocks of rows z_t = (x_t, y_t) with Gram matrices G_b. A regression on the columns S predicts
block b with coefficients from the other blocks, discounted by their distance, for each of several memories f:

    C_b = sum_(i != b) lam^|b - i| G_i + ridge,   lam = exp(-1 / (f B)),   theta_b = C_b[S, S]^-1 C_b[S, y]
    log p_b = -(n_b / 2) log(e_b / n_b + floor),   e_b the sum of squares of block b under theta_b

The memories are mixed with weights of which 1 / B is shared again at every block (Herbster and Warmuth, 1998), so that
a coefficient that drifts does not hide its column. A quiet block cannot be predicted much better than the record: that
is the floor. Cost: O(B p^2) memory, O(B k^2 p) for the scores of all p columns added to k.
"""

from __future__ import annotations

import itertools

import numpy as np

from driftfit.engine.kernel import Array

MEMORIES = (np.inf, 0.3, 0.1, 0.03)
"""Memories, as shares of the record."""
RIDGE = 1e-3
FLOOR = 0.3
"""The floor, as a share of the variance of the best regression known."""
FEWEST = 60
"""Rows that a record needs."""


class Scores:
    """Scores of regressions of y (N,) on columns of X (N, p), which contain the constant first; rows are complete."""

    def __init__(self, X: Array, y: Array, memories: tuple[float, ...] = MEMORIES, rows: int = 30) -> None:
        N, self.p = X.shape
        mean, std = X.mean(axis=0), X.std(axis=0)
        mean[0], std[0] = 0.0, 1.0
        self.flat = std < 1e-9 * (1e-300 + np.abs(X).max(axis=0))
        std[self.flat] = 1.0
        self.size = float(np.std(y)) or 1.0
        Z = np.column_stack([(X - mean) / std, (y - np.mean(y)) / self.size])
        B = int(np.clip(N // rows, 8, 80))
        edges = np.linspace(0, N, B + 1).astype(int)
        self.count = np.diff(edges).astype(float)
        self.G = np.stack([Z[a:b].T @ Z[a:b] for a, b in itertools.pairwise(edges)])
        apart = np.abs(np.subtract.outer(np.arange(B), np.arange(B)))
        shares = [np.exp(-apart / (f * B)) * (apart > 0) for f in memories if f * N >= FEWEST]
        self.rest = np.tensordot(np.stack(shares), self.G, 1)
        self.rest[..., range(self.p + 1), range(self.p + 1)] += RIDGE
        self.floor = 0.0

    def refer(self, S: list[int]) -> None:
        """Set the floor by a regression."""
        self.floor = FLOOR * float(self._fit(S)[0].sum(axis=1).min() / self.count.sum())

    def _fit(self, S: list[int]) -> tuple[Array, Array]:
        """(sums of squares (L, B), coefficients (L, B, k))."""
        A, g = self.rest[:, :, S][..., S], self.rest[:, :, S, -1]
        theta = np.linalg.solve(A, g[..., None])[..., 0]
        cross = np.einsum("lbk,bk->lb", theta, self.G[:, S, -1])
        e = self.G[:, -1, -1] - 2.0 * cross + np.einsum("lbk,bkj,lbj->lb", theta, self.G[:, S][..., S], theta)
        return np.maximum(e, 1e-12), theta

    def _mixed(self, e: Array) -> Array:
        """Log-likelihoods (B, ...) of sums of squares (L, B, ...), the memories mixed."""
        count = self.count.reshape(-1, *[1] * (e.ndim - 2))
        each = -0.5 * count * np.log(np.maximum(e, 1e-12) / count + self.floor)
        weight, terms = np.full((len(e), *e.shape[2:]), 1.0 / len(e)), []
        for b in range(e.shape[1]):
            top = each[:, b].max(axis=0)
            joint = weight * np.exp(each[:, b] - top)
            total = joint.sum(axis=0)
            terms.append(top + np.log(total))
            weight = (1.0 - 1.0 / len(count)) * joint / total + 1.0 / len(count) / len(e)
        return np.stack(terms)

    def terms(self, S: list[int]) -> Array:
        """Log-likelihoods of the blocks of a regression."""
        return self._mixed(self._fit(S)[0])

    def score(self, S: list[int]) -> float:
        """Their sum."""
        return float(self.terms(S).sum())

    def added(self, S: list[int]) -> Array:
        """(p,): the score of S with each column added; -inf for columns of S, and flat ones."""
        p, G, own = self.p, self.G, self.rest[:, :, S]
        W = np.linalg.solve(own[..., S], own[..., :p])  # regressions of all columns on S
        e, theta = self._fit(S)
        left = np.einsum("lbpp->lbp", self.rest)[..., :p] - np.einsum("lbkp,lbkp->lbp", own[..., :p], W)
        top = self.rest[..., :p, -1] - np.einsum("lbkp,lbk->lbp", W, own[..., -1])
        alone = left > 1e-7 * (1.0 + np.einsum("lbpp->lbp", self.rest)[..., :p])
        c = np.where(alone, top / np.where(alone, left, 1.0), 0.0)
        GS, GSS = G[:, S, :p], G[:, S][..., S]
        rest = G[:, S, -1] - np.einsum("bkj,lbj->lbk", GSS, theta)
        cross = G[:, :p, -1] - np.einsum("lbk,bkp->lbp", theta, GS) - np.einsum("lbkp,lbk->lbp", W, rest)
        square = np.einsum("bpp->bp", G)[:, :p] + np.einsum("lbkp,lbkp->lbp", W, GSS @ W - 2.0 * GS)
        found: Array = self._mixed(e[..., None] - 2.0 * c * cross + c * c * square).sum(axis=0)
        found[S], found[self.flat] = -np.inf, -np.inf
        return found


def lead(better: Array, worse: Array) -> tuple[float, float]:
    """By how many nats one sequence of log-likelihoods is above another, with its standard error."""
    difference = better - worse
    return float(difference.sum()), float(difference.std() * np.sqrt(len(difference)))

"""Pruning by approximation as the paper words it: the mixture over the oldest event becomes one density, the root of a
new tree, which the samples since grow again.

    C' = C + sum_i w_i Q_i,   w_i = p(c_i | data)

The components of the first floor share their mean. The samples that gave their weights are filtered again, and so count
twice; merging leaves at present time (`driftfit.GPB`) uses each once.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from lab.jumps import Jumping


@dataclass
class Leaves:
    """Weights (L,), means (L, n) and covariances (L, n, n) of a tree, ordered by its events, the oldest first."""

    w: Array
    m: Array
    C: Array

    def grown(self, Q: Array, p: Array, r: float, x: Array, y: float) -> tuple[Leaves, float]:
        """The next floor, whose events have covariances Q and probabilities p, and the log density of y."""
        C = (self.C[:, None] + Q).reshape(-1, len(x), len(x))
        m, g = np.repeat(self.m, len(Q), axis=0), C @ x
        s, e = g @ x + r, y - m @ x
        w = np.outer(self.w, p).ravel() * np.exp(-0.5 * e**2 / s) / np.sqrt(2.0 * np.pi * s)
        mass = float(w.sum())
        grown = Leaves(w / mass, m + g * (e / s)[:, None], C - g[:, :, None] * g[:, None, :] / s[:, None, None])
        return grown, float(np.log(mass))


def first_floor(record: Jumping, changes: Any, r: float, p0: float) -> Any:
    """A run with a tree of two floors: what a table asks of a run and of its hypotheses."""
    n, T, H = record.theta.shape[1], len(record.y), len(changes)
    past = np.r_[0.0, 0.0, record.y]
    rows = np.stack([past[1:-1], past[:-2], record.u], axis=1)
    Q, p = np.array([one.increments(n)[0] for one in changes]), np.array([one.prob for one in changes])
    one, none = np.ones(1), np.zeros((1, n, n))
    root = Leaves(one, np.zeros((1, n)), p0 * np.eye(n)[None])
    leaves, theta, P = root, np.empty((T, n)), np.empty((T, n, n))
    evidence, older, count = np.empty(T), np.full((T, 2, H), np.nan), np.empty(T)
    for t in range(T):
        if t > 1:
            mixed = np.einsum("i,ijk->jk", leaves.w.reshape(H, -1).sum(axis=1), Q)
            root.C = root.C + mixed
            root, _ = root.grown(none, one, r, rows[t - 2], record.y[t - 2])
            leaves, _ = root.grown(Q, p, r, rows[t - 1], record.y[t - 1])
        leaves, evidence[t] = leaves.grown(Q, p, r, rows[t], record.y[t])
        theta[t] = leaves.w @ leaves.m
        off = leaves.m - theta[t]
        P[t] = np.einsum("l,lij->ij", leaves.w, leaves.C + off[:, :, None] * off[:, None, :])
        count[t] = len(leaves.w)
        if t > 0:
            older[t, 1] = leaves.w.reshape(H, -1).sum(axis=1)
    hypotheses = SimpleNamespace(evidence=evidence, lag_prob=older, leaves=count, run=theta, sensors=1)
    return SimpleNamespace(theta=theta, hypotheses=hypotheses, written=lambda name: P)

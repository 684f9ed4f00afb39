"""A bank of hypotheses the slow way: leaves are objects, histories are tuples, written as in the books."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np


@dataclass
class Leaf:
    m: np.ndarray
    C: np.ndarray
    logw: float
    history: tuple = ()
    lags: tuple = ()


def log_normal(e, s):
    return -0.5 * (np.log(2.0 * np.pi * s) + e * e / s)


def normalised(leaves):
    top = max(leaf.logw for leaf in leaves)
    total = top + np.log(sum(np.exp(leaf.logw - top) for leaf in leaves))
    return [replace(leaf, logw=leaf.logw - total) for leaf in leaves], total


class Bank:
    """``Q`` (H_d, n, n), ``sensors`` [(r, offset, cleans)], ``P`` (H, H), ``initial`` (H,), ``reduce(leaves)``."""

    def __init__(self, Q, sensors, P, initial, m0, C0, reduce=lambda leaves: leaves, na=0):
        self.Q, self.sensors, self.P, self.initial, self.reduce, self.na = Q, sensors, P, initial, reduce, na
        self.grown = [Leaf(np.asarray(m0, float), np.asarray(C0, float), 0.0, (), (0.0,) * na)]
        self.evidence = 0.0

    def see(self, z, y):
        parents, _ = normalised(self.reduce(self.grown))
        children = []
        for leaf, (i, j) in product(parents, product(range(len(self.Q)), range(len(self.sensors)))):
            e = i * len(self.sensors) + j
            p = self.P[leaf.history[-1], e] if leaf.history else self.initial[e]
            if p == 0.0:
                continue
            r, b, cleans = self.sensors[j]
            zl = np.r_[leaf.lags, z[self.na :]]
            C = leaf.C + self.Q[i]
            s, eps = r + zl @ C @ zl, y - b - zl @ leaf.m
            K = C @ zl / s
            lags = ((zl @ leaf.m if cleans else y - b), *leaf.lags)[: self.na]
            children.append(
                Leaf(leaf.m + K * eps, C - np.outer(K, C @ zl), leaf.logw + np.log(p) + log_normal(eps, s),
                     (*leaf.history, e), lags)
            )  # fmt: skip
        self.grown, gone = normalised(children)
        self.evidence += gone
        return gone

    @property
    def weights(self):
        return np.exp([leaf.logw for leaf in self.grown])

    @property
    def mean(self):
        return sum(w * leaf.m for w, leaf in zip(self.weights, self.grown, strict=True))

    @property
    def cov(self):
        mean = self.mean
        return sum(
            w * (leaf.C + np.outer(leaf.m - mean, leaf.m - mean))
            for w, leaf in zip(self.weights, self.grown, strict=True)
        )

    def lag(self, k, H):
        p = np.zeros(H)
        for w, leaf in zip(self.weights, self.grown, strict=True):
            p[leaf.history[-1 - k]] += w
        return p


def beam(M):
    return lambda leaves: sorted(leaves, key=lambda leaf: -leaf.logw)[:M]


def uniform(seed, k):
    """Number k of splitmix64."""
    x = (seed * 2**32 + k * 0x9E3779B97F4A7C15) % 2**64
    x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    x = (x ^ x >> 27) * 0x94D049BB133111EB % 2**64
    return ((x ^ x >> 31) >> 11) / 2**53


def resampled(w, M, u):
    """Weights after optimal resampling: those above c as they were, of the rest every c-th of their sum."""
    if (w > 0.0).sum() <= M:
        return w
    c = next(c for k in range(M) for c in [np.sort(w)[: len(w) - k].sum() / (M - k)] if (w > c).sum() == k)
    rest = np.where(w > c, 0.0, w)
    hits = np.floor(np.cumsum(rest) / c - u) - np.floor((np.cumsum(rest) - rest) / c - u)
    return np.where(w > c, w, hits * c)


def resample(M, seed, Hm):
    """The same at random; leaves by sensor, change and parent."""

    def some(leaves):
        leaves = sorted(leaves, key=lambda leaf: tuple((e % Hm, e // Hm) for e in leaf.history[-1:]))
        w = np.exp([leaf.logw for leaf in leaves])
        new = resampled(w / w.sum(), M, uniform(seed, len(leaves[0].history) - 1))
        return [replace(leaf, logw=np.log(p)) for leaf, p in zip(leaves, new, strict=True) if p > 0.0]

    return some


def decide(depth, H):
    """Cut the branches that lose the decision on the event ``depth`` back."""

    def cut(leaves):
        if len(leaves[0].history) < depth:
            return leaves
        p = np.zeros(H)
        for leaf in leaves:
            p[leaf.history[-depth]] += np.exp(leaf.logw)
        best = int(np.argmax(p))
        return [leaf for leaf in leaves if leaf.history[-depth] == best]

    return cut


def merged(leaves, history):
    w = np.exp([leaf.logw for leaf in leaves])
    share = w / w.sum()
    m = sum(p * leaf.m for p, leaf in zip(share, leaves, strict=True))
    C = sum(p * (leaf.C + np.outer(leaf.m - m, leaf.m - m)) for p, leaf in zip(share, leaves, strict=True))
    lags = tuple(sum(p * np.array(leaf.lags) for p, leaf in zip(share, leaves, strict=True)))
    return Leaf(m, C, np.log(w.sum()), history, lags)


def gpb(n):
    """Merge what agrees in the newest n - 1 events (n at least 2, or independent events)."""

    def merge(leaves):
        groups = {}
        for leaf in leaves:
            groups.setdefault(leaf.history[len(leaf.history) - (n - 1) :], []).append(leaf)
        return [merged(group, key) for key, group in groups.items()]

    return merge


def evidence_of(sequence, Z, y, Q, r, m0, C0):
    """log p(y | events) of the joint Gaussian of all outputs, without any recursion."""
    K, n = Z.shape
    big = np.zeros((K * n, K * n))
    total = np.array(C0, float)
    covs = []
    for i in sequence:
        total = total + Q[i]
        covs.append(total)
    for a in range(K):
        for b in range(K):
            big[a * n : (a + 1) * n, b * n : (b + 1) * n] = covs[min(a, b)]
    rows = np.zeros((K, K * n))
    for a in range(K):
        rows[a, a * n : (a + 1) * n] = Z[a]
    S = rows @ big @ rows.T + np.diag(r)
    e = y - Z @ m0
    return -0.5 * (K * np.log(2.0 * np.pi) + np.linalg.slogdet(S)[1] + e @ np.linalg.solve(S, e))

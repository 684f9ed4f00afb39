"""Which parameters change at each date, and whether a change is temporary.

Changes of all parameters at all dates are tried, and the one that is needed least is left out until each of those that
remain gains log N + 2 log n (the extended criterion of Chen and Chen, 2008). Of explanations that the record cannot tell
apart, whose likelihoods differ by a factor of at most e^2, that of the intercept is given, and the others beside it. Two
successive dates are one temporary change if a return in full costs less than the coefficients that it saves.
Cost: O(N K^2 n^2) once, and K n small regressions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.dates import Dated
from driftfit.judge.changes.fit import split, white_rows
from driftfit.judge.changes.null import Model
from driftfit.judge.changes.scan import SMALL

ALIKE = 4.0
"""Twice the logarithm of the likelihood ratio up to which two explanations are alike."""
RANK = 1e-10
"""Smallest singular value that counts, as a share of the largest."""


class Which(NamedTuple):
    """What changes."""

    at: tuple[tuple[int, ...], ...]
    """For each date, the parameters that change."""
    instead: tuple[tuple[int, ...], ...]
    """For each date at which one changes, those whose change would explain the record as well."""
    temporary: tuple[int, ...]
    """Dates k after which date k + 1 takes the change back."""
    rss: float
    used: int
    """Coefficients in use, those of the first segment among them."""


class _Reduced:
    """Sums of squares of sets of columns, from the triangle of all of them."""

    def __init__(self, Z: Array, z: Array) -> None:
        self.N = len(z)
        R = np.asarray(np.linalg.qr(np.column_stack([Z, z]), mode="r"))
        self.R: Array = R[:, :-1]
        self.z: Array = R[:, -1]

    def fit(self, columns: list[int]) -> tuple[float, Array]:
        """Sum of squares, and by how much it grows without each of the columns."""
        A = self.R[:, columns]
        left, size, right = np.linalg.svd(A, full_matrices=False)
        kept = size > RANK * max(size[0], SMALL)
        root = right[kept].T / size[kept]
        beta = root @ (left[:, kept].T @ self.z)
        r = self.z - A @ beta
        return float(r @ r) + SMALL, beta**2 / np.maximum(np.sum(root * root, axis=1), SMALL)

    def loss(self, rss: float, more: Array | float) -> Array:
        """What a growth of a sum of squares costs."""
        return np.asarray(self.N * np.log1p(more / rss))


def which(model: Model, found: Dated) -> Which:
    """The changes at each date of a record."""
    N, n = model.phi.shape
    K = len(found.breaks)
    size = np.sqrt(np.mean(model.phi**2, axis=0))
    columns = split(model.phi / np.where(size > 0.0, size, 1.0), found.breaks)
    all_of = _Reduced(*white_rows(columns, model.y, model.noise.lags, found.ar, model.noise.g))
    need = np.log(N) + 2.0 * np.log(n)
    base, kept = list(range(n)), [(k, j) for k in range(K) for j in range(n)]

    def at(changes: list[tuple[int, int]]) -> list[int]:
        return base + [n * (k + 1) + j for k, j in changes]

    rss, more = all_of.fit(at(kept))
    while kept:
        loss = all_of.loss(rss, more[n:])
        dates = [k for k, _ in kept]
        loss[[dates.count(k) == 1 for k in dates]] = np.inf
        least = int(np.argmin(loss))
        if not loss[least] < need:
            break
        kept.pop(least)
        rss, more = all_of.fit(at(kept))
    flat = [j for j in range(n) if np.ptp(model.phi[:, j] / model.root) == 0.0]
    sets = [tuple(j for k, j in kept if k == date) for date in range(K)]
    instead: list[tuple[int, ...]] = []
    for date in range(K):
        others = [one for one in kept if one[0] != date]
        alike = []
        if len(sets[date]) == 1:
            alike = [
                j for j in range(n)
                if j not in sets[date]
                and all_of.loss(rss, max(all_of.fit(at([*others, (date, j)]))[0] - rss, 0.0)) < ALIKE
            ]  # fmt: skip
            if flat and flat[0] in alike:
                alike = sorted({*alike, *sets[date]} - {flat[0]})
                sets[date] = (flat[0],)
                kept = sorted([*others, (date, flat[0])])
                rss, _ = all_of.fit(at(kept))
        instead.append(tuple(alike))
    used = n + len(kept)
    temporary: list[int] = []
    for date in range(K - 1):
        if temporary and temporary[-1] == date - 1:
            continue
        both = sorted({*sets[date], *sets[date + 1]})
        rest = [one for one in kept if one[0] not in (date, date + 1)]
        Z = np.column_stack([
            all_of.R[:, at(rest)], *(all_of.R[:, n * (date + 1) + j] - all_of.R[:, n * (date + 2) + j] for j in both)
        ])  # fmt: skip
        r = all_of.z - Z @ np.linalg.lstsq(Z, all_of.z, rcond=None)[0]
        saved = len(sets[date]) + len(sets[date + 1]) - len(both)
        if all_of.loss(rss, max(float(r @ r) - rss, 0.0)) < need * saved:
            temporary.append(date)
            used -= saved
    return Which(tuple(sets), tuple(instead), tuple(temporary), rss, used)

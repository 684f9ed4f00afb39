"""Which parameters change at each date, by how much, and whether a change is temporary.

Changes of all parameters at all dates are tried, and the one that is needed least is left out until each of those that
remain gains log N + 2 log n (the extended criterion of Chen and Chen, 2008). Two successive dates are one temporary
change if a return in full, of a single parameter or of the same ones, costs less than the coefficients that it saves.
Of explanations by one parameter that the record cannot tell apart, whose likelihoods differ by a factor of at most e^3
while their dates move by up to `NEAR` rows, that of the intercept is given, and the others beside it. Values are least
squares with the changes that remain. Their errors are White's, with what they vary by while a date moves.
Cost: O(N K^2 n^2) once, K n small regressions, and O(N K n) for each row by which a date moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.dates import Dated, covariance
from driftfit.judge.changes.fit import left, split, white_rows
from driftfit.judge.changes.null import Model
from driftfit.judge.statistics.robust import SMALL

ALIKE = 6.0
"""Twice the logarithm of the likelihood ratio from which on the evidence is strong (Kass and Raftery, 1995)."""
RANK = 1e-10
"""Smallest singular value that counts, as a share of the largest."""
EXACT = 1e-14
"""Share of the sum of squares of constants below which a sum of squares is rounding."""
NEAR = 4
"""Rows by which the date of another explanation may differ."""


class Which(NamedTuple):
    """What changes at K dates."""

    dates: Array
    """(K,): the dates, moved to those of the explanation that is given."""
    at: tuple[tuple[int, ...], ...]
    """For each date, the parameters that change."""
    instead: tuple[tuple[int, ...], ...]
    """For each date at which one changes, those whose change would explain the record as well."""
    temporary: tuple[int, ...]
    """Dates k after which date k + 1 takes the change back."""
    theta: Array
    """(K + 1, n): the parameters with these changes alone, in units of the model."""
    std: Array
    """(K, n): standard errors of the changes; 0 of parameters that do not change."""
    rss: float
    used: int
    """Coefficients in use, those of the first segment among them."""


class _Reduced:
    """Sums of squares of sets of columns, from the triangle of all of them."""

    def __init__(self, Z: Array, z: Array) -> None:
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


class _Search:
    """The changes of one record, and what they explain."""

    def __init__(self, model: Model, found: Dated) -> None:
        self.model, self.ar, self.dates = model, found.ar, found.breaks.copy()
        self.N, self.n = model.phi.shape
        size = np.sqrt(np.mean(model.phi**2, axis=0))
        self.size = np.where(size > 0.0, size, 1.0)
        self.phi = model.phi / self.size
        self.flat = [j for j in range(self.n) if np.ptp(model.phi[:, j] / model.root) == 0.0]
        self.whole = float(np.sum((model.y * model.noise.g) ** 2)) + SMALL
        self.need = np.log(self.N) + 2.0 * np.log(self.n)
        self.sets = self._needed()
        self.instead: list[tuple[int, ...]] = [()] * len(self.dates)
        self.temporary: list[int] = []

    def loss(self, rss: float, other: float | Array) -> Array:
        """What an explanation with a larger sum of squares costs; those of rounding are equal."""
        least = max(rss, EXACT * self.whole)
        return np.asarray(self.N * np.log(np.maximum(other, least) / least))

    def white(self, columns: Array) -> tuple[Array, Array]:
        """Columns and outputs after whitening."""
        return white_rows(columns, self.model.y, self.model.noise.lags, self.ar, self.model.noise.g)

    def _needed(self) -> list[tuple[int, ...]]:
        """The parameters that change at each date."""
        n, K = self.n, len(self.dates)
        reduced = _Reduced(*self.white(split(self.phi, self.dates)))
        kept = [(k, j) for k in range(K) for j in range(n)]
        while kept:
            rss, more = reduced.fit([*range(n), *(n * (k + 1) + j for k, j in kept)])
            loss = self.loss(rss, rss + more[n:])
            at = [k for k, _ in kept]
            loss[[at.count(k) == 1 for k in at]] = np.inf
            least = int(np.argmin(loss))
            if not loss[least] < self.need:
                break
            kept.pop(least)
        return [tuple(j for k, j in kept if k == date) for date in range(K)]

    def columns(self, without: tuple[int, ...] = ()) -> Array:
        """(N, q): regressors of the first segment and of every change, but those of some dates."""
        t, made = np.arange(self.N), [self.phi]
        for k, own in enumerate(self.sets):
            if k in without or k - 1 in self.temporary:
                continue
            last = self.dates[k + 1] if k in self.temporary else self.N
            made.append(self.phi[:, own] * ((t >= self.dates[k]) & (t < last))[:, None])
        return np.hstack(made)

    def left(self, columns: Array) -> float:
        """The sum of squares that columns leave."""
        return left(*self.white(columns))

    def alone(self, first: int, last: int | None) -> tuple[Array, Array]:
        """Sums of squares (n,) if one parameter changes at date ``first``, and back at ``last``; the best dates."""
        pair = (first,) if last is None else (first, last)
        Z, z = self.white(self.columns(pair))
        Q = np.linalg.qr(Z)[0]
        r = z - Q @ (Q.T @ z)
        gap, t = self.model.noise.fewest, np.arange(self.N)[:, None]
        before = self.dates[first - 1] if first else 0
        after = self.dates[pair[-1] + 1] if pair[-1] + 1 < len(self.dates) else self.N
        least, ends = np.full(self.n, np.inf), np.zeros((self.n, len(pair)), np.int64)
        for j in range(self.n):
            own = [int(self.dates[k]) for k in pair]
            for end in (0, 1, 0)[: 3 if last is not None else 1]:
                low = own[0] + gap if end else before + gap
                high = own[1] - gap if not end and last is not None else after - gap
                tried = own[end] + np.arange(-NEAR, NEAR + 1)
                tried = tried[(tried == own[end]) | ((tried >= low) & (tried <= high))]
                start, stop = (tried, own[1] if last is not None else self.N) if end == 0 else (own[0], tried)
                C, _ = self.white(self.phi[:, j : j + 1] * ((t >= start) & (t < stop)))
                whole = np.sum(C * C, axis=0)
                C = C - Q @ (Q.T @ C)
                part = np.sum(C * C, axis=0)
                gain = np.where(part > RANK * whole, (C.T @ r) ** 2 / np.maximum(part, SMALL), 0.0)
                own[end] = int(tried[np.argmax(gain)])
                least[j] = float(r @ r - gain.max()) + SMALL
            ends[j] = own
        return least, ends

    def give(self, pair: tuple[int, ...], least: Array, ends: Array) -> None:
        """Explain the changes at some dates by the parameter that does so best, or as well and is the intercept."""
        best = int(np.argmin(least))
        alike = [j for j in range(self.n) if self.loss(least[best], least[j]) < ALIKE]
        if self.flat and self.flat[0] in alike:
            best = self.flat[0]
        self.dates[list(pair)] = ends[best]
        for k in pair:
            self.sets[k], self.instead[k] = (best,), tuple(j for j in alike if j != best)

    def settle(self) -> None:
        """Temporary changes, and other explanations."""
        k, K = 0, len(self.dates)
        while k < K:
            rss = self.left(self.columns())
            if k + 1 < K:
                count = len(self.sets[k]) + len(self.sets[k + 1])
                least, ends = self.alone(k, k + 1)
                if self.loss(rss, least.min()) < self.need * (count - 1):
                    self.give((k, k + 1), least, ends)
                    self.temporary.append(k)
                    k += 2
                    continue
                before = self.sets[k]
                self.sets[k] = tuple(sorted({*before, *self.sets[k + 1]}))
                self.temporary.append(k)
                if self.loss(rss, self.left(self.columns())) < self.need * (count - len(self.sets[k])):
                    k += 2
                    continue
                self.sets[k] = before
                self.temporary.pop()
            if len(self.sets[k]) == 1:
                least, ends = self.alone(k, None)
                if self.loss(least.min(), least[self.sets[k][0]]) < ALIKE:
                    self.give((k,), least, ends)
            k += 1


def which(model: Model, found: Dated) -> Which:
    """The changes at each date of a record."""
    search = _Search(model, found)
    search.settle()
    n, K = search.n, len(search.dates)
    Z, z = search.white(search.columns())
    beta, V = covariance(Z, z)
    r = z - Z @ beta
    delta, std = np.zeros((K, n)), np.zeros((K, n))
    error, place = np.sqrt(np.diag(V)), n
    for k, own in enumerate(search.sets):
        if k - 1 in search.temporary:
            delta[k], std[k] = -delta[k - 1], std[k - 1]
            continue
        for j in own:
            delta[k, j] = beta[place] / search.size[j]
            std[k, j] = np.hypot(error[place] / search.size[j], np.sqrt(found.moved[k, j] + found.moved[k + 1, j]))
            place += 1
    theta = beta[:n] / search.size + np.vstack([np.zeros((1, n)), np.cumsum(delta, axis=0)])
    sets = tuple(search.sets[k - 1] if k - 1 in search.temporary else own for k, own in enumerate(search.sets))
    return Which(
        search.dates, sets, tuple(search.instead), tuple(search.temporary), theta, std, float(r @ r) + SMALL, Z.shape[1]
    )

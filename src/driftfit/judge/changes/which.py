"""Which parameters change at each date, by how much, and whether a change is temporary.

Changes of all parameters at all dates are tried, and the one that is needed least is left out until each of those that
remain gains log N + 2 log n (the extended criterion of Chen and Chen, 2008). Two successive dates are one temporary
change if a return in full, of a single parameter or of the same ones, costs less than the coefficients that it saves.
Of explanations by one parameter that the record cannot tell apart, whose likelihoods differ by a factor of at most e^3,
that of the intercept is given, and the others beside it. Values are least squares with the changes that remain. Their
errors are White's, with what they vary by while a date moves. Cost: O(N K^2 n^2) once, and K n small regressions.
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


class Which(NamedTuple):
    """What changes at K dates."""

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


class _Search:
    """The changes of one record, and what they explain."""

    def __init__(self, model: Model, found: Dated) -> None:
        self.model, self.ar, self.dates = model, found.ar, found.breaks
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
        R = np.asarray(np.linalg.qr(np.column_stack(self.white(split(self.phi, self.dates))), mode="r"))
        kept = [(k, j) for k in range(K) for j in range(n)]
        while kept:
            A = R[:, [*range(n), *(n * (k + 1) + j for k, j in kept)]]
            inverse = np.linalg.pinv(A, rcond=RANK)
            beta = inverse @ R[:, -1]
            rss = float(np.sum((R[:, -1] - A @ beta) ** 2)) + SMALL
            loss = self.loss(rss, rss + (beta**2 / np.maximum(np.sum(inverse**2, axis=1), SMALL))[n:])
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

    def alone(self, *pair: int) -> Array:
        """Sums of squares (n,) if one parameter changes at the first of these dates, and back at a second one."""
        Z, z = self.white(self.columns(pair))
        Q, t, ends = np.linalg.qr(Z)[0], np.arange(self.N)[:, None], [*self.dates[list(pair)], self.N]
        r = z - Q @ (Q.T @ z)
        C, _ = self.white(self.phi * ((t >= ends[0]) & (t < ends[1])))
        whole = np.sum(C * C, axis=0)
        C -= Q @ (Q.T @ C)
        part = np.sum(C * C, axis=0)
        gain = np.where(part > RANK * whole, (C.T @ r) ** 2 / np.maximum(part, SMALL), 0.0)
        return np.asarray(r @ r - gain + SMALL)

    def give(self, pair: tuple[int, ...], least: Array) -> None:
        """Explain the changes at some dates by the parameter that does so best, or as well and is the intercept."""
        best = int(np.argmin(least))
        alike = [j for j in range(self.n) if self.loss(least[best], least[j]) < ALIKE]
        if self.flat and self.flat[0] in alike:
            best = self.flat[0]
        for k in pair:
            self.sets[k], self.instead[k] = (best,), tuple(j for j in alike if j != best)

    def settle(self) -> None:
        """Temporary changes, and other explanations."""
        k, K = 0, len(self.dates)
        while k < K:
            rss = self.left(self.columns())
            if k + 1 < K:
                count = len(self.sets[k]) + len(self.sets[k + 1])
                least = self.alone(k, k + 1)
                if self.loss(rss, least.min()) < self.need * (count - 1):
                    self.give((k, k + 1), least)
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
                least = self.alone(k)
                if self.loss(least.min(), least[self.sets[k][0]]) < ALIKE:
                    self.give((k,), least)
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
    return Which(sets, tuple(search.instead), tuple(search.temporary), theta, std, float(r @ r) + SMALL, Z.shape[1])

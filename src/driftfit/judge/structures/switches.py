"""When did the structure change? A delay that drifts, an order that a new load requires, with dates.

    P(k_t = j | k_(t-1) = i) = 1 - change if i = j, change / (K - 1) otherwise         K structures
    p(y_t | k_t, past)                                                             their predictions, from `select`

The most probable sequence of structures is found by Viterbi's algorithm. Its dates are late, because a structure has to
learn its parameters after it has become the right one. So each date is estimated again: with least squares of the old
structure on the samples before d and of the new one on those after it, within `WINDOW` samples and no further than the
neighbouring switches,

    p(d) proportional to (SSR_before(d) + SSR_after(d))^(-N / 2)

whose mode is the date, and whose central 95 % the interval.

Use it for structures that are columns of one regression (`ARX`, `Regression`), followed by a tracker that adapts.

Source: Rabiner, A tutorial on hidden Markov models, Proc. IEEE 77 (1989); Bai, Least squares estimation of a shift in
linear processes, J. Time Series Analysis 15 (1994), for the date. Cost: O(T K^2), and O(W^2 n^2) for each switch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.fit import left

WINDOW = 200
"""Samples on either side of a switch from which its date is estimated."""

LATE, EARLY = 100, 50
"""Samples before and after the date in the most probable sequence among which the date is searched."""


class Switch(NamedTuple):
    """A change of structure: ``at`` is the first sample of the new one, within [earliest, latest] with 95 %."""

    at: int
    earliest: int
    latest: int
    before: str
    after: str


def most_probable(terms: Array, change: float) -> Array:
    """The most probable sequence (T,) of K states with log densities ``terms`` (T, K); Viterbi's algorithm."""
    T, K = terms.shape
    move = np.full((K, K), np.log(change / max(K - 1, 1)))
    np.fill_diagonal(move, np.log1p(-change))
    best, came = terms[0].copy(), np.zeros((T, K), int)
    for t in range(1, T):
        found = best[:, None] + move
        came[t] = np.argmax(found, axis=0)
        best = found[came[t], np.arange(K)] + terms[t]
    path = np.empty(T, int)
    path[-1] = int(np.argmax(best))
    for t in range(T - 1, 0, -1):
        path[t - 1] = came[t, path[t]]
    return path


def dated(y: Array, old: Array, new: Array, near: int) -> tuple[int, int, int]:
    """(date, earliest, latest) of a switch near a sample, from regressors (N, .) of both structures."""
    N, least = len(y), max(old.shape[1], new.shape[1]) + 3
    low, high = max(least, near - LATE), min(N - least, near + EARLY)
    if high <= low:
        return near, near, near
    dates = np.arange(low, high + 1)
    total = np.array([left(old[:d], y[:d]) + left(new[d:], y[d:]) for d in dates])
    logs = -0.5 * N * np.log(np.maximum(total, 1e-300 + 1e-14 * float(y @ y)))
    share = np.exp(logs - logs.max())
    share = np.cumsum(share / share.sum())
    ends = np.searchsorted(share, [0.025, 0.975])
    return int(dates[np.argmax(logs)]), int(dates[ends[0]]), int(dates[min(ends[1], len(dates) - 1)])


def switches(
    names: tuple[str, ...], terms: Array, y: Array, phi: Array, columns: list[list[int]], change: float
) -> list[Switch]:
    """The switches between structures, from log densities (T, K), outputs and the regressors (T, n) of their union."""
    known = np.isfinite(terms).all(axis=1) & np.isfinite(phi).all(axis=1) & np.isfinite(y)
    at = np.flatnonzero(known)
    path = most_probable(terms[known], change)
    y, phi = y[known], phi[known]
    places = [0, *(np.flatnonzero(np.diff(path)) + 1), len(path)]
    found = []
    for before, place, after in zip(places, places[1:], places[2:], strict=False):
        first, last = max(before, place - WINDOW), min(after, place + WINDOW)
        rows, one, other = slice(first, last), path[place - 1], path[place]
        dates = dated(y[rows], phi[rows][:, columns[one]], phi[rows][:, columns[other]], place - first)
        date, earliest, latest = (int(at[min(first + d, len(at) - 1)]) for d in dates)
        found.append(Switch(date, earliest, latest, names[one], names[other]))
    return found

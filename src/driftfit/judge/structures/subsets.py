"""The best subset of the regressors of one model: all subsets of a few regressors, a search among many.

The search adds the regressor that helps most and drops regressors that no longer help, until neither raises the
log-likelihood minus its penalty: p runs per round instead of 2^p in all. Every subset is run once, and subsets of equal
size run in parallel.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.judge.structures.candidates import Candidate, Pool, Predicted, price
from driftfit.trackers.base import Tracker

ALL = 5
"""Up to this many regressors, all subsets are tried."""


def subsets(
    pool: Pool,
    tracker: Tracker,
    full: Candidate,
    keep: Sequence[str],
    most: int | None,
) -> tuple[list[Candidate], list[Predicted]]:
    """Subsets of the regressors of one model: all, or those that a search visits."""
    if full.columns is None:
        raise ValueError("select: subsets of regressors need an ARX or Regression; otherwise give a list of models.")
    unknown = [name for name in keep if name not in pool.names]
    if unknown:
        raise ValueError(f"select: there is no regressor {unknown[0]!r}; there is {', '.join(pool.names)}.")
    N = len(pool.names)
    largest = N if most is None else whole("select", "most", most, 1)
    kept = frozenset(pool.names.index(name) for name in keep)
    free = [i for i in range(N) if i not in kept]
    tried = Tried(pool, tracker)
    if len(free) <= ALL:
        every = [kept | set(c) for r in range(len(free) + 1) for c in combinations(free, r)]
        tried([chosen for chosen in every if 0 < len(chosen) <= largest])
    else:
        _search(tried, kept, free, largest)
    return tried.structures, tried.predictions


class Tried:
    """Subsets that were run, each once."""

    def __init__(self, pool: Pool, tracker: Tracker) -> None:
        self.pool, self.tracker = pool, tracker
        self.structures: list[Candidate] = []
        self.predictions: list[Predicted] = []
        self._place: dict[frozenset[int], int] = {}
        starts = zip(pool.starts(len(pool.names)), pool.records, strict=True)
        self._starts = [min(start, len(record) // 2) for start, record in starts]
        self._scored = pool.after(self._starts)

    def __call__(self, subsets: Sequence[frozenset[int]]) -> Array:
        """logliks of subsets, after the start, (k,)."""
        new = [s for s in dict.fromkeys(map(frozenset, subsets)) if s not in self._place]
        structures = [
            Candidate(" ".join(self.pool.names[i] for i in sorted(s)), len(s), None, tuple(sorted(s))) for s in new
        ]
        predictions = self.pool.predict(self.tracker, structures)
        for subset, structure, found in zip(new, structures, predictions, strict=True):
            self._place[subset] = len(self.structures)
            self.structures.append(structure)
            self.predictions.append(found)
        terms = [self.predictions[self._place[frozenset(s)]].loglik[self._scored] for s in subsets]
        costs = [price(len(s), self._starts) for s in subsets]
        return np.array([float(np.nansum(term)) - cost for term, cost in zip(terms, costs, strict=True)])


def _search(tried: Tried, kept: frozenset[int], free: Sequence[int], largest: int) -> None:
    """Add the regressor that helps most, drop those that no longer help, until neither raises the loglik."""
    chosen = kept
    best = float(tried([chosen])[0]) if chosen else -np.inf
    while True:
        before = best
        more = [chosen | {i} for i in free if i not in chosen] if len(chosen) < largest else []
        if more:
            logliks = tried(more)
            if logliks.max() > best:
                chosen, best = more[int(np.argmax(logliks))], float(logliks.max())
        fewer = [chosen - {i} for i in chosen - kept] if len(chosen) > 2 else []
        if fewer:
            logliks = tried(fewer)
            if logliks.max() > best:
                chosen, best = fewer[int(np.argmax(logliks))], float(logliks.max())
        if not best > before:
            return

"""Which other parameter could have moved instead: steps that are given to it, and explain the record as well.

While an input rests, a step of its coefficient and one of the intercept do the same to the output, and so do those of
inputs that move together. A change that begins and ends meanwhile leaves no trace of which one it was, although each
of its two steps alone would: the record before, or after, tells them apart. Therefore up to `TOGETHER` successive
steps, or all of one parameter, are given to another at once, at their dates or up to `SHIFT` samples beside them. It
explains as much if the sum of squares grows by at most `ALIKE` times the noise variance, and log N for each step that
it does without.

Between the dates in question rows are only summed, so they are first reduced to a triangle for each interval.
Cost: O(N n^2), and a small regression for each group, parameter and date.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from driftfit.engine.kernel import Array

TOGETHER = 4
SHIFT = 5
ALIKE = 4.0
"""Twice the logarithm of the likelihood ratio up to which steps of two parameters cannot be distinguished."""
SAMPLE = 36.0
"""The most that one sample, limited to three levels from the fit, can cost where a date is wrong."""

Steps = Sequence[tuple[int, int]]


class Reduced:
    """The regression with steps on rows [X, y] (N, n + 1), reduced between dates."""

    def __init__(self, X: Array, y: Array, steps: Steps) -> None:
        N = len(y)
        near = {at + move for _, at in steps for move in range(-SHIFT, SHIFT + 1) if 0 < at + move < N}
        edges = [0, *sorted(near), N]
        parts = [np.linalg.qr(np.column_stack([X[a:b], y[a:b]]), mode="r") for a, b in pairwise(edges)]
        rows = np.vstack(parts)
        self.begin = np.repeat(edges[:-1], [len(part) for part in parts])
        size = np.sqrt(np.sum(rows[:, :-1] ** 2, axis=0))
        self.X, self.y, self.N = rows[:, :-1] / np.where(size > 0.0, size, 1.0), rows[:, -1], N

    def loss(self, steps: Steps) -> float:
        """The sum of squares that is left with steps (parameter, date)."""
        later = [self.X[:, i] * (self.begin >= at) for i, at in steps]
        X = np.column_stack([self.X, *later])
        e = self.y - X @ np.linalg.lstsq(X, self.y, rcond=None)[0]
        return float(e @ e)

    def moved(self, kept: list[tuple[int, int]], given: list[tuple[int, int]], enough: float) -> float:
        """The least sum of squares with ``given`` steps beside their dates; the search ends where it is ``enough``."""
        least = self.loss(kept + given)
        for k, (i, at) in enumerate(given):
            for move in range(-SHIFT, SHIFT + 1):
                if least <= enough:
                    return least
                trial = [*given[:k], (i, at + move), *given[k + 1 :]]
                if 0 < at + move < self.N and (found := self.loss(kept + trial)) < least:
                    least, given = found, trial
        return least


def groups(steps: Steps) -> Iterator[list[int]]:
    """Places of up to `TOGETHER` successive steps, and of all steps of a parameter."""
    order = sorted(range(len(steps)), key=lambda k: steps[k][1])
    yield from ([k for k in order if steps[k][0] == i] for i in {i for i, _ in steps})
    for first in range(len(order)):
        for count in range(1, min(TOGETHER, len(order) - first) + 1):
            yield order[first : first + count]


def instead(X: Array, y: Array, steps: Steps) -> tuple[tuple[int, ...], ...]:
    """For each step (parameter, date) of y (N,) on X (N, n), white rows of equal noise, the parameters to which it may
    belong as well, alone or with steps before and after it.
    """
    found: list[set[int]] = [set() for _ in steps]
    if not len(steps):
        return ()
    reduced = Reduced(X, y, steps)
    least = reduced.loss(steps)
    noise = least / len(y)
    for group in groups(steps):
        kept = [step for k, step in enumerate(steps) if k not in group]
        for j in range(X.shape[1]):
            if all(steps[k][0] == j for k in group):
                continue
            given = sorted({(j, steps[k][1]) for k in group} - set(kept))
            allowed = least + noise * (ALIKE + (len(group) - len(given)) * np.log(len(y)))
            at_once = reduced.loss(kept + given)
            if at_once > allowed and at_once <= allowed + noise * SAMPLE * SHIFT * len(given):
                at_once = reduced.moved(kept, given, allowed)
            if at_once <= allowed:
                for k in group:
                    found[k] |= {j} - {steps[k][0]}
    return tuple(tuple(sorted(one)) for one in found)

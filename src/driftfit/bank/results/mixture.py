"""The present leaves of a bank: the mixture that a controller uses, and the undecided events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from driftfit.bank.layout import COUNTER, NEVER
from driftfit.bank.leaves.leaf_matrix import AGE, CODE, FIRST, NU, WEIGHT, S
from driftfit.bank.machine.framed import in_theta
from driftfit.bank.machine.gap import SINCE
from driftfit.engine.kernel import Array
from driftfit.engine.simd import WIDTH

if TYPE_CHECKING:
    from driftfit.bank.bank import Bank


class Mixture(NamedTuple):
    """The leaves after a sample, for use in control."""

    weights: Array
    """(L,), summing to 1."""
    means: Array
    """(L, n)"""
    covs: Array
    """(L, n, n)"""
    ages: Array
    """(L,): samples since the last change of each leaf; inf if there was none (for merged leaves, the largest's)."""

    @property
    def mean(self) -> Array:
        """sum w m, (n,)."""
        return np.asarray(self.weights @ self.means)

    @property
    def cov(self) -> Array:
        """sum w (C + d d'), (n, n)."""
        away = self.means - self.mean
        return np.asarray(np.einsum("l,lij->ij", self.weights, self.covs + away[:, :, None] * away[:, None, :]))


def mixture_of(tracker: Bank, place: Any, lane: Any) -> Mixture:
    """The leaves in the fields of one lane; before the tree starts, the single filter."""
    n = len(lane["theta"])
    if lane["counters"][COUNTER.settled] != 1:
        return Mixture(np.ones(1), lane["theta"][None].copy(), tracker.cov(lane)[None], np.full(1, np.inf))
    B = tracker.array(place.model, lane, "leaves")[:, : lane["counters"][COUNTER.many_leaves]]
    i, j = np.tril_indices(n)
    C = B[FIRST + n : FIRST + n + len(i)]
    covs = np.zeros((B.shape[1], n, n))
    covs[:, i, j] = covs[:, j, i] = C.T
    gap = tracker.array(place.model, lane, "gap")
    since = gap[1:, gap.shape[1] - WIDTH + SINCE]
    if since.any():  # further events that are possible since the last used sample
        more = np.zeros((n, n))
        more[i, j] = more[j, i] = since @ gap[1:, : len(i)]
        covs = covs + more
    path = tracker.array(place.model, lane, "path")
    if len(path) and lane["counters"][COUNTER.open] > 0:
        last = tracker.array(place.model, lane, "event")[0, : B.shape[1]]  # events before the gap
        more = np.zeros((B.shape[1], n, n))
        H = len(tracker.all_changes) * len(tracker.all_sensors)
        more[:, i, j] = more[:, j, i] = path[-1 - H :][last, : len(i)]
        covs = covs + more
    if lane["unknown"]:
        covs *= (B[S] / (B[NU] - 2.0))[:, None, None]
    means, covs = in_theta(lane, B[FIRST : FIRST + n].T.copy(), covs)
    ages = np.where(B[AGE] < NEVER, B[AGE], np.inf)
    return Mixture(B[WEIGHT].copy(), means, covs, ages)


def undecided(tracker: Bank, place: Any, lane: Any, loss: Array) -> list[tuple[int, int, float]]:
    """(sample, event, probability) of the open events, decided one after the other from the leaves at the end."""
    held, H = int(lane["counters"][COUNTER.held]), len(loss)
    if lane["counters"][COUNTER.settled] != 1 or held == 0:
        return []
    L = int(lane["counters"][COUNTER.many_leaves])
    B, group, stamps = (tracker.array(place.model, lane, name) for name in ("leaves", "group", "stamps"))
    here = group[0, :L] >= 0
    codes, w = B[CODE, :L][here].astype(int), B[WEIGHT, :L][here]
    found = []
    for k in range(held):
        top = H ** (held - 1 - k)
        p = np.bincount(codes // top, w / w.sum(), H)
        risk = np.where(p > 0.0, p @ loss, np.inf)
        event = int(risk.argmin())
        found.append((int(stamps[0, k]), event, float(p[event])))
        keep = codes // top == event
        codes, w = codes[keep] - event * top, w[keep]
    return found

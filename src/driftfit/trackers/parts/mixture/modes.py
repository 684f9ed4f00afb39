"""The modes of the bank as plain arrays, and its fields before the first sample; see `AdaptiveKalman` for the table."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.trackers.parts.mixture.noise import STATES

COMMON = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 0.04, 0.2, 1.0, 30.0)
TREND = (1e-3, 1e-2, 0.1)
LEARNED = (1e-3, 1e-2, 0.1, 1.0)
ALONE, GROUP = (0.003, 0.05, 30.0), (1e-3, 1e-2, 0.1, 1.0, 30.0)
"""Drift ratios of the ladders."""
MOST_ALONE = 8
"""Number of parameters up to which each has a ladder of its own."""
UP, DOWN, BACK = 2e-4, 1e-3, 0.05
"""Probabilities: to the next larger ratio, to the next smaller one, and the latter from ratios of 1 and more."""
JUMP, ARRIVE = 3e-3, 1e-5
"""Probabilities from the whole bank: into all modes with ratios of 1 and more, and into each other one."""
AT_REST, ALL, SELDOM = 0.3, 0.45, 0.02
"""Probabilities before the first sample: of no drift at least, of the other common ratios, and the share of jumps in
these and those of the other ladders."""
FIRST_LEARNED = len(COMMON) + len(TREND)
FIRST_ALONE = FIRST_LEARNED + len(LEARNED)
"""Where the ladders begin."""


def table(n: int, groups: Any) -> dict[str, Array]:
    """The modes as arrays (K,): ``ratio``; the ``ladder``, -3 common, -2 trend, -1 learned, or the number of a group;
    probabilities ``up``, ``down`` and ``arrive``; and ``start``, before the first sample. And ``first`` (n,), the first
    mode of the ladder in which a parameter drifts without all others, or -1.
    """
    each = [[i] for i in range(n)] if groups is None and 1 < n <= MOST_ALONE else list(groups or ())
    ladders = [(-3, COMMON), (-2, TREND), (-1, LEARNED)]
    ladders += [(g, ALONE if groups is None else GROUP) for g in range(len(each))]
    ratio = np.array([rho for _, ladder in ladders for rho in ladder])
    of = np.array([which for which, ladder in ladders for _ in ladder])
    top = np.array([j + 1 == len(ladder) for _, ladder in ladders for j in range(len(ladder))])
    jump, alone = ratio >= 1.0, of >= 0
    arrive = np.where(jump, JUMP, ARRIVE)
    for kind, share in ((alone, 0.5), (~alone, 0.5 if each else 1.0)):
        arrive[jump & kind] *= share / max(int(np.sum(jump & kind)), 1)
    start = np.where(of == -3, ALL / (len(COMMON) - 1), (1.0 - AT_REST - ALL) / np.sum(of != -3))
    start[ratio >= 1.0] *= SELDOM
    start[0] = 1.0 - start[1:].sum()
    first = np.full(n, -1)
    for g, members in enumerate(each):
        first[list(members)] = np.argmax(of == g)
    down = np.where(ratio > 0.0, np.where(jump, BACK, DOWN), 0.0)
    return {
        "ratio": ratio, "ladder": of, "up": np.where(top, 0.0, UP), "down": down, "arrive": arrive, "start": start,
        "first": first,
    }  # fmt: skip


def bank(n: int, groups: Any) -> dict[str, Any]:
    """Fields of the K filters before the first sample: their modes, means m, covariances C (lower triangle)."""
    modes = table(n, groups)
    K = len(modes["ratio"])
    foot = np.diff(modes["ladder"], prepend=-3) != 0
    return {
        "modes": K,
        "parameters": n,
        "ratio": modes["ratio"],
        "up": modes["up"],
        "down": np.where(foot, 0.0, modes["down"]),
        "foot": np.where(foot, modes["down"], 0.0),
        "arrive": modes["arrive"],
        "alone": modes["first"],
        "rungs": len(ALONE if groups is None else GROUP),
        "arrivals": modes["arrive"].sum(),
        "jumping": modes["arrive"][modes["ratio"] >= 1.0].sum(),
        "left_behind": 0.0,
        "jumps_expected": 0.0,
        "kappa": 1.0,
        "mu": modes["start"],
        "prior": modes["start"],
        "m": np.zeros((n, K)),
        "C": np.zeros((n, n, K)),
        "trend": np.zeros((n, len(TREND))),
        "walk": np.zeros((2, n, n)),
        "Z": np.zeros((2, n, n)),
        "away": np.zeros((2, n)),
        "e_k": np.zeros(K),
        "h_k": np.zeros(K),
        "gain": np.zeros((n, K)),
        "step": np.zeros(K),
        "curve": np.zeros(K),
        "inverse": np.zeros((STATES, K)),
        "joint": np.zeros((STATES, K)),
        "share": np.zeros((3, K)),
        "row": np.zeros(K + 8),
    }

"""What the alarms of `driftfit.detect` look at, and the limits that theory gives.

Every function returns a `Watched`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from driftfit.judges.onsets import chance, mean_limit, mean_rate, normal_limit, normal_rate, power_limit, power_rate
from driftfit.kernel import Array
from driftfit.result import Track
from driftfit.settings import near, whole

Reference = Mapping[str, tuple[float, float]] | int | None


class Watched(NamedTuple):
    """What an alarm looks at."""

    statistic: Array
    """(T, c)"""
    limits: Array
    """(c,)"""
    names: tuple[str, ...]
    start: int
    """First sample that is judged."""
    chance: Callable[[Array, int], float] | None
    """Chance that a record without a fault reaches these highest values (c,) in so many samples; None: no theory."""


def _band(run: Track, every: float, reference: Reference, window: int) -> Watched:
    """How many standard deviations parameters are outside their bands."""
    if not run.tracker.covariance:
        raise ValueError(f"detect: {type(run.tracker).__name__} carries no covariance, so no band can be judged.")
    start = _burn(run)
    if isinstance(reference, Mapping):
        unknown = [name for name in reference if name not in run.names]
        if unknown:
            raise ValueError(f"detect: there is no parameter {unknown[0]!r}; {near(str(unknown[0]), run.names)}")
        names = tuple(reference)
        low, high = _edges(reference)
    else:
        stop = _reference(run, reference, start)
        names, part = run.names, run.theta[start:stop]
        low, high, start = part.min(axis=0), part.max(axis=0), stop
    columns = [run.names.index(name) for name in names]
    theta, std = run.theta[:, columns], run.std[:, columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        outside = np.maximum(theta - high, low - theta) / std
    rhos = _alike(theta[_burn(run) :], std[_burn(run) :])
    limits = np.array([normal_limit(rho, every * len(names)) for rho in rhos])

    def likely(highest: Array, J: int) -> float:
        each = [chance(normal_rate(rho), z, special.ndtr(-z), J) for rho, z in zip(rhos, highest, strict=True)]
        return min(1.0, len(each) * min(each))

    return Watched(np.where(np.isfinite(std), outside, np.nan), limits, names, start, likely)


def _edges(reference: Mapping[str, tuple[float, float]]) -> Array:
    """(low, high) of every band, (2, c)."""
    try:
        edges = np.array([[float(edge) for edge in pair] for pair in reference.values()]).T
    except (TypeError, ValueError):
        edges = np.zeros(0)
    if edges.ndim != 2 or len(edges) != 2 or not (edges[0] <= edges[1]).all():
        raise ValueError(
            f"detect: a reference names parameters, each with a band (low, high), low <= high; got {dict(reference)!r}."
        )
    return edges


def _alike(theta: Array, std: Array) -> Array:
    """(c,): correlation of successive errors of estimates theta (T, c)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        step = np.diff(theta, axis=0) ** 2 / std[1:] ** 2
    d = np.array([np.mean(column[np.isfinite(column)]) if np.isfinite(column).any() else 1.0 for column in step.T])
    return np.asarray(1.0 / (1.0 + d))


def _reference(run: Track, reference: Any, start: int) -> int:
    """The end of the reference."""
    if reference is None:
        raise ValueError(
            'detect: say where the parameters belong, reference={"b1": (0.9, 1.1)}, or how many of the first samples '
            "are normal, reference=500."
        )
    stop = whole("detect", "reference", reference, 1)
    if not start + 20 <= stop < len(run):
        raise ValueError(
            f"detect: reference={stop} leaves too little: the run starts until sample {start}, and has {len(run)}."
        )
    return stop


def _burn(run: Track) -> int:
    return max(50, 5 * run.model.n)


def _innovation(run: Track, every: float, reference: Reference, window: int) -> Watched:
    """Windowed sums of squares and of innovations, over the samples that were used."""
    with np.errstate(invalid="ignore", divide="ignore"):
        g = run.innovation / run.innovation_std
    g, start, slack = np.where(np.isfinite(g), g, np.nan), _burn(run), 1.0
    if isinstance(reference, Mapping):
        raise ValueError('detect: the reference of "innovation" is a number of samples, such as reference=500.')
    if reference is not None:
        stop = _reference(run, reference, start)
        known = np.sort(np.abs(g[start:stop][np.isfinite(g[start:stop])]))
        g, start = normal_scores(g, known), stop
        slack = np.sqrt(1.0 + window / max(len(known), 1))  # what is normal is itself an estimate
    used = np.flatnonzero(np.isfinite(g) & (np.arange(len(g)) >= start))
    statistic = np.full((len(run), 2), np.nan)
    for column, values in enumerate((g[used] ** 2, g[used])):
        total = np.concatenate([[0.0], np.cumsum(values)])
        if len(used) >= window:
            statistic[used[window - 1 :], column] = total[window:] - total[:-window]
    statistic[:, 1] = np.abs(statistic[:, 1])
    power, mean = power_limit(window, 2.0 * every), mean_limit(window, 2.0 * every)
    limits = np.array([window + (power - window) * slack, mean * slack])

    def likely(highest: Array, J: int) -> float:
        loud, aside = window + (highest[0] - window) / slack, highest[1] / slack
        each = (
            chance(power_rate(window), loud, special.chdtrc(window, max(loud, 0.0)), J),
            chance(mean_rate(window), aside, 2.0 * special.ndtr(-aside / np.sqrt(window)), J),
        )
        return min(1.0, 2.0 * min(each))

    return Watched(_carried(statistic), limits, ("power", "mean"), start, likely)


def normal_scores(g: Array, known: Array) -> Array:
    """g with the size that a normal variable of the same rank among ``known`` (N,) absolute values would have."""
    share = (1.0 + len(known) - np.searchsorted(known, np.abs(g), side="left")) / (len(known) + 1.0)
    return np.where(np.isfinite(g), -special.ndtri(np.clip(share / 2.0, 1e-12, 0.5)) * np.sign(g), np.nan)


def _carried(statistic: Array) -> Array:
    """The last statistic, where there is no new sample."""
    place = np.maximum.accumulate(np.where(np.isfinite(statistic[:, 0]), np.arange(len(statistic)), -1))
    return np.where((place >= 0)[:, None], statistic[place], np.nan)


def _probability(run: Track, every: float, reference: Reference, window: int) -> Watched:
    """The probability of a change in the tracker's window."""
    if CHANGE in run.tracker.outputs:
        p = run._written(CHANGE)
    elif REPORT in run.tracker.outputs:
        bank: Any = getattr(run, HYPOTHESES)
        p = bank.window
    else:
        raise ValueError(
            f"detect: {type(run.tracker).__name__} carries no probability of a change; track with Bank, or use "
            'kind="band" or kind="innovation".'
        )
    return Watched(np.reshape(p, (len(run), -1))[:, :1], np.ones(1), ("probability",), _burn(run), None)


CHANGE, REPORT, HYPOTHESES = "window", "report", "hypotheses"
"""Where the probability of a change is: a field that a tracker stores, or ``run.hypotheses.window`` of a `Bank`."""

STATISTICS = {"band": _band, "innovation": _innovation, "probability": _probability}

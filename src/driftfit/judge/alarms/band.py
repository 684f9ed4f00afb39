"""The limit of the "band" alarm: how far beyond its permitted range a parameter may seem to be.

    z_t = max(theta_t - high, low - theta_t) / std_t

Successive errors of an estimate have the correlation rho = 1 / (1 + d), d = mean (theta_t - theta_(t-1))^2 / var_t,
since a step of the filter has the variance that it removes. A parameter at the very edge of its band begins to exceed a
limit c with the probability

    P(z_(t-1) <= c, z_t > c) = 2 T(c, sqrt((1 - rho) / (1 + rho))),    Owen's T (1956)

so c is chosen that one of all parameters does so once in ``every`` samples. Inside the band alarms are rarer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.alarms.reference import Reference, normal_samples
from driftfit.run.live.rule import AlarmRule, check_fits
from driftfit.run.result import Track, burn_in

FAR = 9.0
"""Deviations beyond which no limit is."""
STILL = 1.645
"""A normal variable exceeds this with a probability of 5 %."""


def band(run: Track, rule: AlarmRule, reference: Reference) -> tuple[AlarmRule, int]:
    """The rule for the given bands, or for the range of the parameters in the reference; the first sample it judges."""
    if isinstance(reference, Mapping):
        names, (low, high), known, start = (
            tuple(reference),
            _edges(reference),
            slice(burn_in(run.model.n), None),
            burn_in(run.model.n),
        )
    else:
        first, start = normal_samples(run, reference)
        # hidden states move with the inputs, and say nothing of a fault
        names, known = tuple(one for one in run.names if one not in (run.model.hidden or ())), slice(first, start)
        watched = run.theta[known][:, [run.names.index(one) for one in names]]
        low, high = watched.min(axis=0), watched.max(axis=0)
    rule = replace(rule, names=names, low=tuple(low.tolist()), high=tuple(high.tolist()))
    check_fits(rule, run.tracker, run.names)
    columns = rule.columns(run.names)
    theta, std = run.theta[known, columns], run.std[known, columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        step = np.diff(theta, axis=0) ** 2 / std[1:] ** 2
    d = [np.mean(one[np.isfinite(one)]) if np.isfinite(one).any() else 1.0 for one in step.T]
    limits = tuple(normal_limit(float(1.0 / (1.0 + one)), rule.every * len(names)) for one in d)
    return replace(rule, limits=limits, growth=(2.0,) * len(names)), start


def _edges(reference: Mapping[str, tuple[float, float]]) -> Array:
    """(low, high) of every band, (2, c)."""
    try:
        edges = np.array([[float(edge) for edge in pair] for pair in reference.values()]).T
    except (TypeError, ValueError):
        edges = np.zeros(0)
    if edges.ndim != 2 or len(edges) != 2 or not (edges[0] <= edges[1]).all():
        raise ValueError(
            f"detect: a reference maps parameters to bands (low, high), low <= high; got {dict(reference)!r}."
        )
    return edges


def normal_limit(rho: float, every: float) -> float:
    """c for z of variance 1 whose neighbours have the correlation ``rho``, 0 <= rho < 1; at least `STILL`.

    An estimate that hardly moves seldom begins to exceed any limit, but may be beyond it from the first sample on.
    """
    slope = np.sqrt((1.0 - rho) / (1.0 + rho))

    def begins(c: float) -> float:
        return 2.0 * float(scipy.special.owens_t(c, slope))

    rate = max(1.0 / every, begins(FAR))
    return STILL if begins(STILL) <= rate else float(scipy.optimize.brentq(lambda c: begins(c) - rate, STILL, FAR))

"""The statistics of the alarms of `driftfit.judge.alarms.detect` for a run, their limits by theory, and the probability
of an extreme.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.engine.settings import plain
from driftfit.judge.alarms.bootstrap import RECORDS, limits, simulated
from driftfit.judge.alarms.frozen import Rows, frozen_model
from driftfit.judge.alarms.onsets import (
    chance,
    mean_limit,
    mean_rate,
    normal_limit,
    normal_rate,
    power_limit,
    power_rate,
)
from driftfit.judge.alarms.reference import burn, first_third, least, normal_samples
from driftfit.judge.regressors import refuse_hidden
from driftfit.judge.statistics.parts.coarse_readings import explained, step_of
from driftfit.judge.statistics.robust import orthonormal
from driftfit.readings import gate
from driftfit.run.columns import COLLECTED, collect
from driftfit.run.live.likelihood_ratio import scan
from driftfit.run.live.reference_model import (
    BLAMED,
    CUSUM,
    INTERVAL,
    NOISE_FACTOR,
    OK,
    UNLIKE,
    Y,
    judgeable,
    memory_of,
)
from driftfit.run.live.rule import (
    CHANGE,
    FROZEN,
    OFFSET,
    AlarmRule,
    chances,
    check_fits,
    drawn,
    power_and_mean,
    seed_of,
)
from driftfit.run.program import lanes_of
from driftfit.run.result import Track
from driftfit.trackers.bank.results.results import Hypotheses

Reference = Mapping[str, tuple[float, float]] | tuple[Any, Any] | int | None

Samples = tuple[Array, Array]
"""What `samples_of` returns."""

Chance = Callable[[Array, int], float]
"""Probability that a record without a fault reaches these highest values (c,) in a given number of samples."""


def rule_of(
    run: Track, rule: AlarmRule, reference: Reference, seed: int, records: int = RECORDS
) -> tuple[AlarmRule, int]:
    """A rule with its names, reference and limits, and the first sample of the run that it judges."""
    if rule.kind in FROZEN:
        return _frozen(run, rule, reference, seed, records)
    return RULES[rule.kind](run, rule, reference)


def samples_of(run: Track) -> Samples:
    """Regressors (T, n) of a run, and (T, 4): the columns of `ROW`, as the tracker receives them; "ok" are the samples
    that are `judgeable`."""
    steps = run.program.steps._replace(store=collect)
    tile = run.fresh()
    out = run.program.inspected(tile, len(run), COLLECTED)
    y, u, known = lanes_of(run.record)
    run.program.drivers(steps=steps).run(tile, y, u, known, out)
    noise = np.broadcast_to(run.known.noise, len(run))
    return out["phi"][..., 0], np.column_stack([out["y"], judgeable(out, 0, y[:, 0], noise), noise, out["dt"]])


def _frozen(run: Track, rule: AlarmRule, reference: Reference, seed: int, records: int) -> tuple[AlarmRule, int]:
    """The model of the reference, and limits by its bootstrap."""
    rule, rows, start, _ = modelled(run, rule, reference)
    made = simulated(rule.reference, rows, seed, records)
    found, growth, unsure = limits(made, rule.kind == "cusum", rule.every)
    return replace(rule, limits=plain(found), growth=plain(growth), unsure=unsure), start


def modelled(run: Track, rule: AlarmRule, reference: Reference) -> tuple[AlarmRule, Rows, int, Samples]:
    """The rule with the model of the reference, without limits; the reference; its end; and `samples_of` the run."""
    if isinstance(reference, Mapping):
        raise ValueError(
            f'detect: the reference of "{rule.kind}" must be a number of samples, such as reference=500, or (from, to).'
        )
    refuse_hidden(f'detect "{rule.kind}"', run.model, 'kind="innovation" or "band"')
    samples = samples_of(run)
    n, usable = samples[0].shape[1], (samples[1][:, OK] > 0.0) & (samples[1][:, INTERVAL] > 0.0)
    if run.theta.shape[1] != n:
        raise ValueError(
            f'detect: "{rule.kind}" is for trackers of the {n} parameters of the regression; '
            f"{type(run.tracker).__name__} estimates {run.theta.shape[1]}."
        )
    enough = least(rule.kind, n)
    first, start = first_third(run, usable, enough) if reference is None else normal_samples(run, reference)
    phi, rest, judged = samples[0][first:start], samples[1][first:start], (usable & ~_stuck(run))[first:start]
    y, noise, names = rest[:, Y], rest[:, NOISE_FACTOR], run.model.names
    ok = judged & (rest[:, OK] > BLAMED)
    if ok.sum() < enough:
        raise ValueError(
            f'detect: "{rule.kind}" compares with {enough} normal samples at least; samples {first} to {start} contain '
            f"{ok.sum()} that can be used. Give a longer normal segment, reference=(from, to), or choose "
            'kind="innovation".'
        )
    constants = np.flatnonzero((np.ptp(phi[ok], axis=0) == 0.0) & (phi[ok][0] != 0.0))
    if not len(constants):
        phi, names, constants = np.column_stack([phi, np.ones(len(phi))]), (*names, OFFSET), np.array([n])
    root = np.sqrt(np.where(judged, noise, 1.0))
    phi, y = phi / root[:, None], y / root
    y, rounding = _drawn(phi, y, step_of(run.y[first:start]), root, ok)
    found = frozen_model(phi, y, np.where(judged, rest[:, OK], 0.0), int(constants[-1]))
    if found is None:
        raise ValueError(
            f'detect: "{rule.kind}" measures changes in units of the noise, and the reference has none: constant '
            f"parameters explain samples {first} to {start} without error. Choose another reference."
        )
    frozen, known = found
    rule = replace(
        rule,
        parameters=names,
        names=("one parameter", "parameters", "noise") if rule.kind == "glr" else (*names, "noise"),
        frozen=tuple(plain(one) for one in frozen),
        rounding=rounding,
        simulated=True,
    )
    return rule, known, start, samples


def _drawn(phi: Array, y: Array, step: float, root: Array, ok: Array) -> tuple[Array, tuple[float, ...]]:
    """Readings y (N,) of a reference, drawn again within the step of a coarse sensor over ``root`` (N,), and (step,
    noise, seed) of it; as they are, and (), if constants do not explain those that are ``ok`` as rounded ones.
    """
    basis = orthonormal(phi[ok]) if step else None
    found = explained(basis.Q, y[ok], step / root[ok]) if basis is not None and basis.distinct else None
    if found is None:
        return y, ()
    seed, y = seed_of(y[ok], step / root[ok]), y.copy()
    y[ok] = drawn(y[ok], *found, 0.5 * step / root[ok], chances(0, int(ok.sum()), seed))
    return y, (step, found[1], float(seed + 1))  # later samples draw other numbers


def _stuck(run: Track) -> Array:
    """Samples (T,) of a frozen sensor; other readings that a gate refused are normal if they are in the reference."""
    left, found = run.left_out, np.zeros(len(run), bool)
    found[left.sample[left.code == gate.FROZEN]] = True
    return found


def _band(run: Track, rule: AlarmRule, reference: Reference) -> tuple[AlarmRule, int]:
    """The given bands, or the range of the parameters in the reference."""
    if isinstance(reference, Mapping):
        names, (low, high), known, start = tuple(reference), _edges(reference), slice(burn(run), None), burn(run)
    else:
        first, start = normal_samples(run, reference)
        # hidden states move with the inputs, and say nothing of a fault
        names, known = tuple(one for one in run.names if one not in (run.model.hidden or ())), slice(first, start)
        watched = run.theta[known][:, [run.names.index(one) for one in names]]
        low, high = watched.min(axis=0), watched.max(axis=0)
    rule = replace(rule, names=names, low=tuple(low.tolist()), high=tuple(high.tolist()))
    check_fits(rule, run.tracker, run.names)
    alike = _alike(run, rule, known)
    return replace(rule, limits=tuple(normal_limit(rho, rule.every * len(names)) for rho in alike)), start


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


def _alike(run: Track, rule: AlarmRule, part: slice) -> Array:
    """(c,): correlation of successive errors of the watched estimates, from a part of the run."""
    columns = rule.columns(run.names)
    theta, std = run.theta[part, columns], run.std[part, columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        step = np.diff(theta, axis=0) ** 2 / std[1:] ** 2
    d = np.array([np.mean(column[np.isfinite(column)]) if np.isfinite(column).any() else 1.0 for column in step.T])
    return np.asarray(1.0 / (1.0 + d))


def _innovation(run: Track, rule: AlarmRule, reference: Reference) -> tuple[AlarmRule, int]:
    """The normal distribution of innovations: standard normal, or that of the reference."""
    rule, start = replace(rule, names=("power", "mean")), burn(run)
    check_fits(rule, run.tracker, run.names)
    if isinstance(reference, Mapping):
        raise ValueError(
            'detect: the reference of "innovation" must be a number of samples, such as reference=500, or (from, to).'
        )
    if reference is not None:
        first, start = normal_samples(run, reference)
        g = rule.scores(run.innovation[first:start], run.innovation_std[first:start])
        rule = replace(rule, normal=tuple(np.sort(np.abs(g[np.isfinite(g)])).tolist()))
    power, mean = power_limit(rule.window, 2.0 * rule.every), mean_limit(rule.window, 2.0 * rule.every)
    limits = (rule.window + (power - rule.window) * rule.slack, mean * rule.slack)
    return replace(rule, limits=limits), start


def _probability(run: Track, rule: AlarmRule, reference: Reference) -> tuple[AlarmRule, int]:
    """No theory gives a limit, so it is found by simulation."""
    rule = replace(rule, names=("probability",), limits=(1.0,))
    check_fits(rule, run.tracker, run.names)
    return rule, burn(run)


def statistic_of(run: Track, rule: AlarmRule, start: int) -> Array:
    """The statistics that the rule compares, (T, c), NaN where there is nothing to judge."""
    if rule.kind == "band":
        columns = rule.columns(run.names)
        return rule.outside(run.theta[:, columns], run.std[:, columns])
    if rule.kind == "probability":
        bank: Any = run
        p = bank.written(CHANGE) if CHANGE in run.tracker.outputs else Hypotheses(bank).window
        return np.asarray(np.reshape(p, (len(run), -1))[:, :1])
    g = rule.scores(run.innovation, run.innovation_std)
    used = np.flatnonzero(np.isfinite(g) & (np.arange(len(g)) >= start))
    statistic = np.full((len(run), 2), np.nan)
    statistic[used[rule.window - 1 :]] = power_and_mean(g[used], rule.window)
    return _carried(statistic)


def findings_of(run: Track, rule: AlarmRule, start: int, samples: Samples) -> tuple[Array, int]:
    """The findings of "glr" and "cusum", (T, k), NaN before ``start``; and how many samples were not judged because
    they excite what the reference did not, or hardly. ``samples`` are those of the run.
    """
    n, (phi, rest), model = len(rule.parameters), samples, rule.reference
    findings, use = np.full((len(run), CUSUM + n + 1), np.nan), np.zeros(len(run), np.int8)
    rows = np.column_stack([phi, np.ones((len(run), n - phi.shape[1])), rest])
    rows[start:, n + Y] = rule.drawn(rows[start:, :n], rows[start:, n + Y], rows[start:, n + NOISE_FACTOR], 0)
    scan(rows[start:], model, memory_of(model), findings[start:], use[start:])
    return findings, int(np.sum(use == UNLIKE))


def _carried(statistic: Array) -> Array:
    """Repeat the last statistic where there is no new sample."""
    place = np.maximum.accumulate(np.where(np.isfinite(statistic[:, 0]), np.arange(len(statistic)), -1))
    return np.where((place >= 0)[:, None], statistic[place], np.nan)


def highest(statistic: Array, start: int) -> Array:
    """The largest value of each column, (c,), over the judged samples; -inf if there is none."""
    part = statistic[start:]
    return np.asarray(np.max(np.where(np.isfinite(part), part, -np.inf), axis=0, initial=-np.inf))


def chance_of(run: Track, rule: AlarmRule) -> Chance:
    """The probability of an extreme by theory; NaN for probabilities and simulated limits, which have no theory.

    For "glr" and "cusum" it is that of the limits that all columns have together at a smaller rate.
    """
    if rule.kind in FROZEN:

        def of_deviates(highest: Array, J: int) -> float:
            beyond = np.max((np.maximum(highest, 0.0) ** 2 - np.array(rule.limits) ** 2) / np.array(rule.growth))
            return float(-np.expm1(-J / rule.every * np.exp(-beyond)))

        return of_deviates
    if rule.simulated or rule.kind == "probability":
        return lambda highest, J: float("nan")
    if rule.kind == "band":
        rates = [normal_rate(rho) for rho in _alike(run, rule, slice(burn(run), None))]

        def of_band(highest: Array, J: int) -> float:
            each = [chance(rate, z, scipy.special.ndtr(-z), J) for rate, z in zip(rates, highest, strict=True)]
            return min(1.0, len(each) * min(each))

        return of_band

    def of_sums(highest: Array, J: int) -> float:
        W, slack = rule.window, rule.slack
        loud, aside = W + (highest[0] - W) / slack, highest[1] / slack
        each = (
            chance(power_rate(W), loud, scipy.special.chdtrc(W, max(loud, 0.0)), J),
            chance(mean_rate(W), aside, 2.0 * scipy.special.ndtr(-aside / np.sqrt(W)), J),
        )
        return min(1.0, 2.0 * min(each))

    return of_sums


RULES = {"band": _band, "innovation": _innovation, "probability": _probability}

"""A record smoothed over all hypotheses of its bank: path, probabilities and dates of changes, and how far theta moved.

The hypotheses are those of the bank, and none of its decisions or leaves: samples are weighed as the run weighed them,
and filtered again in both directions by `driftfit.smooth.mixture`. Probabilities of changes that the run learned are
those at its end. Independent changes are events of one mode; under a transition every joint event is a mode. In an
interval of k nominal samples the chain takes k steps, of which only the last moves theta. Outliers and offsets are a
mixture of noises. Sensors whose readings say nothing about theta (additive outliers, frozen, your own) depend on
earlier readings, so they are no noise: samples at which the run found such a fault have no weight. Changes that forget
or reset are no random walk, and are refused.

The drift of `Bank()` is a guess. The covariance that it gives parameter i is multiplied by a factor f_i, one of
`FACTORS`: none, or a power of ten. They are found by climbing from the best that is common to all parameters, one step
for all or for one of them at a time. The path is the average of two, with the mean of the smaller and of the larger
half of those that were tried, weighted by the evidence of all hypotheses. What is unknown of the noise is the record's:

    r       at which the expected sum of e^2 / s is the number of samples
    spikes  their expected share, with a prior that counts for `RARITY` samples; without them they would be two jumps

Source: Kitagawa (1994) for the smoother; Hoeting, Madigan, Raftery and Volinsky (1999) for averaging over models by
their likelihood. Cost: 20 us per sample for two parameters and changes, and some fifteen filters for `Bank()`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.bank.leaves.leaf_matrix import NU, WEIGHT, S
from driftfit.bank.results.events import Event
from driftfit.engine.kernel import Array
from driftfit.engine.settings import matrix
from driftfit.run.result import Track
from driftfit.show.text import path_table
from driftfit.smooth import mixture
from driftfit.smooth.mixture import Alternatives, Problem
from driftfit.smooth.problem import replay
from driftfit.smooth.smoothed import Bands
from driftfit.smooth.solvers.components import Noises
from driftfit.smooth.unknown_drift import FEW, Point, drifting, neighbours, shares, summit
from driftfit.trackers.forms.information import triangular_root

FACTORS = np.append(0.0, 10.0 ** np.arange(8.0))
"""Factors of the drift that are tried."""
RARITY = 20.0
"""Samples that the prior share of spikes counts for."""
NOISES = ((1.0, 0.95), (16.0, 0.04), (100.0, 0.01))
"""Factors of the noise variance for `Bank()`, and their probabilities before the record is seen."""


class SmoothedMixture(Bands):
    """Parameters of a record, each estimated from the whole record under all hypotheses.

    Attributes
    ----------
    theta, std : (T, n)
        Mean and standard deviation of the mixture; std is inf for parameters that the record never distinguished.
    change_prob : (T, H_d)
        Probabilities of the changes of the bank between the sample before and this one.
    prior : (T, H_d)
        The same before the record is seen.
    moved : (T, n)
        Probability that each parameter was part of a change other than the normal course.
    shift, shift_std : (T, n)
        theta_t - theta_{t-1} if there was such a change.
    r : float
        Noise variance.
    uneven : (T,) bool
        Samples at which the evidence is not constant although the number of components was raised: neglected
        hypotheses have a share there, and bands may be too narrow.
    """

    def __init__(self, run: Track, faults: list[Event]) -> None:
        self.run, self.names, self.time = run, run.names, run.time
        bank: Any = run.tracker
        problem = problem_of(run, faults)
        self._weighed = hypotheses_of(bank, problem)
        found = self._smoothed(None)
        self._weights = np.array([weight for weight, _ in self._weighed])
        self.mixture = mixture.average(self._weights, found)
        self.prior = problem.alternatives.first()[problem.table]
        self.theta, self.change_prob, self.shift = self.mixture.theta, self.mixture.events, self.mixture.shift
        self.shift_std = np.sqrt(self.mixture.shift_var)
        self.moved = self.change_prob[:, 1:] @ self.mixture.moves[1:]
        used = int(np.argmax(np.isfinite(problem.r)))
        scales = np.array([one.r[used] / problem.r[used] for _, one in self._weighed])
        self.r = float(noise_variance(bank, run) * np.sum(self._weights * np.where(scales > 0.0, scales, 1.0)))
        self.uneven = np.any([one.uneven for one in found], axis=0)

    def _smoothed(self, kept: Array | None, covariances: bool = False) -> list[mixture.Mixture]:
        """The record with each of the drifts; as many components are kept as the likeliest of them needed."""
        first = mixture.smooth(self._weighed[0][1], covariances, kept)
        return [first, *(mixture.smooth(one, covariances, first.kept) for _, one in self._weighed[1:])]

    def __rich_console__(self, console: Any, options: Any) -> Any:
        yield path_table("Smoothed over all hypotheses", self.names, self.theta, self.std)
        if lost := int(self.uneven.sum()):
            yield f" Hypotheses of some weight were neglected at {lost} samples."

    @cached_property
    def std(self) -> Array:
        return np.where(np.isinf(self.run.std[-1]), np.inf, np.sqrt(self.mixture.cov))

    @cached_property
    def covs(self) -> Array:
        """(T, n, n); computed again, with n n numbers for each sample."""
        return mixture.average(self._weights, self._smoothed(self.mixture.kept, covariances=True)).cov


def hypotheses_of(bank: Bank, problem: Problem) -> list[tuple[float, Problem]]:
    """Problems with weights that sum to 1: one if drift and noise are given."""
    free = bank.all_sensors[0].r is None and bank.all_sensors[0].guess is None
    if bank.changes is None:
        return averaged(problem, problem.alternatives.roots[0], free, bank.gated)
    return [(1.0, matched(problem, bank.gated) if free else problem)]


def problem_of(run: Track, faults: list[Event], kinds: Array | None = None) -> Problem:
    """The problem behind a run of a bank; ``kinds`` (T,) are the changes if they are known."""
    bank: Any = run.tracker
    if any(change.forgets for change in bank.all_changes):
        raise ValueError(
            "smooth: only random walks can be smoothed, and a Change that forgets or resets is not one; give its q "
            "instead, or cut the record at the changes with driftfit.smooth.piecewise.piecewise(run)."
        )
    replayed = replay(run)
    phi = np.ascontiguousarray(replayed["phi"][..., 0])
    n = phi.shape[1]
    ok, weighs = replayed["ok"][:, 0] > 0.0, replayed["used_noise"][:, 0]
    noise = noise_variance(bank, run)
    squares = np.mean(phi[ok] ** 2 / weighs[ok, None], axis=0) if ok.any() else np.ones(n)
    unit = np.where(squares > 0.0, noise / np.where(squares > 0.0, squares, 1.0), noise)
    relative = noise if bank.all_sensors[0].r is None and bank.all_sensors[0].guess is None else 1.0
    moves = [Q * relative + np.diag(sizes * unit) for Q, sizes in (c.increments(n) for c in bank.all_changes)]
    start = np.zeros((0, n + 1))
    if bank.p0 is not None:
        axes, rows = np.linalg.eigh(matrix("Bank", "p0", bank.p0, n) * relative)
        rows = rows.T / np.sqrt(np.maximum(axes, np.finfo(float).eps * axes.max()))[:, None]
        start = np.column_stack([rows, rows @ np.broadcast_to(bank.theta0, n)])
    priors = Priors(bank, run, replayed["dt"][:, 0], kinds)
    roots = np.array([triangular_root(Q) for Q in moves])
    sound = ok & ~faulty(run, faults, only_away=True)
    return Problem(
        phi, replayed["y"][:, 0].copy(), np.where(sound, noise * weighs, np.inf), Alternatives(*priors.moves(), roots),
        priors.table, priors.sizes(), start, priors.noises(),
    )  # fmt: skip


class Priors:
    """The prior probabilities of a run as moves between modes."""

    def __init__(self, bank: Bank, run: Track, dt: Array, kinds: Array | None) -> None:
        T, self.bank, self.dt = len(run), bank, dt
        self.Hd, Hm = len(bank.all_changes), len(bank.all_sensors)
        H = self.Hd * Hm
        known = run.known.over(T)
        plain = np.concatenate([np.full(H + self.Hd**2, np.nan), np.ones(self.Hd)])[None]
        given, self.factors = np.split(known.extra if known.extra.size else plain, [H + self.Hd**2], axis=1)
        self.drift, self.Hm = known.drift, Hm
        P, self.initial = bank.event_probabilities
        if bank.learns:
            P = bank.array(run.model, run.state, "chain")
        self.noise_of = [j for j, sensor in enumerate(bank.all_sensors) if not away(sensor)]
        kept = self._without(P.reshape(H, self.Hd, Hm)).reshape(self.Hd, Hm, -1)[:, self.noise_of]
        self.P = kept.reshape(kept.shape[0] * kept.shape[1], -1)
        self.chained = not bank.independent or not np.isnan(given[:, H:]).all()
        keys = [np.arange(T) == 0, dt]
        if len(given) > 1:
            keys += [*np.nan_to_num(given, nan=-1.0).T]
        self.rows, table = np.unique(np.column_stack(keys), axis=0, return_inverse=True)
        self.table, self.known = np.asarray(table).reshape(-1), kinds is not None
        if kinds is not None:
            self.table, self.chained = kinds, False

    def _without(self, p: Array) -> Array:
        """Probabilities (.., H_d, H_m) of the sensors that are noises, as shares."""
        p = p[..., self.noise_of] + np.finfo(float).tiny
        return np.asarray(p / p.sum(axis=(-2, -1), keepdims=True))

    def _row(self, row: Array) -> Array:
        """Transition (H, H) before a sample, H the joint events of changes and noises."""
        first, dt, given = row[0] > 0.0, row[1], row[2:]
        H, size = self.Hd * self.Hm, len(self.P)
        if len(given) and given[0] >= 0.0:
            return np.tile(self._without(given[:H].reshape(self.Hd, self.Hm)).ravel(), (size, 1))
        if first:
            return np.tile(self._without(self.initial.reshape(self.Hd, self.Hm)).ravel(), (size, 1))
        P, count = self.P, len(self.noise_of)
        if len(given) and given[H] >= 0.0:
            sensors = P.reshape(self.Hd, count, self.Hd, count).sum(axis=2)[0]
            P = np.kron(given[H:].reshape(self.Hd, self.Hd), sensors)
        return np.asarray(np.linalg.matrix_power(P, round(dt)) if self.chained else P)

    def moves(self) -> tuple[Array, Array, Array, Array]:
        """Modes before and after, events, and tables of log probabilities of the moves."""
        count, size = len(self.noise_of), len(self.P)
        zero, chains = np.zeros(self.Hd, int), np.array([self._row(row) for row in self.rows])
        with np.errstate(divide="ignore"):
            if self.chained:
                source, target = (one.ravel() for one in np.indices((size, size)))
                return source, target, target // count, np.log(chains.reshape(len(chains), -1))
            if self.known:
                return zero, zero, np.arange(self.Hd), np.log(np.eye(self.Hd))
            p = chains[:, 0].reshape(-1, self.Hd, count).sum(axis=2)
            as_given = (self.rows[:, 0] > 0.0) | (self.rows[:, 2:3] >= 0.0).any(axis=1)
            quiet = np.where(as_given, p[:, 0], p[:, 0] ** self.rows[:, 1])
            others = p[:, 1:] * ((1.0 - quiet) / np.where(p[:, 0] < 1.0, 1.0 - p[:, 0], 1.0))[:, None]
            return zero, zero, np.arange(self.Hd), np.log(np.column_stack([quiet, others]))

    def sizes(self) -> Array:
        """(T, H_d): factors of the roots of the changes; an event happens once, whatever the interval."""
        time = np.repeat(self.dt[:, None], self.Hd, axis=1)
        if not self.chained:
            time[:, 1:] = time[:, 1:] > 0.0
        return np.asarray(np.sqrt(self.drift[:, None] * self.factors * time))

    def noises(self) -> Noises:
        """The sensors that are noises."""
        if self.bank.gated:
            factors, p = np.array(NOISES).T
            return Noises(np.column_stack([factors, np.zeros(len(p))]), np.log(p)[None])
        kept = [self.bank.all_sensors[j] for j in self.noise_of]
        noises = np.array([[one.factor, one.value] for one in kept])
        p = self.P[0].reshape(self.Hd, -1).sum(axis=0)[None]
        if self.chained:
            p = np.tile(np.eye(len(kept)), (self.Hd, 1))
        with np.errstate(divide="ignore"):
            return Noises(noises, np.log(p))


def scaled(problem: Problem, c: float) -> Problem:
    """The same with all variances multiplied by c."""
    alternatives = problem.alternatives._replace(roots=problem.alternatives.roots * np.sqrt(c))
    return problem._replace(r=problem.r * c, alternatives=alternatives, start=problem.start / np.sqrt(c))


def matched(problem: Problem, spikes: bool) -> Problem:
    """The problem with the noise variance of the record and, with ``spikes``, their share."""
    used = np.isfinite(problem.r)
    count = used.sum() - problem.phi.shape[1]
    for _ in range(3 if count > 0 else 0):
        _, squares, spiked = mixture.filtered(problem, FEW)
        problem = scaled(problem, squares / count)
        if spikes:
            prior = np.array([p for _, p in NOISES])
            share = (spiked + RARITY * (1.0 - prior[0])) / (used.sum() + RARITY)
            p = np.where(prior < prior[0], prior * share / (1.0 - prior[0]), 1.0 - share)[None]
            problem = problem._replace(noises=problem.noises._replace(log_prob=np.log(p)))
    return problem


def averaged(problem: Problem, drift: Array, free: bool, spikes: bool) -> list[tuple[float, Problem]]:
    """Problems with the average of the smaller and of the larger likely drifts, and their shares, which sum to 1.

    ``drift`` (n, n) has the columns g_i; the first root of the problem is that of the drift. ``free``: the noise
    variance is the record's.
    """
    n, count = problem.phi.shape[1], np.isfinite(problem.r).sum() - problem.phi.shape[1]
    free = free and count > 0
    known: dict[Point, tuple[float, float]] = {}

    def of(factors: Array) -> Problem:
        return drifting(problem, triangular_root((drift * factors) @ drift.T))

    def value(levels: Point) -> float:
        """Log of the evidence, with the noise variance of greatest likelihood if it is free."""
        if levels not in known:
            evidence, squares, _ = mixture.filtered(of(FACTORS[list(levels)]), FEW)
            c = squares / count if free else 1.0
            if free:
                evidence += 0.5 * (squares - count) - 0.5 * count * np.log(c)
            known[levels] = evidence, c
        return known[levels][0]

    if free:
        first, before = np.argmax(np.isfinite(problem.r)), problem.r
        problem = matched(of(np.full(n, FACTORS[2])), spikes)
        drift = drift * np.sqrt(problem.r[first] / before[first])
    top = len(FACTORS) - 1
    common = max(((level,) * n for level in range(0, top + 1, 2)), key=value)
    summit(value, common, lambda at: neighbours(at, [[i] for i in range(n)], top))
    logs, noises = np.array([*known.values()]).T
    p, factors = shares(logs), FACTORS[np.array([*known])] * noises[:, None]
    order = np.argsort(factors.sum(axis=1))
    above = np.cumsum(p[order]) - 0.5 * p[order] > 0.5
    means = [
        p[half] @ np.column_stack([np.ones_like(p), noises, factors])[half] for half in (order[~above], order[above])
    ]
    return [(share, scaled(of(np.array(mean) / c), c / share)) for share, c, *mean in means if share > 0.0]


def noise_variance(bank: Bank, run: Track) -> float:
    """The known noise variance, or the bank's estimate at the end."""
    r = bank.all_sensors[0].r
    if r is not None:
        return float(r)
    lane = run.lane(-1)
    B = bank.array(run.model, lane, "leaves")
    mass = B[WEIGHT] > 0.0
    if not mass.any():
        return float(lane["scale"])
    return float(np.sum(B[WEIGHT, mass] * B[S, mass] / (B[NU, mass] - 2.0)))


def away(sensor: Any) -> bool:
    """Whether a reading under this hypothesis says nothing about theta."""
    return sensor.kind in ("additive", "frozen", "own")


def faulty(run: Track, events: list[Event], only_away: bool = False) -> Array:
    """Samples (T,) at which the sensor was at fault, or a regressor contains such a reading; ``only_away``: of the
    faults under which a reading says nothing about theta.
    """
    found, reach = np.zeros(len(run), bool), run.model.output_lags or 0
    bank: Any = run.tracker
    sensors = {sensor.name: sensor for sensor in bank.all_sensors}
    for event in events:
        if event.kind == "sensor" and (away(sensors[event.name]) or not only_away):
            sensor = sensors[event.name]
            reached = reach if sensor.cleans and sensor.kind != "offset" else 0
            found[event.span.first : event.span.last + 1 + reached] = True
    return found

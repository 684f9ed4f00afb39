"""The rule of an alarm: what is compared with which limits; estimated from a reference, and applied to later runs and
streams.

    glr     likelihood ratios on a frozen reference model (`driftfit.run.live.likelihood_ratio`)
    band    z_ti = max(theta_ti - high_i, low_i - theta_ti) / std_ti

An alarm is on from where a statistic is beyond its limit until all are below their ends, the limits that false alarms
would exceed `OFTENER` times as often: it does not flicker.

A record and a stream use the same operations in the same order, so their results agree bit for bit.

Readings of a coarse sensor are drawn again within their step:

    z = m + S Phi^-1(Phi(a) + U (Phi(b) - Phi(a))),   a, b = (y -+ h - m) / S,   U uniform

m is the prediction, S the noise and 2 h the step of the sensor. If m and S are those of the system, z has the errors of
a fine sensor, whatever the inputs do: the error of rounding, which is the same for as long as they are held, is gone
(`driftfit.judge.statistics.coarse_readings`). U is a function of the number of the sample and of a seed, which is
made from readings: a stream and a record draw the same, and other records draw other numbers.

Source: Dunn and Smyth (1996), whose residuals these are; Steele, Lea and Flood (2014) for the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import Any
from zlib import crc32

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, near
from driftfit.run.live.reference_model import CONSTANT, Frozen
from driftfit.trackers.base import Tracker

OFFSET = "offset"
"""The parameter of a constant regressor that the frozen model has even if the model of the run has none."""
KINDS = ("glr", "band")
OFTENER = 2.0

THETA, OF_NUMBERS, MEAN = (Frozen._fields.index(name) for name in ("theta", "numbers", "mean"))
"""Places in `AlarmRule.frozen`."""


@dataclass(frozen=True)
class AlarmRule(Settings):
    """The results of `Track.detect` on its reference: `Alarms.rule`. Frozen, equal by value, saved as plain data.

    Attributes
    ----------
    kind : "glr" or "band"
    every : number
        Samples in which one false alarm may begin.
    names, limits : (c,)
        Names of the statistics and their limits: "one parameter", "parameters" and "noise" of "glr"; parameters.
    growth : (c,)
        Growth of the squares of the limits with log(every).
    low, high : (c,)
        Bands of the parameters, for "band".
    parameters : (n,)
        Names of the parameters of the frozen model, for "glr"; otherwise empty. The last is OFFSET if the run has no
        constant regressor; it is the only one where the innovations of the tracker are judged.
    frozen : theta, unit, ar, cov, numbers, unseen, mean, lag
        That model, as `driftfit.run.live.reference_model.Frozen`.
    unsure : number
        Standard deviation of the log of the real rate of false alarms, which errors of the reference leave.
    rounding : () or (step, noise, seed)
        Of a coarse sensor: its readings are drawn again within the step (`driftfit.run.live.rule`).
    doubt : str
        What speaks against the reference: when it changes itself; empty if nothing does.
    """

    kind: str
    every: float
    names: tuple[str, ...]
    limits: tuple[float, ...]
    growth: tuple[float, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    parameters: tuple[str, ...] = ()
    frozen: tuple[Any, ...] = ()
    unsure: float = 0.0
    rounding: tuple[float, ...] = ()
    doubt: str = ""

    def __repr__(self) -> str:
        limits = ", ".join(f"{name} {limit:.4g}" for name, limit in zip(self.names, self.limits, strict=True))
        return f"AlarmRule({self.kind}, one false alarm in {self.every:g} samples, limits {limits})"

    @property
    def reference(self) -> Frozen:
        """The frozen model of "glr", as arrays."""
        n = len(self.parameters)
        shapes = (-1, -1, -1, (n, n), -1, (-1, n), -1, -1)
        found = Frozen(*(np.array(one, float).reshape(shape) for one, shape in zip(self.frozen, shapes, strict=True)))
        return found._replace(ends=self.ends) if self.limits else found

    @property
    def of_innovations(self) -> bool:
        """Whether "glr" judges the innovations of the tracker."""
        return self.parameters == (OFFSET,)

    @cached_property
    def ends(self) -> Array:
        """(c,): below these statistics an alarm ends."""
        return np.asarray(np.sqrt(np.maximum(np.square(self.limits) - np.log(OFTENER) * np.array(self.growth), 0.0)))

    def drawn(self, phi: Array, y: Array, noise: Array, first: int) -> Array:
        """Readings y (T,) on phi (T, n) of the frozen model, the first of them sample number ``first`` that is judged:
        drawn again within the step of a coarse sensor, and otherwise as they are.
        """
        if not self.rounding:
            return y
        theta, mean = (np.array(self.frozen[k], float) for k in (THETA, MEAN))
        constant = int(self.frozen[OF_NUMBERS][CONSTANT])
        away = np.sum(theta * mean) * phi[:, constant] if len(mean) else 0.0
        step, size, seed = self.rounding
        chance = chances(first, len(y), int(seed))
        return drawn(y, np.sum(phi * theta, axis=1) - away, size * np.sqrt(noise), 0.5 * step, chance)

    @property
    def real_rate(self) -> tuple[float, float]:
        """Samples in which one false alarm begins, least and most, for 95 % of the streams with such a reference.

        The rate is lognormal, and its mean over references is the one that is set.
        """
        away = self.unsure * NormalDist().inv_cdf(0.975)
        middle = 0.5 * self.unsure**2
        return self.every * float(np.exp(middle - away)), self.every * float(np.exp(middle + away))

    def columns(self, names: Sequence[str]) -> list[int]:
        """Indices of the watched parameters among those of a run; ValueError if one does not exist."""
        return [names.index(name) for name in self.names] if self.kind == "band" else []

    def outside(self, theta: Array, std: Array) -> Array:
        """How many standard deviations parameters (.., c) are outside their bands; NaN if they are not determined."""
        with np.errstate(invalid="ignore", divide="ignore"):
            beyond = np.maximum(theta - self.high, self.low - theta) / std
        return np.where(np.isfinite(std), beyond, np.nan)

    def active(self, statistic: Array, before: bool = False) -> Array:
        """Whether an alarm is on at each of T samples with statistics (T, c), after it was on or off ``before``."""
        with np.errstate(invalid="ignore"):
            begins, stays = (np.any(statistic > one, axis=1) for one in (np.array(self.limits), self.ends))
        decided = np.maximum.accumulate(np.where(begins | ~stays, np.arange(len(statistic)), -1))
        return np.where(decided >= 0, begins[decided], before)

    def cause(self, statistic: Array) -> int:
        """The column (c,) that is furthest beyond its limit."""
        with np.errstate(invalid="ignore", divide="ignore"):  # a limit is 0 where z hardly moves between samples
            ratio = statistic / np.array(self.limits)
        ratio = np.where(np.isfinite(statistic) & ~np.isnan(ratio), ratio, -np.inf)
        return int(np.argmax(ratio))


def check_fits(rule: AlarmRule, tracker: Tracker, names: Sequence[str]) -> None:
    """Raise an error if a tracker does not support the alarm."""
    own = [name for name in rule.parameters if name != OFFSET]
    if rule.kind == "glr" and len(names) != len(own) and not rule.of_innovations:
        raise ValueError(
            f"detect: the reference model has {len(own)} parameters, {', '.join(own)}; this run has {len(names)}. "
            "Make the rule from a run of the same model."
        )
    absent = [name for name in rule.names if name not in names] if rule.kind == "band" else []
    if absent:
        raise ValueError(f"detect: there is no parameter {absent[0]!r}; {near(str(absent[0]), names)}")
    if (rule.kind == "band" or rule.of_innovations) and not tracker.covariance:
        what = "no band" if rule.kind == "band" else "the size of no innovation"
        raise ValueError(f"detect: {type(tracker).__name__} carries no covariance, so {what} can be judged.")


GOLDEN, FIRST, SECOND = (np.uint64(one) for one in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def seed_of(y: Array, step: Array | float) -> int:
    """A number below 2^32 that readings y (N,), counted in steps from the first, determine, whatever their unit."""
    steps = y / step
    return crc32(np.round(steps - steps[:1]).astype(np.int64).tobytes())


def chances(first: int, count: int, seed: int) -> Array:
    """U (count,) of the samples from number ``first`` on."""
    z = (np.arange(first + 1, first + 1 + count).astype(np.uint64) + (np.uint64(seed) << np.uint64(31))) * GOLDEN
    z = (z ^ (z >> np.uint64(30))) * FIRST
    z = (z ^ (z >> np.uint64(27))) * SECOND
    return np.asarray(((z ^ (z >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53)


def drawn(y: Array, m: Array, S: Array | float, h: Array | float, chance: Array) -> Array:
    """z (N,) of readings y (N,) with predictions m (N,)."""
    low, high = (y - h - m) / S, (y + h - m) / S
    side = np.where(low + high > 0.0, -1.0, 1.0)  # tails have digits on the left
    low, high = np.where(side > 0.0, low, -high), np.where(side > 0.0, high, -low)
    below = scipy.special.ndtr(low)
    with np.errstate(divide="ignore"):
        w = np.clip(scipy.special.ndtri(below + chance * (scipy.special.ndtr(high) - below)), low, high)
    return np.asarray(m + S * side * w)

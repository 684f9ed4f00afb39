"""The rule of an alarm: what is compared with which limits; estimated from a reference, and applied to later runs and
streams.

    band          z_ti = max(theta_ti - high_i, low_i - theta_ti) / std_ti
    innovation    sums over the last W used samples of g_t^2 and of g_t (its absolute value), g = e / s, or its normal
                  score among normal innovations
    probability   the probability of a change in the tracker's window
    glr, cusum    likelihood ratios or cumulated scores on a frozen reference model
                  (`driftfit.run.live.likelihood_ratio`)

A record and a stream use the same operations in the same order, so their results agree bit for bit.

Readings of a coarse sensor are drawn again within their step:

    z = m + S Phi^-1(Phi(a) + U (Phi(b) - Phi(a))),   a, b = (y -+ h - m) / S,   U uniform

m is the prediction, S the noise and 2 h the step of the sensor. If m and S are those of the system, z has the errors of
a fine sensor, whatever the inputs do: the error of rounding, which is the same for as long as they are held, is gone
(`driftfit.judge.statistics.parts.coarse_readings`). U is a function of the number of the sample and of a seed, which is
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
from driftfit.run.live.reference_model import CONSTANT, CUSUM, JOINT, NOISE, ONE, TOP, Frozen
from driftfit.trackers.base import Tracker

FROZEN = ("glr", "cusum")
"""Kinds that judge by a frozen reference model."""
OFFSET = "offset"
"""The parameter of a constant regressor that the frozen model has even if the model of the run has none."""
KINDS = (*FROZEN, "band", "innovation", "probability")

THETA, OF_NUMBERS, MEAN = (Frozen._fields.index(name) for name in ("theta", "numbers", "mean"))
"""Places in `AlarmRule.frozen`."""
CUSUM_CAP = 1.3
"""From this multiple of the largest limit on, a CUSUM forgets."""
CHANGE, REPORT = "window", "report"
"""Where the probability of a change is stored: in a field of the tracker, or in the report of a `Bank`."""


@dataclass(frozen=True)
class AlarmRule(Settings):
    """The results of `Track.detect` on its reference: `Alarms.rule`. Frozen, equal by value, saved as plain data.

    Attributes
    ----------
    kind : "glr", "cusum", "band", "innovation" or "probability"
    every : number
        Samples in which one false alarm may begin.
    names, limits : (c,)
        Names of the statistics and their limits: "one parameter", "parameters" and "noise" of "glr"; parameters;
        "power" and "mean" of the innovations; "probability".
    hold : int
        Number of samples for which an alarm stays on after its cause.
    window : int
        Samples in the sums of "innovation".
    low, high : (c,)
        Bands of the parameters, for "band".
    normal : (k,)
        Normal absolute standardised innovations, ascending, for "innovation" with a reference; otherwise empty.
    simulated : bool
        Whether the limits were found by simulation.
    parameters : (n,)
        Names of the parameters of the frozen model, for "glr" and "cusum"; otherwise empty. The last is OFFSET if the
        run has no constant regressor.
    frozen : theta, unit, ar, cov, numbers, unseen, mean
        That model, as `driftfit.run.live.reference_model.Frozen`.
    growth : (c,)
        Growth of the squares of the limits with log(every).
    rounding : () or (step, noise, seed)
        Of a coarse sensor: its readings are drawn again within the step (`driftfit.run.live.rule`).
    unsure : number
        Standard deviation of the log of the real rate of false alarms, which errors of the reference leave.
    """

    kind: str
    every: float
    names: tuple[str, ...]
    limits: tuple[float, ...]
    hold: int = 0
    window: int = 50
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    normal: tuple[float, ...] = ()
    simulated: bool = False
    parameters: tuple[str, ...] = ()
    frozen: tuple[Any, ...] = ()
    growth: tuple[float, ...] = ()
    unsure: float = 0.0
    rounding: tuple[float, ...] = ()

    def __repr__(self) -> str:
        limits = ", ".join(f"{name} {limit:.4g}" for name, limit in zip(self.names, self.limits, strict=True))
        return f"AlarmRule({self.kind}, one false alarm in {self.every:g} samples, limits {limits})"

    @property
    def reference(self) -> Frozen:
        """The frozen model of "glr" and "cusum", as arrays."""
        n = len(self.parameters)
        shapes = (-1, -1, -1, (n, n), -1, (-1, n), -1)
        found = Frozen(*(np.array(one, float).reshape(shape) for one, shape in zip(self.frozen, shapes, strict=True)))
        found.numbers[TOP] = CUSUM_CAP * max(self.limits, default=0.0)
        return found

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

    @property
    def entries(self) -> list[int]:
        """Indices of the statistics of "glr" or "cusum" among the findings."""
        return [ONE, JOINT, NOISE] if self.kind == "glr" else [CUSUM + j for j in range(len(self.names))]

    @property
    def slack(self) -> float:
        """How much wider the limits are because the reference is itself an estimate."""
        return float(np.sqrt(1.0 + self.window / len(self.normal))) if self.normal else 1.0

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array, Array]:
        """limits, low, high and normal."""
        return np.array(self.limits), np.array(self.low), np.array(self.high), np.array(self.normal)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Indices of the watched parameters among those of a run; ValueError if one does not exist."""
        return [names.index(name) for name in self.names] if self.kind == "band" else []

    def outside(self, theta: Array, std: Array) -> Array:
        """How many standard deviations parameters (.., c) are outside their bands; NaN if they are not determined."""
        _, low, high, _ = self._arrays
        with np.errstate(invalid="ignore", divide="ignore"):
            beyond = np.maximum(theta - high, low - theta) / std
        return np.where(np.isfinite(std), beyond, np.nan)

    def scores(self, innovation: Array, std: Array) -> Array:
        """g, finite or NaN: innovations over their standard deviations, or their normal scores."""
        with np.errstate(invalid="ignore", divide="ignore"):
            g = innovation / std
        g = np.where(np.isfinite(g), g, np.nan)
        return normal_scores(g, self._arrays[3]) if self.normal else g

    def exceeded(self, statistic: Array) -> Array:
        """Whether any column (.., c) is beyond its limit."""
        with np.errstate(invalid="ignore"):
            return np.asarray((statistic > self._arrays[0]).any(axis=-1))

    def cause(self, statistic: Array) -> int:
        """The column (c,) that is furthest beyond its limit."""
        with np.errstate(invalid="ignore", divide="ignore"):  # a limit is 0 where z hardly moves between samples
            ratio = statistic / self._arrays[0]
        ratio = np.where(np.isfinite(statistic) & ~np.isnan(ratio), ratio, -np.inf)
        return int(np.argmax(ratio))

    def limit_text(self, column: int) -> str:
        """The limit of a column as text; a probability near 1 as its distance from 1."""
        return value_text(self.kind, self.limits[column])


def value_text(kind: str, value: float) -> str:
    """A statistic or a limit as text; a probability near 1 as its distance from 1."""
    return f"1 - {1.0 - value:.2g}" if kind == "probability" and 0.999 < value < 1.0 else f"{value:.4g}"


def check_fits(rule: AlarmRule, tracker: Tracker, names: Sequence[str]) -> None:
    """Raise an error if a tracker does not support the alarm."""
    kind = type(tracker).__name__
    own = [name for name in rule.parameters if name != OFFSET]
    if rule.kind in FROZEN and len(names) != len(own):
        raise ValueError(
            f"detect: the reference model has {len(own)} parameters, {', '.join(own)}; this run has {len(names)}. "
            "Make the rule from a run of the same model."
        )
    absent = [name for name in rule.names if name not in names] if rule.kind == "band" else []
    if absent:
        raise ValueError(f"detect: there is no parameter {absent[0]!r}; {near(str(absent[0]), names)}")
    if rule.kind == "band" and not tracker.covariance:
        raise ValueError(f"detect: {kind} carries no covariance, so no band can be judged.")
    if rule.kind == "innovation" and not tracker.covariance:
        raise ValueError(
            f"detect: {kind} carries no covariance, so the size of an innovation cannot be judged; use FLS or Kalman."
        )
    if rule.kind == "probability" and not {CHANGE, REPORT} & set(tracker.outputs):
        raise ValueError(
            f"detect: {kind} carries no probability of a change; track with Bank, or use "
            'kind="band" or kind="innovation".'
        )


def normal_scores(g: Array, known: Array) -> Array:
    """g with the size that a normal variable of the same rank among ``known`` (N,) absolute values would have."""
    share = (1.0 + len(known) - np.searchsorted(known, np.abs(g), side="left")) / (len(known) + 1.0)
    return np.where(np.isfinite(g), -scipy.special.ndtri(np.clip(share / 2.0, 1e-12, 0.5)) * np.sign(g), np.nan)


def moving_sums(values: Array, window: int) -> Array:
    """Sums (.., T - window + 1) of neighbours on the last axis, added from the oldest on, as in a stream."""
    count = max(values.shape[-1] - window + 1, 0)
    total = np.zeros((*values.shape[:-1], count))
    for k in range(window if count else 0):
        total += values[..., k : k + count]
    return total


def power_and_mean(g: Array, window: int) -> Array:
    """Moving sums of g^2 and absolute moving sums of g, (T - window + 1, 2)."""
    power, mean = moving_sums(np.stack([g * g, g]), window)
    return np.stack([power, np.abs(mean)], axis=1)


def change_probability(tracker: Any, fields: Any) -> float:
    """The probability of a change in the tracker's window, from the fields of one lane."""
    if CHANGE in tracker.outputs:
        return float(np.reshape(fields[CHANGE], -1)[0])
    return float(tracker.reported(fields[REPORT], CHANGE))


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

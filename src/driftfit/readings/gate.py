"""The gate between ``forecast`` and ``correct``: whether a reading is used.

A tracker is its equations; fault codes, spikes, frozen sensors and strange inputs are judged here, before it sees them.
With m and v the usual mean and variance of the readings y, y_hat the forecast, e the error and s the tracker's own
variance of it, a sample contradicts its forecast, and its reading is far besides, if

    contradicts    e^2 > SURE^2 s g,    g = max(1, mean of e^2 / s)
    far            (y - m)^2 > FAR^2 v

where (y_hat - m)^2 takes the place of v if it is larger than RARE^2 v: a response that is itself unusual, as that to a
pulse, may be FAR times as large as predicted. A far reading is refused. A change is not a fault, however:

    a run      the third sample in a row that contradicts is believed, whatever its size. One that contradicts counts
               twice as much as one between that agrees; after a change as many must agree until the count is small
    pulses     of far responses to rare pulses, and of readings far from a signal that never moved, the third is
               believed, whatever lies between
    codes      come in runs: a far reading that repeats one of the last two far ones in all digits, with either sign,
               is not counted, and believed only with the `hold`-th; with `LONGER` times as many if the forecast moved
               meanwhile, so that a level would not have repeated, and readings do not repeat by nature

s = inf or NaN (start) contradicts nothing, a tracker without s is lent the mean of e^2, and a sample without a forecast
is judged by v alone. v counts a reading that contradicts its forecast as `CLIPPED` variances at most, so that spikes do
not become usual, but what is far in one of ten readings does.

Inputs are judged in `driftfit.readings.inputs`, coarse meters and frozen sensors in `repeats`, and the first samples,
which have nothing to be compared with, in `first_samples`.

Source: ours; confirmation by a second and third outlier is an old rule of process control (Western Electric, 1956).
Cost per ordinary sample: some forty operations, and O(m).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, Step, kernel, nothing
from driftfit.engine.outlined import outlined
from driftfit.engine.settings import Settings, numbers, whole
from driftfit.engine.tracker_part import whole_record
from driftfit.readings.first_samples import bring, no_samples, remember
from driftfit.readings.inputs import input_rules, no_inputs, taking_out
from driftfit.readings.repeats import BELIEVED, frozen_rule, measured, natural, resolve, unresolved

FIRST = 10.0
"""Readings after which a mean and a variance are known."""
MEMORY = 1000.0
"""Their memory, in readings; exponential."""
CLIPPED = 10.0
"""Variances of the readings that one which contradicts its forecast adds, at most."""
LONGER = 4
"""Times `Gate.hold` for which a code is held back where the forecast moves and readings do not repeat by nature."""
USED, REFUSED, FROZEN, INPUT, AT_START = range(5)
"""Reasons: what was decided of a sample."""
SIGNAL = 8
"""A decision is a reason plus this many times the signal that it is about: 0 for the output, 1 + j for input j. Of
several inputs it is the first."""


@dataclass(frozen=True)
class Gate(Settings):
    """Which readings are left out. Each rule has a number that turns it off, in brackets.

    ``far``: usual deviations of the readings, and ``sure``: deviations of the forecast, beyond which a reading is far
    (inf: no reading). ``believed``: samples in a row that are a change. ``hold``: repeats in all digits until a code is
    taken for a level (``believed``: repeats are as good as others). ``rare``: usual deviations beyond which a forecast
    is unusual (inf). ``away``: half ranges from the middle of its range beyond which an input is strange (inf).
    ``trust``: how many samples in a row are blamed on inputs. ``frozen``: probability per reading that a sensor freezes
    (0). ``first``: samples judged together at the start, besides one for each parameter (0).
    """

    far: float = 10.0
    sure: float = 5.0
    believed: int = 3
    hold: int = 16
    rare: float = 3.0
    away: float = 2.0
    trust: int = 6
    frozen: float = 0.001
    first: int = 16

    def __post_init__(self) -> None:
        for name in ("believed", "hold", "trust", "first"):
            self._set(name, whole("Gate", name, getattr(self, name), 0))
        for name in ("far", "sure", "rare", "away", "frozen"):
            if getattr(self, name) != np.inf:
                self._set(name, numbers("Gate", name, getattr(self, name), ndim=0, low=0.0))


def start(gate: Gate, n: int, m: int, shifts: bool = False) -> Mapping[str, Any]:
    """Fields of the gate's state before the first sample, for n parameters and m inputs (`no_samples`)."""
    return {
        "gate_count": 0.0, "gate_mean": 0.0, "gate_variance": 0.0, "gate_ratio": 1.0,
        "gate_run": 0, "gate_same": 0, "gate_pulses": 0, "gate_last": np.nan,
        "gate_other": np.nan, "gate_stuck": 0.0, "gate_forecast": np.nan, "reason": 0, "raw_e": np.nan,
        "gate_refused": 0, **unresolved(), **no_inputs(m), **no_samples(gate.first, n, m, shifts),
    }  # fmt: skip


@kernel
def learn(s: State, l: int, g: State, k: int, seen: bool, contradicts: bool, own: float, most: float) -> None:
    """Mean and variance of the readings, and the mean of e^2 / own, e^2 at ``most`` that, of the samples used."""
    known, spread = g.gate_count[k] >= FIRST, g.gate_variance[k]
    g.gate_count[k] += 1.0 if seen else 0.0
    share = 1.0 / max(min(g.gate_count[k], MEMORY), 1.0)
    if seen:
        off = measured(s, l) - g.gate_mean[k]
        clip = np.sqrt(CLIPPED * spread) if contradicts & known else np.inf
        off = min(max(off, -clip), clip)
        g.gate_mean[k] += share * off
        g.gate_variance[k] += share * ((1.0 - share) * off * off - spread)
    if (s.ok[l] > 0.0) & (own > 0.0) & (own < np.inf):
        g.gate_ratio[k] += share * (min(s.e[l] * s.e[l], most) / own - g.gate_ratio[k])


def output_rule(gate: Gate) -> Callable[[State, int, State, int, float], bool]:
    """Refuse a far reading, unless it belongs to a change."""
    far, rare = float(gate.far) ** 2, float(gate.rare) ** 2
    sure, believed, change, hold = float(gate.sure) ** 2, gate.believed, 2 * gate.believed - 1, gate.hold

    @kernel
    def held_back(g: State, k: int, y: float, unusual: bool) -> bool:
        """Whether a far reading is one of a code, or not yet enough of them are a change."""
        unmoved, strikes = g.steps[k] == 0.0, g.gate_same[k] == 0
        apart, apart_other = abs(abs(y) - abs(g.gate_last[k])), abs(abs(y) - abs(g.gate_other[k]))
        near2 = far * g.gate_variance[k]
        turns = (apart_other == 0.0) & ((apart * apart > near2) | (not natural(g, k)))
        if (apart == 0.0) | turns:
            g.gate_same[k] += 1
            g.gate_pulses[k] += 1 if unmoved & strikes else 0
            moved = (g.gate_stuck[k] > 0.5) & (not natural(g, k))
            return (g.gate_same[k] < (LONGER * hold if moved else hold)) & (g.gate_pulses[k] < believed)  # type: ignore[no-any-return]
        alike = unmoved | ((y - g.gate_last[k]) ** 2 < near2)
        g.gate_run[k] += 2
        g.gate_pulses[k] = (g.gate_pulses[k] + 1 if alike else 1) if unusual | unmoved else 0
        g.gate_other[k] = g.gate_last[k]
        g.gate_last[k] = y
        return (g.gate_run[k] < change) & (g.gate_pulses[k] < believed)  # type: ignore[no-any-return]

    @kernel
    def judge(s: State, l: int, g: State, k: int, v: float) -> bool:
        """Whether the sample contradicts its forecast."""
        y, e2 = measured(s, l), s.e[l] * s.e[l]
        off = y - g.gate_mean[k]
        predicted, step = s.valid[l] > 0.0, g.finest[k] if g.steps[k] > 0.0 else 0.0
        spread, response = max(g.gate_variance[k], step * step), s.y_hat[l] + s.shift[l] - g.gate_mean[k]
        unusual = predicted & (response * response > rare * spread)
        beyond = off * off > far * (response * response if unusual else spread)
        contradicts = e2 > sure * v if predicted else beyond
        if not contradicts:
            g.gate_run[k] = max(min(g.gate_run[k], 2 * change) - 1, 0)
            if g.gate_same[k] > 0:  # a level that repeats is not frozen either
                g.gate_stuck[k], g.gate_same[k] = BELIEVED, 0
        elif beyond & (g.gate_count[k] >= FIRST):
            if held_back(g, k, y, unusual):
                s.ok[l], s.observed[l], s.reason[l] = 0.0, 0.0, REFUSED
            else:
                g.gate_run[k] = 2 * change
                g.gate_stuck[k] = BELIEVED if g.gate_same[k] > 0 else g.gate_stuck[k]
        else:
            g.gate_run[k] += 2
        return contradicts  # type: ignore[no-any-return]

    return judge  # type: ignore[no-any-return]


def judge_of(gate: Gate, implicit: bool, lends: bool, foresee: Step | None) -> Any:
    """``step(s, l, g, k)``, which decides whether the sample of lane l is used. Its gate is lane k of the record g: its
    own, or of outputs that share one theta that of its output. Other arguments as for `gate_step`."""
    notice, blame = input_rules(gate)
    hold_frozen = frozen_rule(gate.frozen)
    judge = output_rule(replace(gate, rare=np.inf) if implicit and foresee is None else gate)
    sure, rare, least = float(gate.sure) ** 2, float(gate.rare) ** 2, 0.0 if lends else 1.0
    far, curved, look = float(gate.far) ** 2, foresee is not None, foresee or nothing

    @kernel
    def step(s: State, l: int, g: State, k: int) -> None:
        ages, s.reason[l] = s.reason[l], USED
        s.raw_e[l] = s.e[l] if s.ok[l] > 0.0 else np.nan
        seen = s.observed[l] > 0.0
        notice(s, l, g, k, ages, g.gate_count[k] >= FIRST)
        off, y_hat, e, variance = measured(s, l) - g.gate_mean[k], s.y_hat[l], s.e[l], s.s[l]
        if curved and off * off > far * g.gate_variance[k]:
            look(s, l)
        own = 1.0 if lends else s.s[l]
        v = own * max(g.gate_ratio[k], least)
        contradicts = (s.ok[l] > 0.0) & (s.e[l] * s.e[l] > sure * v)
        signal = blame(g, k, contradicts, off * off <= rare * g.gate_variance[k]) if s.ok[l] > 0.0 else 0
        if signal > 0:
            s.ok[l], s.reason[l] = 0.0, INPUT + SIGNAL * signal
        if (s.observed[l] > 0.0) & (s.reason[l] == USED):
            if hold_frozen(s, l, g, k, v) & (g.gate_same[k] == 0):
                s.ok[l], s.observed[l], s.reason[l] = 0.0, 0.0, FROZEN
            else:
                contradicts = judge(s, l, g, k, v)
        resolve(s, l, g, k)
        g.reading[k] = measured(s, l) if seen else g.reading[k]
        # a start may claim any precision for a sample, but the first errors are all there is where none is claimed
        most = np.inf if lends & (g.gate_count[k] < FIRST) else sure * v
        learn(s, l, g, k, seen, contradicts, own, most)
        s.y_hat[l], s.e[l], s.s[l] = y_hat, e, variance

    return step


@lru_cache(maxsize=256)
def gate_step(
    gate: Gate, ages: int, refuse: Callable[[State, int, int, int], None], implicit: bool = False, lends: bool = False,
    foresee: Step | None = None, rows: Any = None,
) -> Any:  # fmt: skip
    """The gate of a model which remembers an input for ``ages`` samples, until ``refuse`` makes it missing there.

    All models have one judge, which finds ``ages`` in s.reason and writes there why the sample is not used. The
    regressors of an ``implicit`` model contain the reading, so y_hat is no forecast of it: a code would be as large as
    predicted. There ``foresee(s, l)`` writes y_hat, e and s before a far reading is seen. With ``lends`` the mean of
    e^2 takes the place of s, which the tracker does not have. Of outputs that share one theta every sample is of
    the next, ``s.output``; ``rows`` are (what finds the gates of all in a record, their number, signals of each).
    """
    memory, several, signals = rows or (whole_record, 0, 0)
    step = judge_of(gate, implicit, lends, foresee)

    @partial(kernel, inline=False)
    def judges(s: State) -> None:
        g, k, L = memory(s), 0, s.reason.shape[0]
        if several:  # a constant, as below
            k = s.output[0]
        if s.gate_decided[0] < 1:
            for l in range(L):
                bring(s, l, g, k + l)
            if k + L == g.gate_kept.shape[0]:
                remember(s, g, s.reason[0], implicit)
        for l in range(L):
            step(s, l, g, k + l)
        if several:  # trackers read these of the output that was seen last
            s.reading[0], s.alike[0], s.finest[0] = g.reading[k], g.alike[k], g.finest[k]

    judge_all = judges if foresee or several else outlined(judges)
    take_out = taking_out(refuse, SIGNAL, memory, several)
    refuse_all = take_out if several else outlined(take_out, short=True)

    @kernel
    def decide(s: State) -> None:
        refused = 0
        for l in range(s.reason.shape[0]):
            s.reason[l] = ages
        judge_all(s)
        for l in range(s.reason.shape[0]):
            refused = max(refused, s.reason[l])
        if refused > 0:
            refuse_all(s)
        if several:  # a constant
            s.reason[0] += SIGNAL * signals * s.output[0] if refused > 0 else 0
            s.output[0] = (s.output[0] + 1) % several

    return decide

"""Inputs far outside their range to which the output does not respond: fault codes, such as 0 where a meter shows 50.

A regressor is *outside* if it is more than `outside` times half the range of its earlier values away from the middle
m_i of that range, `OUTSIDE`. With e the innovation and s its variance, an input is at fault
if

    e^2 > SURE^2 s    and    |e + sum theta_i (phi_i - m_i)| < UNMOVED |e|,    the sum over regressors outside

so that the sample contradicts the prediction, and would not do so with the usual values of these regressors. A large
input to which the output responds, even by half as much as expected, or of which the effect is hardly known, is not at
fault: a step of a set point, a flood, a plant that begins to move, a rare pulse. If the value repeats that of the last
sample at fault, the first condition is dropped, and `REPEATED` takes the place of UNMOVED: codes come in runs, and are
lags afterwards.

A sample at fault is not used. It costs trust, `TRUST` of which are spent before inputs are believed: 1, or `AGAIN` if
the value is near that of the last one without repeating it in all digits, as that of an input that stays there. Every
other complete sample earns `EARNED` back. So an input that is far away and moves is believed at the sixth sample, and a
value that is always the same after fifty. Values that were believed widen the range.
Source: ours. Cost per sample: 2 n comparisons.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.faults.first_samples import NOISE, PHI
from driftfit.trackers.parts.faults.omissions import NOTHING_LEFT_OUT
from driftfit.trackers.parts.faults.outlying_readings import SURE

OUTSIDE = 1.25
"""Half ranges from the middle from which on a regressor is outside."""
UNMOVED, REPEATED = 0.4, 0.6
"""Share of the innovation that is left with the usual values of the regressors, at most; the same where the value
repeats that of the last sample at fault."""
TRUST = 50.0
"""Trust in inputs, in samples: so many in a row may be blamed on them."""
EARNED = 0.1
"""Trust that a complete sample earns back: the share of samples that may be blamed on inputs in the long run."""
AGAIN, ALIKE = 10.0, 0.25
"""Trust that a value costs, instead of 1, if it is near that of the last sample at fault; and what is near: differing
by less than this share of the distance from the middle of the range, or from the mean of readings."""


def trusted_inputs() -> dict[str, Any]:
    """Fields of the trust in inputs, and the counts, before the first sample."""
    return {"distrusted": 0.0, **NOTHING_LEFT_OUT}


def no_strange_inputs(n: int) -> dict[str, Any]:
    """Fields before the first sample: the ranges of the regressors, the last value at fault, and the trust spent."""
    ranges = {"input_low": np.full(n, np.inf), "input_high": np.full(n, -np.inf)}
    return {**ranges, "input_code": np.nan, **trusted_inputs()}


@kernel
def learn_inputs(s: State, l: int) -> None:
    """Widen the ranges by the regressor of a sample that is used."""
    used = s.ok[l] > 0.0
    for i in range(s.theta.shape[0]):
        low, high, x = s.input_low[i, l], s.input_high[i, l], s.phi[i, l]
        s.input_low[i, l] = x if used & (x < low) else low
        s.input_high[i, l] = x if used & (x > high) else high


@kernel
def learn_stored_inputs(s: State, l: int) -> None:
    """The ranges of the stored samples of a start that are not doubtful."""
    for i in range(s.theta.shape[0]):
        s.input_low[i, l], s.input_high[i, l] = np.inf, -np.inf
        for at in range(min(s.remembered[l], s.samples.shape[0])):
            if s.samples[at, NOISE, l] > 0.0:
                x = s.samples[at, PHI + i, l]
                s.input_low[i, l], s.input_high[i, l] = min(s.input_low[i, l], x), max(s.input_high[i, l], x)


@kernel
def blame_of_inputs(s: State, e: float, v: float, outside: float, l: int) -> float:
    """The trust that the sample costs, 0 without blame, given its innovation e, the variance v of that, and the half
    ranges from which on a regressor is outside.
    """
    rest, most, code, far = e, 0.0, 0.0, 0.0
    for i in range(s.theta.shape[0]):
        middle, half = 0.5 * (s.input_low[i, l] + s.input_high[i, l]), 0.5 * (s.input_high[i, l] - s.input_low[i, l])
        away = s.phi[i, l] - middle
        moved = s.theta[i, l] * away if (half > 0.0) & (abs(away) > outside * half) else 0.0
        rest += moved
        larger = abs(moved) > most
        most, code, far = max(most, abs(moved)), s.phi[i, l] if larger else code, abs(away) if larger else far
    apart = abs(code - s.input_code[l])
    again = apart == 0.0
    left, sure = (REPEATED if again else UNMOVED) * abs(e), 0.0 if again else SURE
    at_fault = (most > 0.0) & (v > 0.0) & (e * e > sure * sure * v) & (abs(rest) < left)
    near = (apart > 0.0) & (apart < ALIKE * far)
    s.input_code[l] = code if at_fault else s.input_code[l]
    price = AGAIN if near else 1.0
    return price if at_fault & (s.distrusted[l] < TRUST) else 0.0


@kernel
def spend_trust(s: State, cost: float, l: int) -> None:
    """Spend trust on a sample that inputs are blamed for; one without cost earns some back, if it is complete."""
    s.distrusted[l] = max(s.distrusted[l] + (cost if cost > 0.0 else -EARNED * s.ok[l]), 0.0)


@partial(kernel, inline=False)
def leave_out_input(s: State, l: int) -> None:
    """Leave out a sample with an input at fault; s.e and s.s must be known."""
    cost = 0.0
    if s.ok[l] > 0.0 and (s.e[l] * s.e[l] > SURE * SURE * s.s[l] or s.distrusted[l] > 0.0):
        cost = blame_of_inputs(s, s.e[l], s.s[l], OUTSIDE, l)
    spend_trust(s, cost, l)
    s.inputs_out[l] += 1.0 if cost > 0.0 else 0.0
    s.ok[l] = 0.0 if cost > 0.0 else s.ok[l]

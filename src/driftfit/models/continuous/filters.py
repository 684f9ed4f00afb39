"""The compiled steps of `driftfit.models.continuous.transfer`: state-variable filters, regressors and instruments.

Time is in units of 1 / lambda, D = d / d(lambda t), and the point of the linearisation is F' = D^n + p_1 D^(n-1) + ...
Row j of s.chain holds D^k z_j, k < 2 n, for input j, and row m those of the output, row m + 1 what one unit more at
the end of the interval would add to them; s.before holds the chains of the inputs before this sample, and what they
were driven by:

    F'^2 z_j = u_j held since the last sample,        F' q = y - c', linear between samples

    D^k u_f = sum_i p_i D^(n-i+k) z,     x_f = sum_i b_i lambda^.. D^.. z_j,     D^k y_f = D^k q

Where the point moves, the chains are scaled so that what was constant stays constant. The exact solution over an
interval is that of the Taylor series of the exponential, in steps of half the time of the fastest pole; `TERMS`
terms reach the precision of the numbers. Loops over poles n, inputs m and parameters take their bounds from the shapes
of the fields, which the compiler knows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import State, exp, kernel, log
from driftfit.models.lags import informed, take_input
from driftfit.models.linearised import along, restore, subtract

TERMS = 16
"""Terms of the Taylor series after the first."""

STEP = 0.5
"""Length of a step, in times of the fastest pole."""

STEP_LIMIT = 2000.0
"""Steps for one interval, at most: the rest of a longer gap is left out."""

STIFF = 50.0
"""Fastest pole of a filter, in inverse nominal intervals: a faster one cannot be observed."""

STABILITY_MARGIN = 1.0 + 1e-6
"""By how much the criterion of stability must be met by a filter that is used."""

LEVEL_FACTOR = 1e3
"""Largest factor by which the level of a chain is adjusted when its filter changes."""

SETTLING = 10.0
"""Samples for each parameter, and times 1 / lambda, before the filters follow theta."""

FOLLOWING = 10.0
"""Time in which they go to theta, in time constants of the filter: faster, and they would not hold its signals."""

REFINED = SETTLING + 5.0 * FOLLOWING
"""Times 1 / lambda before the regressors are the gradient."""


class Orders(NamedTuple):
    """What the steps depend on besides the shapes of fields: zeros, whether there is an offset, whether the point is
    held, and whether the tracker takes instruments."""

    nz: int
    offset: bool
    held: bool
    instruments: bool


@kernel
def advance(s: State, row: int, which: int, order: int, u: float, slope: float, l: int) -> None:
    """A chain of this order over s.span, driven by u + slope (time)."""
    left, now = s.cuts[l], u
    h = s.span[l] / max(s.cuts[l], 1.0)
    while left > 0.5:
        for i in range(order - 1):  # s.rate = A x + b u
            s.rate[i, l] = s.chain[row, i + 1, l]
        total = now
        for i in range(order):
            total -= s.poly[which, i, l] * s.chain[row, i, l]
        s.rate[order - 1, l] = total
        scale = h
        for k in range(TERMS):
            for i in range(order):
                s.chain[row, i, l] += scale * s.rate[i, l]
            scale *= h / (k + 2.0)
            total = slope if k == 0 else 0.0
            for i in range(order):
                total -= s.poly[which, i, l] * s.rate[i, l]
            for i in range(order - 1):
                s.rate[i, l] = s.rate[i + 1, l]
            s.rate[order - 1, l] = total
        now += slope * h
        left -= 1.0


@kernel
def stable(s: State, l: int) -> bool:
    """The criterion of Lienard and Chipart for the polynomial s.p, of positive coefficients."""
    n, one, other = s.p.shape[0], 1.0, 0.0
    if n == 3:
        one, other = s.p[0, l] * s.p[1, l], s.p[2, l]
    if n == 4:
        one = s.p[0, l] * s.p[1, l] * s.p[2, l]
        other = s.p[2, l] * s.p[2, l] + s.p[0, l] * s.p[0, l] * s.p[3, l]
    return one > STABILITY_MARGIN * other


@kernel
def fastest(s: State, l: int) -> float:
    """2 max_i p_i^(1 / i), a bound of its poles."""
    found = 0.0
    for i in range(s.p.shape[0]):
        found = max(found, 2.0 * exp(log(s.p[i, l]) / (i + 1.0)))
    return found


@kernel
def usable(s: State, l: int) -> bool:
    """Whether F at s.target, in s.p, is stable and slow enough."""
    good = True
    for i in range(s.p.shape[0]):
        s.p[i, l] = s.target[i, l] * s.unit[i + 1, l]
        good = good & (s.p[i, l] > 0.0) & (s.p[i, l] < LARGEST)
    return good and stable(s, l) and fastest(s, l) * s.per_sample[l] < STIFF


@kernel
def take_polynomials(s: State, l: int) -> None:
    """F' and F'^2 in s.poly, the coefficients of D^0 first."""
    n = s.p.shape[0]
    for i in range(n):
        s.poly[1, i, l] = s.p[n - 1 - i, l]
    for k in range(2 * n):
        total = 0.0
        for i in range(max(0, k - n), min(k, n) + 1):
            one = s.poly[1, i, l] if i < n else 1.0
            total += one * (s.poly[1, k - i, l] if k - i < n else 1.0)
        s.poly[0, k, l] = total


@kernel
def move(s: State, offset: bool, l: int) -> None:
    """The point moves to s.target if the filter there is usable."""
    n, m, last = s.p.shape[0], s.last.shape[0], s.point.shape[0] - 1
    if usable(s, l):
        before = s.poly[1, 0, l]
        take_polynomials(s, l)
        level = min(max(before / s.poly[1, 0, l], 1.0 / LEVEL_FACTOR), LEVEL_FACTOR)
        for j in range(m):
            for i in range(2 * n):
                s.chain[j, i, l] *= level * level
        for i in range(n):
            s.chain[m, i, l] *= level
        if offset:
            s.chain[m, 0, l] += (s.point[last, l] - s.target[last, l]) / s.poly[1, 0, l]
        s.fastest[l] = fastest(s, l)
        for i in range(last + 1):
            s.point[i, l] = s.target[i, l]


@kernel
def of_input(s: State, j: int, k: int, l: int) -> float:
    """D^k u_f at the point."""
    n = s.p.shape[0]
    total = s.chain[j, n + k, l]
    for i in range(n):
        total += s.poly[1, i, l] * s.chain[j, i + k, l]
    return total  # type: ignore[no-any-return]


@kernel
def of_model(s: State, nz: int, k: int, l: int) -> float:
    """D^k x_f at the point."""
    n, total = s.p.shape[0], 0.0
    for j in range(s.last.shape[0]):
        for i in range(nz + 1):
            total += s.point[n + j * (nz + 1) + nz - i, l] * s.unit[n - i, l] * s.chain[j, i + k, l]
    return total


@kernel
def response(s: State, nz: int, l: int) -> float:
    """x at the point."""
    n, total = s.p.shape[0], 0.0
    for j in range(s.last.shape[0]):
        for i in range(nz + 1):
            total += s.point[n + j * (nz + 1) + nz - i, l] * s.unit[n - i, l] * of_input(s, j, i, l)
    return total


@kernel
def drive(s: State, offset: bool, l: int) -> bool:
    """Move the chains of the inputs; whether all inputs were known."""
    order, delay, complete = 2 * s.p.shape[0], s.u_lag.shape[1] - 1, True
    for j in range(s.last.shape[0]):
        u = s.u_lag[j, delay, l]
        known = abs(u) < LARGEST
        if known & (s.driven[j, l] == 0.0):
            s.chain[j, 0, l] = u / s.poly[0, 0, l] if offset else 0.0
            s.driven[j, l] = 1.0
        s.before[j, order, l] = s.last[j, l]
        for i in range(order):
            s.before[j, i, l] = s.chain[j, i, l]
        s.last[j, l] = u if known else s.last[j, l]
        advance(s, j, 0, order, s.last[j, l], 0.0, l)
        for i in range(order):
            s.chain[j, i, l] = s.chain[j, i, l] if abs(s.chain[j, i, l]) < LARGEST else 0.0
        complete = complete & known
    return complete


@kernel
def refuse_input(s: State, signal: int, age: int, l: int) -> None:
    """`ModelSteps.refuse`: the input held before takes the place of one that the chain has taken in at this sample."""
    order = 2 * s.p.shape[0]
    if age < s.u_lag.shape[1]:
        s.u_lag[signal, age, l] = np.nan
    else:
        for i in range(order):
            s.chain[signal, i, l] = s.before[signal, i, l]
        s.last[signal, l] = s.before[signal, order, l]
        advance(s, signal, 0, order, s.last[signal, l], 0.0, l)


@kernel
def follow(s: State, offset: bool, l: int) -> None:
    """Move the point towards theta, slowly beside the mean time constant of the filter, and that of its mean decay."""
    n = s.p.shape[0]
    slow = s.poly[1, min(1, n - 1), l] / (n * s.poly[1, 0, l]) if n > 1 else 1.0 / s.poly[1, 0, l]
    slow = 0.5 * (slow + n / s.poly[1, n - 1, l])
    share = min(1.0, s.span[l] / (FOLLOWING * slow))
    for i in range(s.point.shape[0]):
        s.target[i, l] = s.point[i, l] + share * (s.theta[i, l] - s.point[i, l])
    move(s, offset, l)


@kernel
def offset_of(s: State, offset: bool, l: int) -> float:
    """The last entry of the point, if it is an offset."""
    return s.point[s.point.shape[0] - 1, l] if offset else 0.0


@kernel
def measure(s: State, y: float, offset: bool, l: int) -> None:
    """Move the chain of the output to a next output y."""
    n, m = s.p.shape[0], s.last.shape[0]
    s.expected[l] = y
    per_span = 1.0 / s.span[l] if s.span[l] > 0.0 else 0.0
    advance(s, m, 1, n, s.last_y[l] - offset_of(s, offset, l), (y - s.last_y[l]) * per_span, l)
    for i in range(n):
        s.chain[m + 1, i, l] = 0.0
    advance(s, m + 1, 1, n, 0.0, per_span, l)


@lru_cache
def _regressors(o: Orders) -> Any:
    """``regressors(s, refined, l)``: s.phi, and s.zeta."""
    nz, offset, instruments = o.nz, o.offset, o.instruments

    @kernel
    def regressors(s: State, refined: bool, l: int) -> None:
        n, m, parameters = s.p.shape[0], s.last.shape[0], s.point.shape[0]
        for j in range(m):
            for i in range(nz + 1):
                s.phi[n + j * (nz + 1) + nz - i, l] = s.unit[n - i, l] * of_input(s, j, i, l)
        if offset:
            s.phi[parameters - 1, l] = 1.0
        if instruments:
            for i in range(n, parameters):
                s.zeta[i, l] = s.phi[i, l]
        for i in range(n):
            measured = -s.unit[i + 1, l] * s.chain[m, n - 1 - i, l]
            modelled = -s.unit[i + 1, l] * of_model(s, nz, n - 1 - i, l)
            if instruments:
                s.zeta[i, l] = modelled if refined else measured
                s.phi[i, l] = measured
            else:
                s.phi[i, l] = modelled if refined else measured

    return regressors


@lru_cache
def steps(o: Orders, delay: int) -> ModelSteps:
    """The compiled steps of a model with these orders."""
    nz, offset, held, instruments = o
    regressors = _regressors(o)

    @kernel
    def regress(s: State, l: int) -> None:
        parameters = s.point.shape[0]
        settled = (s.usable[l] >= SETTLING * parameters) & (s.elapsed[l] >= SETTLING)
        s.span[l] = s.dt[l] * s.per_sample[l] if s.begun[l] > 0.0 else 0.0
        s.cuts[l] = min(np.ceil(s.fastest[l] * s.span[l] / STEP), STEP_LIMIT)
        s.elapsed[l] += s.span[l] * s.moved_on[l]
        if settled & (not held):
            follow(s, offset, l)
        complete = drive(s, offset, l)
        y_hat = response(s, nz, l) + offset_of(s, offset, l)
        measure(s, y_hat if settled else s.last_y[l], offset, l)
        regressors(s, s.elapsed[l] >= REFINED, l)
        for j in range(s.last.shape[0]):
            for i in range(delay, 0, -1):
                s.u_lag[j, i, l] = s.u_lag[j, i - 1, l]
        take_input(s, l)
        known = complete & (s.begun[l] > 0.0) & (abs(y_hat) < LARGEST)
        shift = y_hat - along(s, l)
        if instruments:
            for i in range(parameters):
                s.zeta[i, l] = s.zeta[i, l] if known & (abs(s.zeta[i, l]) < LARGEST) else 0.0
        if not known:
            s.phi[0, l] = np.nan
        subtract(s, shift if known else 0.0, known, l)

    @kernel
    def push(s: State, l: int) -> None:
        m = s.last.shape[0]
        observed = s.observed[l] > 0.0
        predicted = informed(s, l)
        restore(s, observed, l)
        y = s.measured[l] if observed else (s.y_hat[l] if predicted else s.expected[l])
        if observed & (s.begun[l] == 0.0):
            s.chain[m, 0, l] = (y - offset_of(s, offset, l)) / s.poly[1, 0, l] if offset else 0.0
            s.expected[l], s.begun[l] = y, 1.0
        for i in range(s.p.shape[0]):
            moved = s.chain[m, i, l] + s.chain[m + 1, i, l] * (y - s.expected[l])
            s.chain[m, i, l] = moved if abs(moved) < LARGEST else 0.0
        s.last_y[l] = y

    return ModelSteps(regress, push, apply=take_input, ages=delay + 1, refuse=refuse_input)

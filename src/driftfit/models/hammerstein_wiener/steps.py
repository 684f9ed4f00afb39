"""The compiled steps of `driftfit.models.hammerstein_wiener.model`.

The state keeps the functions of the last inputs and outputs, so that each is evaluated once. A basis that depends on
its own coefficients is evaluated with those estimated before the sample of the input. The output is predicted from
theta before the sample, by solving

    g_1(y) + sum_k d_k g_k(y) = -(phi' theta over all columns but those of the present output)

with `driftfit.models.hammerstein_wiener.output_curve`. The steps in a driver only pass a lane to two compiled routines,
which are compiled once for all trackers. A call of a routine that is compiled for its orders is as fast as code inside
of the driver; one routine with orders at run time takes twice as long per sample.

There are two rows of regressors, one for this sample and one for the next. The next row is filled as soon as its lags
are known, at the previous sample, and is copied when it is needed. If a row were written in single numbers and read in
SIMD vectors directly afterwards, the processor would have to wait until all writes are finished.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import Array, State, Step, floats, kernel, machine, part, shared
from driftfit.models.base import GAP
from driftfit.models.hammerstein_wiener.output_curve import (
    Kind,
    believe,
    inverting,
    laying,
    locate,
    refining,
    values_of,
)
from driftfit.models.hammerstein_wiener.structure import AT, INPUT, NUMBER, Places, room
from driftfit.models.hammerstein_wiener.thresholds import INSIDE

DIGITS = 1e13
"""Largest ratio of the functions of a reading to the first of them, or to 1. Beyond it an absurd reading would leave
too few of sixteen digits for ordinary readings in the same columns."""
CURVED = 1e19
"""Largest function of a reading if there are several functions, which are nearly proportional for large readings. The
product of two stays below LARGEST."""


@part
def usable(m: Array, at: int, count: int) -> bool:
    """Whether the functions of a reading, stored from ``at`` on, are numbers of comparable size."""
    top = min(DIGITS * max(abs(m[at, 0]), 1.0), CURVED) if count > 1 else LARGEST
    beyond = 0
    for k in range(count):
        beyond += 0 if abs(m[at + k, 0]) < top else 1
    return beyond == 0


@part
def shift(m: Array, at: int, width: int, rows: int) -> None:
    """Move every row of an array to the place of the next one."""
    for i in range(at + width * rows - 1, at + width - 1, -1):
        m[i, 0] = m[i - width, 0]


@part
def past(m: Array, p: Places, theta: Array) -> float:
    """Return -(phi' theta) without the columns of the present output; also fills d_now."""
    at_d, n, others, now = p[AT.d], p[AT.n], p[AT.n_out] - 1, p[AT.now]
    for k in range(others):
        m[p[AT.d_now] + 1 + k, 0] = theta[at_d + k, 0]
    one, other = 0.0, 0.0
    for i in range(at_d):
        one -= theta[i, 0] * m[now + i, 0]
    i = at_d + others
    while i + 1 < n:
        one -= theta[i, 0] * m[now + i, 0]
        other -= theta[i + 1, 0] * m[now + i + 1, 0]
        i += 2
    if i < n:
        one -= theta[i, 0] * m[now + i, 0]
    return one + other


@shared
def minimal_past(m: Array, p: Places, theta: Array) -> float:
    """The same if theta is xi."""
    na, more_out, now, d, ad = p[AT.na], p[AT.n_out] - 1, p[AT.now], p[AT.x_d], p[AT.now] + p[AT.ad]
    total = 0.0
    for i in range(p[AT.inputs]):
        own = AT.count + INPUT.count * i
        nb, b, c, bc = p[own + INPUT.nb], p[own + INPUT.b], p[own + INPUT.c], now + p[own + INPUT.bc]
        for j in range(nb):
            column = m[now + b + j, 0]
            for k in range(p[own + INPUT.n_in] - 1):
                column += theta[c + k, 0] * m[bc + k * nb + j, 0]
            total -= theta[b + j, 0] * column
    for k in range(more_out):
        m[p[AT.d_now] + 1 + k, 0] = theta[d + k, 0]
    for i in range(na):
        column = m[now + i, 0]
        for k in range(more_out):
            column += theta[d + k, 0] * m[ad + k * na + i, 0]
        total -= theta[i, 0] * column
    for i in range(ad + na * more_out, now + p[AT.n]):
        total -= theta[d + more_out, 0] * m[i, 0]
    return total


@shared
def noise_factor(m: Array, p: Places, theta: Array) -> float:
    """sigma^2 sum_i a_i^2 F'(y_(t-i))^2 + floor, a_0 = 1, from the estimates before the sample."""
    n_out, total = p[AT.n_out], 0.0
    for i in range(p[AT.na] + 1):
        slope = 0.0
        for k in range(n_out):
            slope += m[p[AT.d_now] + k, 0] * m[p[AT.h_past] + i * n_out + k, 0]
        weight = 1.0 if i == 0 else theta[i - 1, 0]
        total += weight * weight * slope * slope
    factor = m[NUMBER.variance, 0] * total + m[NUMBER.floor, 0]
    return factor if factor < LARGEST else 1.0


@part
def fill(m: Array, p: Places, to: int, ago: int, observed: bool) -> None:
    """Fill phi without the columns of the present output, from the lags ``ago`` samples before it."""
    na, n_out, g, ad = p[AT.na], p[AT.n_out], p[AT.g_past] + (1 - ago) * p[AT.n_out], to + p[AT.ad]
    for i in range(p[AT.inputs]):
        own = AT.count + INPUT.count * i
        nb, n_in, b, bc = p[own + INPUT.nb], p[own + INPUT.n_in], to + p[own + INPUT.b], to + p[own + INPUT.bc]
        f = p[own + INPUT.f] + (p[own + INPUT.nk] - ago) * n_in
        for j in range(nb):
            m[b + j, 0] = -m[f + j * n_in, 0]
        for k in range(1, n_in):
            for j in range(nb):
                m[bc + (k - 1) * nb + j, 0] = -m[f + j * n_in + k, 0]
    for k in range(n_out):
        start = to if k == 0 else ad + (k - 1) * na
        for i in range(na):
            m[start + i, 0] = m[g + i * n_out + k, 0] if observed or i > 0 else np.nan
    for i in range(ad + (n_out - 1) * na, to + p[AT.n]):
        m[i, 0] = 1.0


@shared
def refuse_output(m: Array, p: Places) -> None:
    """The newest output, which the row of the next sample already contains, is missing: a gate refused it."""
    for k in range(p[AT.n_out]):
        m[p[AT.g_past] + k, 0] = np.nan
        if p[AT.na] > 0:
            m[p[AT.now] + (0 if k == 0 else p[AT.ad] + (k - 1) * p[AT.na]), 0] = np.nan


@shared
def complete(m: Array, p: Places) -> bool:
    """Whether all lags are known."""
    missing = 0
    for i in range(p[AT.n]):
        if i < p[AT.d] or i >= p[AT.d] + p[AT.n_out] - 1:
            missing += 0 if abs(m[p[AT.now] + i, 0]) < LARGEST else 1
    return missing == 0


@shared
def thresholds(m: Array, p: Places, theta: Array) -> None:
    """Feed back the coefficients of a dead zone: sum_j b_j (b_j c_k) / sum_j b_j^2, or the mean of (b_j c_k) / b_j."""
    for i in range(p[AT.inputs]):
        own = AT.count + INPUT.count * i
        nb, into = p[own + INPUT.nb], p[own + INPUT.into]
        for k in range(2 if p[own + INPUT.adaptive] > 0 else 0):
            total, size = 0.0, 0.0
            for j in range(nb if m[NUMBER.minimal, 0] == 0.0 else 0):
                gain, product = theta[p[own + INPUT.b] + j, 0], theta[p[own + INPUT.bc] + k * nb + j, 0]
                size += 1.0 if m[into + 4, 0] > 0.0 else gain * gain
                total += product / gain if m[into + 4, 0] > 0.0 else product * gain
            threshold = total / size if m[NUMBER.minimal, 0] == 0.0 else theta[p[own + INPUT.c] + k, 0]
            if abs(threshold) < LARGEST:
                top, bottom = INSIDE * m[into + 3, 0] * (1 - k), -INSIDE * m[into + 3, 0] * k
                m[into + 1 + k, 0] = min(max(threshold, bottom), top)


@lru_cache
def _entering(into: tuple[Kind, ...], i: int = 0, moves: bool = True) -> Any:
    """A part (m, p) that adds the inputs of this sample, from input i on, to their lags, or replaces the newest."""
    own = AT.count + INPUT.count * i
    input_at = values_of(into[i], own + INPUT.into, own + INPUT.end, own + INPUT.n_in)

    def one(m: Array, p: Places) -> None:
        f, n_in = p[own + INPUT.f], p[own + INPUT.n_in]
        if moves:
            shift(m, f, n_in, p[own + INPUT.nb] + p[own + INPUT.nk])
        input_at(m, p, m[p[AT.us] + i, 0], f, p[AT.spare])
        if not usable(m, f, n_in):
            m[f, 0] = np.nan

    enter = part(one)
    if i + 1 == len(into):
        return enter
    others = _entering(into, i + 1, moves)

    def all_from(m: Array, p: Places) -> None:
        enter(m, p)
        others(m, p)

    return part(all_from)


@lru_cache
def _regressing(into: tuple[Kind, ...], out: Kind) -> Any:
    """The computation of ``regress``, for the functions of all bases."""
    enter, output_at = _entering(into), values_of(out, AT.out, AT.curve, AT.n_out)
    lay, invert = laying(out), inverting(out)

    def regress_sample(m: Array, p: Places, theta: Array) -> None:
        n_out, rows, g, h = p[AT.n_out], 1 + max(p[AT.na], 1), p[AT.g_past], p[AT.h_past]
        if not m[NUMBER.believed, 0] > 0.0:  # the previous sample
            refuse_output(m, p)
        elif abs(m[NUMBER.raw, 0]) < LARGEST:
            believe(m, m[NUMBER.raw, 0])  # not before a gate has judged it
        shift(m, g, n_out, rows)
        if m[NUMBER.variance, 0] > 0.0:
            shift(m, h, n_out, rows)
        if p[AT.identity] == 0 and m[NUMBER.moved, 0] > 0.0:
            lay(m, p)
        if m[NUMBER.dt, 0] > GAP:  # all lags are missing
            for i in range(p[AT.f_past], p[AT.spare]):
                m[i, 0] = np.nan
        if p[AT.adaptive] > 0 and m[NUMBER.ok, 0] > 0.0:
            thresholds(m, p, theta)
        enter(m, p)
        if p[AT.nk] == 0 or m[NUMBER.dt, 0] > GAP:
            fill(m, p, p[AT.now], 0, True)
        if m[NUMBER.started, 0] == 0.0 and complete(m, p):
            m[NUMBER.started, 0] = 1.0
        right = minimal_past(m, p, theta) if m[NUMBER.minimal, 0] > 0.0 else past(m, p, theta)
        y = m[NUMBER.y, 0]
        observed = abs(y) < LARGEST
        if observed:
            output_at(m, p, y, g, h)
            observed = usable(m, g, n_out)
        m[NUMBER.raw, 0] = y if observed else np.nan
        if p[AT.identity] == 0:
            right = locate(m, p, right) if observed else invert(m, p, right)
            m[NUMBER.late, 0] = m[NUMBER.late, 0] if observed else 0.0
        m[NUMBER.predicted, 0] = right
        if not observed:
            output_at(m, p, right, g, h)
        m[NUMBER.factor, 0] = noise_factor(m, p, theta) if m[NUMBER.variance, 0] > 0.0 else 1.0
        m[NUMBER.y, 0] = -m[g, 0] if observed else np.nan
        m[NUMBER.dt, 0] = m[NUMBER.dt, 0] if m[NUMBER.started, 0] > 0.0 else 0.0
        if p[AT.nk] > 0:
            fill(m, p, p[AT.next], 1, observed)

    return part(regress_sample)


@lru_cache
def _regress(into: tuple[Kind, ...], out: Kind, p: tuple[int, ...], lanes: bool) -> Any:
    """The compiled routine of ``regress``."""
    work, orders, rows, n = _regressing(into, out), np.array(p), room(p), p[AT.n]

    def machine_regress(blocks: int, theta: int, L: int) -> None:
        stride = L if lanes else 1  # known to the compiler
        work(floats(blocks, rows, stride), orders, floats(theta, n, stride))

    return machine(machine_regress)


@lru_cache
def _push(out: Kind, p: tuple[int, ...], lanes: bool) -> Any:
    """The compiled routine of ``push``: it predicts if no other step needed the prediction before. With ``slope`` it
    also writes the functions of the output at the prediction to ``trial``, and F' there to ``trial_bend``.
    """
    refine, orders, rows = refining(out), np.array(p), room(p)
    output_at = values_of(out, AT.out, AT.curve, AT.n_out)

    def machine_push(blocks: int, L: int, slope: int) -> None:
        m, bend, d = floats(blocks, rows, L if lanes else 1), orders[AT.trial_bend], orders[AT.d_now]
        if m[NUMBER.late, 0] > 0.0:
            m[NUMBER.predicted, 0], m[NUMBER.late, 0] = refine(m, orders, m[NUMBER.predicted, 0]), 0.0
        if slope > 0:
            output_at(m, orders, m[NUMBER.predicted, 0], orders[AT.trial], bend)
            for k in range(1, orders[AT.n_out]):
                m[bend, 0] += m[d + k, 0] * m[bend + k, 0]

    return machine(machine_push)


@kernel
def settle_output(s: State, l: int) -> None:
    """Whether the output becomes a lag and part of the range of outputs: unless it is missing, or a gate refused it."""
    s.blocks[NUMBER.believed, l], s.blocks[NUMBER.ok, l] = s.observed[l], s.ok[l]


@lru_cache
def build(into: tuple[Kind, ...], out: Kind, p: tuple[int, ...]) -> ModelSteps:
    """The steps for the compiled bases of the inputs and of the output."""
    regress_one, regress_lane = _regress(into, out, p, False), _regress(into, out, p, True)
    predict = _predicting(out, p)
    curved, us, inputs, n, more = not p[AT.identity], p[AT.us], p[AT.inputs], p[AT.n], p[AT.n_out] - 1
    now, following, present, at_d = p[AT.now], p[AT.next], p[AT.g_past] + 1, p[AT.d]

    @kernel
    def regress(s: State, l: int) -> None:
        s.blocks[NUMBER.given, l], s.blocks[NUMBER.y, l], s.blocks[NUMBER.dt, l] = s.noise[l], s.y[l], s.dt[l]
        for i in range(inputs):
            s.blocks[us + i, l] = s.u[i, l]
        at, L = 8 * l, s.y.shape[0]
        blocks, theta = s.blocks.ctypes.data + at, s.theta.ctypes.data + at
        if L == 1:
            regress_one(blocks, theta, L)
        else:
            regress_lane(blocks, theta, L)
        for i in range(n):
            s.phi[i, l] = s.blocks[now + i, l]
        for k in range(more):
            s.phi[at_d + k, l] = s.blocks[present + k, l]
        s.y[l], s.dt[l] = s.blocks[NUMBER.y, l], s.blocks[NUMBER.dt, l]
        s.noise[l] *= s.blocks[NUMBER.factor, l]

    @kernel
    def push(s: State, l: int) -> None:
        s.noise[l] = s.blocks[NUMBER.given, l]
        if curved:
            predict(s, 0, l)
        s.y_hat[l] = s.blocks[NUMBER.predicted, l]
        settle_output(s, l)
        for i in range(n):
            s.blocks[now + i, l] = s.blocks[following + i, l]

    def ready(L: int) -> None:
        own = (regress_one if L == 1 else regress_lane), _push(out, p, L > 1)
        for routine in (*(one[0] for one in into), out[0], *own):
            routine.load()

    oldest = max(own[INPUT.nb] + own[INPUT.nk] for own in np.reshape(p[AT.count :], (-1, INPUT.count)).tolist()) - 1
    foresee, apply = partial(foreseeing, out, p) if curved else None, applying(into, p) if p[AT.nk] > 0 else None
    return ModelSteps(regress, push, ready, foresee, apply, oldest, refusing(p), width=1)


@lru_cache
def _predicting(out: Kind, p: tuple[int, ...]) -> Any:
    """A kernel (s, slope, l) that calls the routine of ``push``, for one lane or several."""
    push_one, push_lane = _push(out, p, False), _push(out, p, True)

    @kernel
    def predict(s: State, slope: int, l: int) -> None:
        at, L = 8 * l, s.y.shape[0]
        if L == 1:
            push_one(s.blocks.ctypes.data + at, L, slope)
        else:
            push_lane(s.blocks.ctypes.data + at, L, slope)

    return predict


@lru_cache
def foreseeing(out: Kind, p: tuple[int, ...], forecast: Step) -> Step:
    """`ModelSteps.foreseeing`: y - y_hat is F' (y - y_hat) in the equation, and s is that of phi at y_hat."""
    predict, trial, bend, at_d, more = _predicting(out, p), p[AT.trial], p[AT.trial_bend], p[AT.d], p[AT.n_out] - 1

    @kernel
    def foresee(s: State, l: int) -> None:
        predict(s, 1, l)
        y_hat, own = s.blocks[NUMBER.predicted, l], 0.0
        if abs(y_hat) < LARGEST:
            for back in range(2):
                for i in range(more):
                    s.phi[at_d + i, l], s.blocks[trial + 1 + i, l] = s.blocks[trial + 1 + i, l], s.phi[at_d + i, l]
                forecast(s, l)
                own = own if back else s.s[l]
            s.y_hat[l], s.s[l] = -s.blocks[trial, l], own
            s.e[l] = s.blocks[bend, l] * (s.blocks[NUMBER.raw, l] - y_hat)

    return foresee  # type: ignore[no-any-return]


@lru_cache
def applying(into: tuple[Kind, ...], p: tuple[int, ...]) -> Step:
    """The step that takes inputs after their sample: it evaluates their functions and fills the next row again."""
    place, orders, rows, us, inputs = _entering(into, moves=False), np.array(p), room(p), p[AT.us], p[AT.inputs]
    now, following, n = p[AT.now], p[AT.next], p[AT.n]

    def apply(s: State, l: int) -> None:
        for i in range(inputs):
            s.blocks[us + i, l] = s.u[i, l]
        m = floats(s.blocks.ctypes.data + 8 * l, rows, s.y.shape[0])
        place(m, orders)
        fill(m, orders, following, 1, m[NUMBER.believed, 0] > 0.0)
        for i in range(n):
            s.blocks[now + i, l] = s.blocks[following + i, l]

    step: Step = kernel(apply)
    return step


@lru_cache
def refusing(p: tuple[int, ...]) -> Any:
    """`ModelSteps.refuse`: the functions of an input are missing, also from the row of the next sample."""
    inputs, own = p[AT.inputs], np.array(p[AT.count :]).reshape(-1, INPUT.count)
    begin, width, count, delay = (tuple(own[:, k].tolist()) for k in (INPUT.f, INPUT.n_in, INPUT.nb, INPUT.nk))
    at = tuple((own[:, INPUT.b] + p[AT.next]).tolist())

    @kernel
    def refuse(s: State, signal: int, age: int, l: int) -> None:
        for i in range(inputs):
            if i == signal:
                for k in range(width[i]):
                    s.blocks[begin[i] + age * width[i] + k, l] = np.nan
                lag = age + 1 - delay[i]
                if (lag >= 0) & (lag < count[i]):
                    s.blocks[at[i] + lag, l] = np.nan

    return refuse

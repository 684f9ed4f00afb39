"""The compiled steps of `driftfit.models.hammerstein_wiener.model`.

The state keeps the functions of the last inputs and outputs, so that each is evaluated once. A basis that depends on
its own coefficients is evaluated with those estimated before the sample of the input. The output is predicted from
theta before the sample, by solving

    g_1(y) + sum_k d_k g_k(y) = -(phi' theta over all columns but those of the present output)

with `driftfit.models.hammerstein_wiener.output_curve`. The steps in a driver only pass a lane to two compiled routines,
which are compiled once for all trackers. A call of a routine that is compiled for its orders is as fast as code inside
of the driver. One routine with orders at run time would serve all models, but took twice as long per sample.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import Array, State, Step, floats, kernel, machine, part, shared
from driftfit.models.base import GAP
from driftfit.models.hammerstein_wiener.curves.basis import INSIDE
from driftfit.models.hammerstein_wiener.evaluate_bases import Kind, input_values, level_of, output_values, usable
from driftfit.models.hammerstein_wiener.output_curve import believe, inverting, laying, locating, refining
from driftfit.models.hammerstein_wiener.regressor_rows import (
    complete,
    fill,
    forget,
    lose_output,
    minimal_past,
    noise_factor,
    past,
    shift,
)
from driftfit.models.hammerstein_wiener.step_memory import (
    ADAPTIVE,
    BELIEVED,
    DT,
    EACH,
    FACTOR,
    G_PAST,
    GIVEN,
    H_PAST,
    IDENTITY,
    INPUTS,
    LATE,
    MINIMAL,
    MOVED,
    N_OUT,
    NA,
    NB,
    NEXT,
    NK,
    NOW,
    OK,
    OWN,
    OWN_ADAPTIVE,
    OWN_F,
    OWN_INTO,
    OWN_N_IN,
    OWN_NB,
    OWN_NK,
    PREDICTED,
    RAW,
    SPARE,
    STARTED,
    US,
    VARIANCE,
    N,
    Places,
    Y,
    room,
)


@shared
def thresholds(m: Array, p: Places, theta: Array) -> None:
    """Feed back the coefficients of a dead zone: sum_j b_j (b_j c_k) / sum_j b_j^2, or the mean of (b_j c_k) / b_j."""
    at_b, at_bc, x_c = p[NA], p[NA] + p[NB] + p[N_OUT] - 1, p[NA] + p[NB]
    for i in range(p[INPUTS]):
        own = OWN + EACH * i
        nb, into = p[own + OWN_NB], p[own + OWN_INTO]
        for k in range(2 if p[own + OWN_ADAPTIVE] > 0 else 0):
            total, size = 0.0, 0.0
            for j in range(nb if m[MINIMAL, 0] == 0.0 else 0):
                gain, product = theta[at_b + j, 0], theta[at_bc + k * nb + j, 0]
                size += 1.0 if m[into + 4, 0] > 0.0 else gain * gain
                total += product / gain if m[into + 4, 0] > 0.0 else product * gain
            threshold = total / size if m[MINIMAL, 0] == 0.0 else theta[x_c + k, 0]
            if abs(threshold) < LARGEST:
                top, bottom = INSIDE * m[into + 3, 0] * (1 - k), -INSIDE * m[into + 3, 0] * k
                m[into + 1 + k, 0] = min(max(threshold, bottom), top)
        more = p[own + OWN_N_IN] - 1
        at_b, at_bc, x_c = at_b + nb, at_bc + nb * more, x_c + more


@lru_cache
def _entering(into: tuple[Kind, ...], i: int = 0, moves: bool = True) -> Any:
    """A part (m, p) that adds the inputs of this sample, from input i on, to their lags, or replaces the newest."""
    input_at, own = input_values(into[i], i), OWN + EACH * i

    def one(m: Array, p: Places) -> None:
        if moves:
            shift(m, p[own + OWN_F], p[own + OWN_N_IN], p[own + OWN_NB] + p[own + OWN_NK])
        input_at(m, p, m[p[US] + i, 0], p[own + OWN_F], p[SPARE])
        if not usable(m, p[own + OWN_F], p[own + OWN_N_IN]):
            m[p[own + OWN_F], 0] = np.nan

    enter = part(one)
    if i + 1 == len(into):
        return enter
    others = _entering(into, i + 1, moves)

    def all_from(m: Array, p: Places) -> None:
        enter(m, p)
        others(m, p)

    return part(all_from)


@lru_cache
def regress_work(into: tuple[Kind, ...], out: Kind, lanes: bool) -> Any:
    """The computation of ``regress``, for the functions of all bases."""
    enter, output_at, bare_output_at = _entering(into), output_values(out), output_values(out, bends=False)
    lay, locate, invert = laying(output_at), locating(lanes), inverting(out)

    def regress_sample(m: Array, p: Places, theta: Array) -> None:
        n_out, rows, g, h = p[N_OUT], 1 + max(p[NA], 1), p[G_PAST], p[H_PAST]
        if not m[BELIEVED, 0] > 0.0:  # the previous sample
            for k in range(n_out):
                m[g + k, 0] = np.nan
            lose_output(m, p)
        elif abs(m[RAW, 0]) < LARGEST:
            believe(m, m[RAW, 0])  # not before a gate has judged it
        shift(m, g, n_out, rows)
        if m[VARIANCE, 0] > 0.0:
            shift(m, h, n_out, rows)
        if p[IDENTITY] == 0 and m[MOVED, 0] > 0.0:
            lay(m, p)
        if m[DT, 0] > GAP:
            forget(m, p)
        if p[ADAPTIVE] > 0 and m[OK, 0] > 0.0:
            thresholds(m, p, theta)
        enter(m, p)
        if p[NK] == 0 or m[DT, 0] > GAP:
            fill(m, p, p[NOW], 0, True)
        if m[STARTED, 0] == 0.0 and complete(m, p):
            m[STARTED, 0] = 1.0
        right = minimal_past(m, p, theta) if m[MINIMAL, 0] > 0.0 else past(m, p, theta)
        y = m[Y, 0]
        observed = abs(y) < LARGEST
        if observed:
            if m[VARIANCE, 0] > 0.0:
                output_at(m, p, y, g, h)
            else:
                bare_output_at(m, p, y, g, h)
            observed = usable(m, g, n_out)
        m[RAW, 0] = y if observed else np.nan
        if p[IDENTITY] == 0:
            right = locate(m, p, right) if observed else invert(m, p, right)
            m[LATE, 0] = m[LATE, 0] if observed else 0.0
        m[PREDICTED, 0] = right
        if not observed:
            output_at(m, p, right, g, h)
        m[FACTOR, 0] = noise_factor(m, p, theta) if m[VARIANCE, 0] > 0.0 else 1.0
        m[Y, 0] = -m[g, 0] if observed else np.nan
        m[DT, 0] = m[DT, 0] if m[STARTED, 0] > 0.0 else 0.0
        if p[NK] > 0:
            fill(m, p, p[NEXT], 1, observed)

    return part(regress_sample)


@lru_cache
def _regress(into: tuple[Kind, ...], out: Kind, p: tuple[int, ...], lanes: bool) -> Any:
    """The compiled routine of ``regress``."""
    work, orders, rows, n = regress_work(into, out, lanes), np.array(p), room(p), p[N]

    def machine_regress(blocks: int, theta: int, L: int) -> None:
        stride = L if lanes else 1  # known to the compiler
        work(floats(blocks, rows, stride), orders, floats(theta, n, stride))

    return machine(machine_regress)


@lru_cache
def _push(out: Kind, p: tuple[int, ...], lanes: bool) -> Any:
    """The compiled routine of ``push``: it predicts if no other step needed the prediction before."""
    refine, orders, rows = refining(level_of(out)), np.array(p), room(p)

    def machine_push(blocks: int, L: int) -> None:
        m = floats(blocks, rows, L if lanes else 1)
        if m[LATE, 0] > 0.0:
            m[PREDICTED, 0] = refine(m, orders, m[PREDICTED, 0])

    return machine(machine_push)


@kernel
def settle_output(s: State, l: int) -> None:
    """Whether the output becomes a lag and part of the range of outputs: unless it is missing, or a gate refused it."""
    s.blocks[BELIEVED, l], s.blocks[OK, l] = s.observed[l], s.ok[l]


@lru_cache
def build(into: tuple[Kind, ...], out: Kind, p: tuple[int, ...]) -> ModelSteps:
    """The steps for the compiled bases of the inputs and of the output."""
    regress_one, regress_lane = _regress(into, out, p, False), _regress(into, out, p, True)
    push_one, push_lane = _push(out, p, False), _push(out, p, True)
    curved = not p[IDENTITY]

    now, following, n, present, at_d, more = p[NOW], p[NEXT], p[N], p[G_PAST] + 1, p[NA] + p[NB], p[N_OUT] - 1
    us, inputs = p[US], p[INPUTS]

    @kernel
    def regress(s: State, l: int) -> None:
        s.blocks[GIVEN, l], s.blocks[Y, l], s.blocks[DT, l] = s.noise[l], s.y[l], s.dt[l]
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
        s.y[l], s.dt[l] = s.blocks[Y, l], s.blocks[DT, l]
        s.noise[l] *= s.blocks[FACTOR, l]

    @kernel
    def push(s: State, l: int) -> None:
        s.noise[l] = s.blocks[GIVEN, l]
        if curved:
            at, L = 8 * l, s.y.shape[0]
            if L == 1:
                push_one(s.blocks.ctypes.data + at, L)
            else:
                push_lane(s.blocks.ctypes.data + at, L)
        s.y_hat[l] = s.blocks[PREDICTED, l]
        settle_output(s, l)
        for i in range(n):
            s.blocks[now + i, l] = s.blocks[following + i, l]

    def ready(L: int) -> None:
        for routine in (
            *(one[0] for one in into),
            out[0],
            *((regress_one, push_one) if L == 1 else (regress_lane, push_lane)),
        ):
            routine.load()

    return ModelSteps(regress, push, ready)


@lru_cache
def applying(into: tuple[Kind, ...], p: tuple[int, ...]) -> Step:
    """The step that takes inputs after their sample: it evaluates their functions and fills the next row again."""
    place, orders = _entering(into, moves=False), np.array(p)
    now, following, n, us, inputs, rows = p[NOW], p[NEXT], p[N], p[US], p[INPUTS], room(p)

    def apply(s: State, l: int) -> None:
        for i in range(inputs):
            s.blocks[us + i, l] = s.u[i, l]
        m = floats(s.blocks.ctypes.data + 8 * l, rows, s.y.shape[0])
        place(m, orders)
        fill(m, orders, following, 1, m[BELIEVED, 0] > 0.0)
        for i in range(n):
            s.blocks[now + i, l] = s.blocks[following + i, l]

    step: Step = kernel(apply)
    return step


@lru_cache
def refusing(p: tuple[int, ...]) -> Any:
    """`Model.refuse`: the functions of an input are missing, also from the row of the next sample."""
    inputs, column, firsts = p[INPUTS], p[NEXT] + p[NA], []
    for i in range(inputs):
        own = OWN + EACH * i
        firsts.append((p[own + OWN_F], p[own + OWN_N_IN], p[own + OWN_NB], p[own + OWN_NK], column))
        column += p[own + OWN_NB]
    begin, width, count, delay, at = (tuple(each) for each in zip(*firsts, strict=True))

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

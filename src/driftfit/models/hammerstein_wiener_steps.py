"""The compiled steps of `driftfit.models.hammerstein_wiener`.

The record keeps the functions of the last inputs and outputs, so that each is evaluated once; a basis that depends on
its own coefficients is evaluated with those known before the sample of the input. The output is predicted from theta
before the sample, by solving

    g_1(y) + sum_k d_k g_k(y) = -(phi' theta over all columns but those of the present output)

with `driftfit.models.block_curve`. The steps that drivers are compiled with only hand a lane over to two machines,
which are compiled once for all trackers: a call of a machine that knows its orders is as fast as code in the midst of a
driver. With orders at run time one machine would do for all models, but took twice as long a sample.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.drivers import LARGEST, ModelSteps
from driftfit.kernel import Array, State, core, floats, kernel, outside, part
from driftfit.models.arx import GAP
from driftfit.models.block_curve import believe, inverse_of, laying
from driftfit.models.block_memory import (
    ADAPTIVE,
    D_NOW,
    DT,
    F_PAST,
    FACTOR,
    G_PAST,
    GIVEN,
    H_PAST,
    IDENTITY,
    INTO,
    MINIMAL,
    N_IN,
    N_OUT,
    NA,
    NB,
    NK,
    OK,
    PREDICTED,
    RAW,
    SEEN,
    SPARE,
    STARTED,
    VARIANCE,
    N,
    Places,
    U,
    Y,
)
from driftfit.models.block_values import input_values, level_of, output_values

INSIDE = 0.97
"""Share of u_max within which the thresholds of a dead zone are held."""
FLOOR = 1e-4
"""Least variance of the equation error under measurement noise."""


@part
def shift(m: Array, at: int, width: int, rows: int) -> None:
    """Every row of an array to the place of the next."""
    for i in range(at + width * rows - 1, at + width - 1, -1):
        m[i, 0] = m[i - width, 0]


@part
def past(m: Array, p: Places, theta: Array, phi: Array) -> float:
    """-(phi' theta) without the columns of the present output; also fills d_now."""
    at_d, n, others, d = p[NA] + p[NB], p[N], p[N_OUT] - 1, p[D_NOW]
    for k in range(others):
        m[d + 1 + k, 0] = theta[at_d + k, 0]
    one, other = 0.0, 0.0
    for i in range(at_d):
        one -= theta[i, 0] * phi[i, 0]
    i = at_d + others
    while i + 1 < n:
        one -= theta[i, 0] * phi[i, 0]
        other -= theta[i + 1, 0] * phi[i + 1, 0]
        i += 2
    if i < n:
        one -= theta[i, 0] * phi[i, 0]
    return one + other


@core
def minimal_past(m: Array, p: Places, theta: Array, phi: Array) -> float:
    """The same where theta is xi."""
    na, nb, more_in, more_out = p[NA], p[NB], p[N_IN] - 1, p[N_OUT] - 1
    x_c, d = na + nb, p[D_NOW] + 1
    x_d, at_bc = x_c + more_in, x_c + more_out
    at_ad = at_bc + nb * more_in
    total = 0.0
    for k in range(more_out):
        m[d + k, 0] = theta[x_d + k, 0]
    for i in range(na):
        column = phi[i, 0]
        for k in range(more_out):
            column += m[d + k, 0] * phi[at_ad + k * na + i, 0]
        total -= theta[i, 0] * column
    for j in range(nb):
        column = phi[na + j, 0]
        for k in range(more_in):
            column += theta[x_c + k, 0] * phi[at_bc + k * nb + j, 0]
        total -= theta[na + j, 0] * column
    for i in range(at_ad + na * more_out, p[N]):
        total -= theta[x_d + more_out, 0] * phi[i, 0]
    return total


@core
def noise_factor(m: Array, p: Places, theta: Array) -> float:
    """sigma^2 sum_i a_i^2 F'(y_(t-i))^2 + floor, a_0 = 1, from the estimates before the sample."""
    n_out, d = p[N_OUT], p[D_NOW]
    total = 0.0
    for i in range(p[NA] + 1):
        slope = 0.0
        for k in range(n_out):
            slope += m[d + k, 0] * m[p[H_PAST] + i * n_out + k, 0]
        weight = 1.0 if i == 0 else theta[i - 1, 0]
        total += weight * weight * slope * slope
    factor = m[VARIANCE, 0] * total + FLOOR
    return factor if factor < LARGEST else 1.0


@core
def forget(m: Array, p: Places) -> None:
    """All lags are missing."""
    for i in range(p[F_PAST], p[SPARE]):
        m[i, 0] = np.nan


@part
def fill(m: Array, p: Places, phi: Array) -> None:
    """phi from the lags, but for the columns of the present output."""
    na, nb, n_in, n_out = p[NA], p[NB], p[N_IN], p[N_OUT]
    f, g, at = p[F_PAST] + p[NK] * n_in, p[G_PAST] + n_out, na
    for k in range(n_in):
        for j in range(nb):
            phi[at + j, 0] = -m[f + j * n_in + k, 0]
        at = at + nb + n_out - 1 if k == 0 else at + nb
    for k in range(n_out):
        start = 0 if k == 0 else at + (k - 1) * na
        for i in range(na):
            phi[start + i, 0] = m[g + i * n_out + k, 0]
    for i in range(at + (n_out - 1) * na, p[N]):
        phi[i, 0] = 1.0


@core
def complete(p: Places, phi: Array) -> bool:
    """Whether all lags are there."""
    at_d = p[NA] + p[NB]
    missing = 0
    for i in range(p[N]):
        if i < at_d or i >= at_d + p[N_OUT] - 1:
            missing += 0 if abs(phi[i, 0]) < LARGEST else 1
    return missing == 0


@core
def thresholds(m: Array, p: Places, theta: Array) -> None:
    """The coefficients of a dead zone, fed back: sum_j b_j (b_j c_k) / sum_j b_j^2, or the mean of (b_j c_k) / b_j."""
    na, nb = p[NA], p[NB]
    x_c, at_bc, into = na + nb, na + nb + p[N_OUT] - 1, p[INTO]
    for k in range(2):
        total, size = 0.0, 0.0
        for j in range(nb if m[MINIMAL, 0] == 0.0 else 0):
            gain, product = theta[na + j, 0], theta[at_bc + k * nb + j, 0]
            size += 1.0 if m[into + 4, 0] > 0.0 else gain * gain
            total += product / gain if m[into + 4, 0] > 0.0 else product * gain
        threshold = total / size if m[MINIMAL, 0] == 0.0 else theta[x_c + k, 0]
        if abs(threshold) < LARGEST:
            top, bottom = INSIDE * m[into + 3, 0] * (1 - k), -INSIDE * m[into + 3, 0] * k
            m[into + 1 + k, 0] = min(max(threshold, bottom), top)


@lru_cache
def _regress_work(into: Any, out: Any) -> Any:
    """What ``regress`` does, for the functions of both bases."""
    input_at, output_at = input_values(into), output_values(out)
    invert = inverse_of(level_of(out))

    def regress_work(m: Array, p: Places, theta: Array, phi: Array) -> None:
        n_in, n_out, depth = p[N_IN], p[N_OUT], p[NB] + p[NK]
        f, g, h, spare = p[F_PAST], p[G_PAST], p[H_PAST], p[SPARE]
        if m[DT, 0] > GAP:
            forget(m, p)
        shift(m, f, n_in, depth)
        input_at(m, p, m[U, 0], f, spare)
        fill(m, p, phi)
        if m[STARTED, 0] == 0.0 and complete(p, phi):
            m[STARTED, 0] = 1.0
        right = minimal_past(m, p, theta, phi) if m[MINIMAL, 0] > 0.0 else past(m, p, theta, phi)
        y, at_d = m[Y, 0], p[NA] + p[NB]
        seen = abs(y) < LARGEST
        if seen:  # before the prediction, which nothing waits for then
            output_at(m, p, y, g, h)
            for k in range(n_out):
                seen = seen and abs(m[g + k, 0]) < LARGEST
                if k > 0:
                    phi[at_d + k - 1, 0] = m[g + k, 0]
        m[RAW, 0] = y if seen else np.nan
        if seen:
            believe(m, y)
        predicted = right if p[IDENTITY] > 0 else invert(m, p, right)
        m[PREDICTED, 0] = predicted
        if not abs(y) < LARGEST:
            output_at(m, p, predicted, g, h)
            for k in range(1, n_out):
                phi[at_d + k - 1, 0] = m[g + k, 0]
        m[FACTOR, 0] = noise_factor(m, p, theta) if m[VARIANCE, 0] > 0.0 else 1.0
        m[Y, 0] = -m[g, 0] if seen else np.nan
        m[DT, 0] = m[DT, 0] if m[STARTED, 0] > 0.0 else 0.0

    return part(regress_work)


@lru_cache
def _regress(into: Any, out: Any, p: tuple[int, ...], lanes: bool) -> Any:
    """The machine of ``regress``."""
    work, orders = _regress_work(into, out), np.array(p)

    def machine_regress(blocks: int, theta: int, phi: int, L: int) -> None:
        stride = L if lanes else 1  # which the compiler knows
        work(floats(blocks, 1, stride), orders, floats(theta, 1, stride), floats(phi, 1, stride))

    return outside(machine_regress)


@lru_cache
def _push_work(out: Any) -> Any:
    """What ``push`` does: the present output among the lags (missing stays missing), thresholds, the grid."""
    lay = laying(output_values(out))

    def push_work(m: Array, p: Places, theta: Array) -> None:
        rows, n_out, g = 1 + max(p[NA], 1), p[N_OUT], p[G_PAST]
        if not m[SEEN, 0] > 0.0:
            for k in range(n_out):
                m[g + k, 0] = np.nan
        shift(m, g, n_out, rows)
        if m[VARIANCE, 0] > 0.0:
            shift(m, p[H_PAST], n_out, rows)
        if p[ADAPTIVE] > 0 and m[OK, 0] > 0.0:
            thresholds(m, p, theta)
        if p[IDENTITY] == 0:
            lay(m, p)

    return part(push_work)


@lru_cache
def _push(out: Any, p: tuple[int, ...], lanes: bool) -> Any:
    """The machine of ``push``."""
    work, orders = _push_work(out), np.array(p)

    def machine_push(blocks: int, theta: int, L: int) -> None:
        stride = L if lanes else 1
        work(floats(blocks, 1, stride), orders, floats(theta, 1, stride))

    return outside(machine_push)


@lru_cache
def build(into: Any, out: Any, p: tuple[int, ...]) -> ModelSteps:
    """The steps for the machines of two bases."""
    regress_one, push_one = _regress(into, out, p, False), _push(out, p, False)
    regress_lane, push_lane = _regress(into, out, p, True), _push(out, p, True)

    @kernel
    def regress(s: State, l: int) -> None:
        s.blocks[GIVEN, l], s.blocks[U, l], s.blocks[Y, l], s.blocks[DT, l] = s.noise[l], s.u[0, l], s.y[l], s.dt[l]
        at, L = 8 * l, s.y.shape[0]
        blocks, theta, phi = s.blocks.ctypes.data + at, s.theta.ctypes.data + at, s.phi.ctypes.data + at
        if L == 1:
            regress_one(blocks, theta, phi, L)
        else:
            regress_lane(blocks, theta, phi, L)
        s.y[l], s.dt[l] = s.blocks[Y, l], s.blocks[DT, l]
        s.noise[l] *= s.blocks[FACTOR, l]

    @kernel
    def push(s: State, l: int) -> None:
        s.noise[l] = s.blocks[GIVEN, l]
        s.y_hat[l] = s.blocks[PREDICTED, l]
        s.blocks[SEEN, l], s.blocks[OK, l] = s.seen[l], s.ok[l]
        at, L = 8 * l, s.y.shape[0]
        if L == 1:
            push_one(s.blocks.ctypes.data + at, s.theta.ctypes.data + at, L)
        else:
            push_lane(s.blocks.ctypes.data + at, s.theta.ctypes.data + at, L)

    def ready(L: int) -> None:
        for machine in (into, out, *((regress_one, push_one) if L == 1 else (regress_lane, push_lane))):
            machine.load()

    return ModelSteps(regress, push, ready)

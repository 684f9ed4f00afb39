"""Rows of regressors in the memory of a Hammerstein-Wiener model: filled from the lags, and multiplied by the estimate.

There are two rows, one for this sample and one for the next. The next row is filled as soon as its lags are known, at
the previous sample, and is copied when it is needed. If a row were written in single numbers and read in SIMD vectors
directly afterwards, the processor would have to wait until all writes are finished.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, part, shared
from driftfit.models.hammerstein_wiener.step_memory import (
    D_NOW,
    EACH,
    F_PAST,
    G_PAST,
    H_PAST,
    INPUTS,
    LEAST,
    N_OUT,
    NA,
    NB,
    NOW,
    OWN,
    OWN_F,
    OWN_N_IN,
    OWN_NB,
    OWN_NK,
    SPARE,
    VARIANCE,
    N,
    Places,
)


@part
def shift(m: Array, at: int, width: int, rows: int) -> None:
    """Move every row of an array to the place of the next one."""
    for i in range(at + width * rows - 1, at + width - 1, -1):
        m[i, 0] = m[i - width, 0]


@part
def past(m: Array, p: Places, theta: Array) -> float:
    """Return -(phi' theta) without the columns of the present output; also fills d_now."""
    at_d, n, others, d, now = p[NA] + p[NB], p[N], p[N_OUT] - 1, p[D_NOW], p[NOW]
    for k in range(others):
        m[d + 1 + k, 0] = theta[at_d + k, 0]
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
    na, more_out, now, at = p[NA], p[N_OUT] - 1, p[NOW], p[NA] + p[NB] + p[N_OUT] - 1
    b, c, total = na, na + p[NB], 0.0
    for i in range(p[INPUTS]):
        nb, more_in = p[OWN + EACH * i + OWN_NB], p[OWN + EACH * i + OWN_N_IN] - 1
        for j in range(nb):
            column = m[now + b + j, 0]
            for k in range(more_in):
                column += theta[c + k, 0] * m[now + at + k * nb + j, 0]
            total -= theta[b + j, 0] * column
        b, c, at = b + nb, c + more_in, at + nb * more_in
    for k in range(more_out):
        m[p[D_NOW] + 1 + k, 0] = theta[c + k, 0]
    for i in range(na):
        column = m[now + i, 0]
        for k in range(more_out):
            column += theta[c + k, 0] * m[now + at + k * na + i, 0]
        total -= theta[i, 0] * column
    for i in range(at + na * more_out, p[N]):
        total -= theta[c + more_out, 0] * m[now + i, 0]
    return total


@shared
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
    factor = m[VARIANCE, 0] * total + m[LEAST, 0]
    return factor if factor < LARGEST else 1.0


@shared
def forget(m: Array, p: Places) -> None:
    """Mark all lags as missing."""
    for i in range(p[F_PAST], p[SPARE]):
        m[i, 0] = np.nan


@part
def fill(m: Array, p: Places, to: int, ago: int, observed: bool) -> None:
    """Fill phi without the columns of the present output, from the lags ``ago`` samples before it."""
    na, n_out, g = p[NA], p[N_OUT], p[G_PAST] + (1 - ago) * p[N_OUT]
    first, at = to + na, to + na + p[NB] + n_out - 1
    for i in range(p[INPUTS]):
        own = OWN + EACH * i
        nb, n_in = p[own + OWN_NB], p[own + OWN_N_IN]
        f = p[own + OWN_F] + (p[own + OWN_NK] - ago) * n_in
        for j in range(nb):
            m[first + j, 0] = -m[f + j * n_in, 0]
        first += nb
        for k in range(1, n_in):
            for j in range(nb):
                m[at + j, 0] = -m[f + j * n_in + k, 0]
            at += nb
    for k in range(n_out):
        start = to if k == 0 else at + (k - 1) * na
        for i in range(na):
            m[start + i, 0] = m[g + i * n_out + k, 0] if observed or i > 0 else np.nan
    for i in range(at + (n_out - 1) * na, to + p[N]):
        m[i, 0] = 1.0


@shared
def lose_output(m: Array, p: Places) -> None:
    """The newest output, which a row of regressors already contains, is missing: a tracker refused it."""
    at = p[NOW] + p[NA] + p[NB] + p[N_OUT] - 1
    for i in range(p[INPUTS]):
        own = OWN + EACH * i
        at += p[own + OWN_NB] * (p[own + OWN_N_IN] - 1)
    if p[NA] > 0:
        m[p[NOW], 0] = np.nan
        for k in range(p[N_OUT] - 1):
            m[at + k * p[NA], 0] = np.nan


@shared
def complete(m: Array, p: Places) -> bool:
    """Whether all lags are known."""
    at_d = p[NA] + p[NB]
    missing = 0
    for i in range(p[N]):
        if i < at_d or i >= at_d + p[N_OUT] - 1:
            missing += 0 if abs(m[p[NOW] + i, 0]) < LARGEST else 1
    return missing == 0

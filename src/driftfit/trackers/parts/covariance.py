"""Forecast and correction of theta and its covariance P by one sample, for trackers that carry both.

    forecast   y_hat = phi' theta;  e = y - y_hat;  g = P phi;  h = phi' g
    correct    theta <- theta + g e / (h + r);  P <- P - g g' / (h + r)

Only the lower triangle of P is kept. Source: Kalman (1960). Cost: O(n^2).
"""

from __future__ import annotations

from typing import Any

from driftfit.engine.kernel import State, kernel
from driftfit.engine.simd import (
    WIDTH,
    add_in_order,
    add_products,
    eight_at,
    eight_of,
    fill,
    in_blocks,
    minus,
    plus,
    put_eight,
    times,
)

LEFT = 1e-14
"""Smallest share of a variance that one sample leaves: below it the rest is rounding, which may be negative. It takes
a regressor ten million times as large as those before it."""


def rows_with(entry: Any) -> Any:
    """A kernel that fills s.g = P x row by row, for any number of lanes.

    Each loop does one thing, here and in `corrected`: the compiler unrolls a loop over parameters, and vectorises the
    loop over lanes around it, only while the body has at most some 300 / n instructions.
    """

    @kernel
    def rows(s: State, l: int) -> None:
        n = s.theta.shape[0]
        for i in range(n):
            g = -0.0  # to which adding changes nothing: the addition of 0.0 would remain
            for j in range(i + 1):
                g += s.P[i, j, l] * entry(s, j, l)
            s.g[i, l] = g
        for i in range(n):
            g = s.g[i, l]
            for j in range(i + 1, n):
                g += s.P[j, i, l] * entry(s, j, l)
            s.g[i, l] = g

    return rows


def blocks_with(entry: Any) -> Any:
    """A kernel that fills s.g = P x of one lane in blocks of eight columns, with the bits of `rows_with`.

    A block of eight rows and columns is read for its rows, whose sums are formed side by side, and for its columns.
    """

    @kernel
    def corner(s: State, first: int, last: int) -> None:
        for i in range(first, last):
            for j in range(first, i + 1):
                s.g[i, 0] += s.P[i, j, 0] * entry(s, j, 0)
        for i in range(first, last):
            for j in range(i + 1, last):
                s.g[i, 0] += s.P[j, i, 0] * entry(s, j, 0)

    @kernel
    def eight(s: State, j: int) -> Any:
        return eight_of((
            entry(s, j, 0), entry(s, j + 1, 0), entry(s, j + 2, 0), entry(s, j + 3, 0),
            entry(s, j + 4, 0), entry(s, j + 5, 0), entry(s, j + 6, 0), entry(s, j + 7, 0),
        ))  # fmt: skip

    @kernel
    def blocks(s: State) -> None:
        n, columns = s.theta.shape[0], s.P.shape[1]
        whole = n - n % WIDTH
        for i in range(n):
            s.g[i, 0] = -0.0
        for j in range(0, whole, WIDTH):
            corner(s, j, j + WIDTH)
            x, g = eight(s, j), eight_at(s.g, j)
            for i in range(j + WIDTH, whole, WIDTH):
                put_eight(s.g, i, add_products(eight_at(s.g, i), s.P, i * columns + j, columns, x))
                for k in range(i, i + WIDTH):
                    g = plus(g, times(eight_at(s.P, k * columns + j), fill(entry(s, k, 0))))
            for i in range(whole, n):
                row = eight_at(s.P, i * columns + j)
                s.g[i, 0] = add_in_order(s.g[i, 0], times(row, x))
                g = plus(g, times(row, fill(entry(s, i, 0))))
            put_eight(s.g, j, g)
        corner(s, whole, n)

    return blocks


def product_with(entry: Any) -> Any:
    """A kernel that fills s.g = P x from the lower triangle of P and returns x' P x, for x_i = entry(s, i, l).

    Entries of a row are added from the first column to the last, in lanes, in blocks and in C.
    """
    rows, blocks = rows_with(entry), blocks_with(entry)

    @kernel
    def product(s: State, l: int) -> float:
        n = s.theta.shape[0]
        if in_blocks(s):
            blocks(s)
        else:
            rows(s, l)
        total = -0.0
        for i in range(n):
            total += entry(s, i, l) * s.g[i, l]
        return total

    return product


@kernel
def regressor(s: State, i: int, l: int) -> float:
    """phi_i."""
    return s.phi[i, l]  # type: ignore[no-any-return]


symmetric_product = product_with(regressor)
"""s.g = P phi; returns phi' P phi."""


@kernel
def prediction(s: State, l: int) -> float:
    """phi' theta."""
    total = -0.0
    for i in range(s.theta.shape[0]):
        total += s.phi[i, l] * s.theta[i, l]
    return total


@kernel
def reduce_rows(s: State, gain: float, l: int) -> None:
    """P <- P - gain g g' with s.g, for any number of lanes."""
    for i in range(s.g.shape[0]):
        k = gain * s.g[i, l]
        for j in range(i):
            s.P[i, j, l] -= k * s.g[j, l]
        s.P[i, i, l] = max(s.P[i, i, l] - k * s.g[i, l], LEFT * s.P[i, i, l])


@kernel
def reduce_blocks(s: State, gain: float) -> None:
    """P <- P - gain g g' of one lane, with the bits of `reduce_rows`."""
    columns = s.P.shape[1]
    for i in range(s.g.shape[0]):
        # the variance is read before the row is written: afterwards it would wait for that
        k, variance = gain * s.g[i, 0], s.P[i, i, 0]
        whole = i - i % WIDTH
        for j in range(0, whole, WIDTH):
            at = i * columns + j
            put_eight(s.P, at, minus(eight_at(s.P, at), times(fill(k), eight_at(s.g, j))))
        for j in range(whole, i):
            s.P[i, j, 0] -= k * s.g[j, 0]
        s.P[i, i, 0] = max(variance - k * s.g[i, 0], LEFT * variance)


@kernel
def reduce_covariance(s: State, gain: float, l: int) -> None:
    """P <- P - gain g g' with s.g.

    Only one triangle is updated: P - outer(k, P phi) rounds asymmetrically, and forgetting lets the antisymmetric part
    grow until it ruins a run of ten thousand steps that looked healthy at five hundred.
    """
    if in_blocks(s):
        reduce_blocks(s, gain)
    else:
        reduce_rows(s, gain, l)


@kernel
def move(s: State, gain: float, e: float, l: int) -> None:
    """theta <- theta + gain g e with s.g."""
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += gain * s.g[i, l] * e


@kernel
def forecast(s: State, l: int) -> None:
    """y_hat = phi' theta, e = y - y_hat, g = P phi, h = phi' g; less than 0 is rounding."""
    y_hat = prediction(s, l)
    s.y_hat[l], s.e[l] = y_hat, s.y[l] - y_hat
    s.h[l] = max(symmetric_product(s, l), 0.0)


@kernel
def correct(s: State, l: int) -> None:
    """theta <- theta + g e / v,  P <- P - g g' / v,  with v = h + r noise, if the sample is used."""
    gain = s.ok[l] / (s.h[l] + s.r[l] * s.noise[l])
    move(s, gain, s.e[l], l)
    reduce_covariance(s, gain, l)

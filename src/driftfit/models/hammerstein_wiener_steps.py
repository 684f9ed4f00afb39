"""The compiled steps of `driftfit.models.hammerstein_wiener`.

The record keeps the functions of the last inputs and outputs, so that each is evaluated once; only a basis that depends
on its own coefficients is evaluated anew for all lags. The output is predicted from theta before the sample, by solving

    g_1(y) + sum_k d_k g_k(y) = -(phi' theta over all columns but those of the present output)

on a grid over the outputs seen so far, widened by a fifth; the grid is laid anew when an output leaves it. Where the
estimate does not increase, its monotone envelope (running maximum from the middle outwards, running minimum inwards) is
solved instead and ``RISING`` is 0; elsewhere Newton's method finishes what the grid began.

The work is done by two functions of one lane's arrays with bounds at run time. They are compiled once for each pair of
kinds of basis, whatever the orders: unrolled for every model they took longer to compile than the tracker.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.drivers import LARGEST, ModelSteps
from driftfit.kernel import Array, State, kernel, shared
from driftfit.models.arx import GAP
from driftfit.models.block_products import Structure
from driftfit.models.curves import Curves

GRID = 64
"""Points of the grid on which the output block is inverted."""
WIDER = 0.2
"""Share of the range of the outputs by which the grid goes beyond it, at both ends."""
NEWTON = 4
"""Steps after the grid: the first is good to 1e-3 of the range at least, and each doubles the digits."""
INSIDE = 0.97
"""Share of u_max within which the thresholds of a dead zone are held."""
EXACT = 4e-16
"""Relative error of the level at which Newton's method stops."""
FLOOR = 1e-4
"""Least variance of the equation error under measurement noise."""

# places in `cells`: the grid, what was seen, where the output block is defined, results, sigma^2 or 0
LOW, STEP, LOWEST, HIGHEST, BOTTOM, TOP, RISING, PREDICTED, STARTED, MINIMAL, GIVEN, RAW, VARIANCE = range(13)


def memory(
    structure: Structure, delay: int, into: Any, out: Any, limits: tuple[float, float], sigma: float | None
) -> dict[str, Any]:
    """Fields of the record; ``into`` and ``out`` are the numbers of the bases."""
    na, nb, n_in, n_out, _ = structure
    cells = np.zeros(13)
    cells[[LOWEST, HIGHEST, BOTTOM, TOP, RISING, PREDICTED]] = np.inf, -np.inf, *limits, 1.0, np.nan
    cells[VARIANCE] = 0.0 if sigma is None else sigma * sigma
    return {
        "f_lag": np.full((n_in, nb + delay), np.nan), "u_past": np.full(nb + delay, np.nan),
        "g_lag": np.full((n_out, max(na, 1)), np.nan), "h_lag": np.full((n_out, max(na, 1)), np.nan),
        "g_now": np.zeros(n_out), "h_now": np.zeros(n_out), "d_now": np.eye(1, n_out)[0], "f_now": np.zeros(n_in),
        "into": into, "out": out, "curve": np.zeros((n_out, GRID)), "level": np.zeros(GRID),
        "cells": cells,
    }  # fmt: skip


@shared
def past(theta: Array, phi: Array, d: Array, minimal: bool, na: int, nb: int, n_in: int, n_out: int) -> float:
    """-(phi' theta) without the columns of the present output; also fills d."""
    at_d = na + nb
    at_bc = at_d + n_out - 1
    at_ad = at_bc + nb * (n_in - 1)
    total = 0.0
    if not minimal:
        for k in range(n_out - 1):
            d[k + 1] = theta[at_d + k]
        for i in range(at_d):
            total -= theta[i] * phi[i]
        for i in range(at_bc, phi.shape[0]):
            total -= theta[i] * phi[i]
        return total
    x_c, x_d = na + nb, na + nb + n_in - 1
    for k in range(n_out - 1):
        d[k + 1] = theta[x_d + k]
    for i in range(na):
        column = phi[i]
        for k in range(n_out - 1):
            column += d[k + 1] * phi[at_ad + k * na + i]
        total -= theta[i] * column
    for j in range(nb):
        column = phi[na + j]
        for k in range(n_in - 1):
            column += theta[x_c + k] * phi[at_bc + k * nb + j]
        total -= theta[na + j] * column
    for i in range(x_d + n_out - 1, theta.shape[0]):
        total -= theta[i]
    return total


@shared
def envelope(d: Array, curve: Array, level: Array) -> bool:
    """Levels of the output block on the grid, made monotone; returns whether they were."""
    n_out, grid = curve.shape
    for i in range(grid):
        level[i] = curve[0, i]
    for k in range(1, n_out):
        for i in range(grid):
            level[i] += d[k] * curve[k, i]
    least = np.inf
    for i in range(grid - 1):
        least = min(least, level[i + 1] - level[i])
    if least > 0.0:
        return True
    for i in range(grid // 2, grid - 1):
        level[i + 1] = max(level[i + 1], level[i])
    for i in range(grid // 2, 0, -1):
        level[i - 1] = min(level[i - 1], level[i])
    return False


@shared
def noise_factor(theta: Array, d: Array, slopes: Array, lagged: Array, na: int, n_out: int, variance: float) -> float:
    """sigma^2 sum_i a_i^2 F'(y_(t-i))^2 + floor, a_0 = 1, from the estimates before the sample."""
    total = 0.0
    for i in range(na + 1):
        slope = 0.0
        for k in range(n_out):
            slope += d[k] * (slopes[k] if i == 0 else lagged[k, i - 1])
        weight = 1.0 if i == 0 else theta[i - 1]
        total += weight * weight * slope * slope
    factor = variance * total + FLOOR
    return factor if factor < LARGEST else 1.0


def _named(function: Any, *parts: Any) -> Any:
    """A shared function whose place on disk is its own: closures of one name would share an index."""
    function.__qualname__ += "_" + "_".join(str(part.identity)[:12] for part in parts)
    return shared(function)


@lru_cache
def inverse_of(out: Curves) -> Any:
    """A shared function that inverts the output block on the grid."""
    g, slopes = out.values, out.slopes

    def solve(
        right: float, g_now: Array, h_now: Array, d_now: Array, numbers: Array, curve: Array, level: Array,
        cells: Array,
    ) -> float:  # fmt: skip
        """The output at which the estimated output block has the value ``right``, within the grid."""
        if not (cells[STEP] > 0.0 and abs(right) < LARGEST):
            return np.nan
        n_out, grid = curve.shape
        rising = envelope(d_now, curve, level)
        cells[RISING] = 1.0 if rising else 0.0
        if right < level[0]:
            return float(cells[LOW])
        if right >= level[grid - 1]:
            return float(cells[LOW] + (grid - 1) * cells[STEP])
        below, above = 0, grid - 1
        while above - below > 1:
            middle = (below + above) // 2
            if level[middle] <= right:
                below = middle
            else:
                above = middle
        low = cells[LOW] + below * cells[STEP]
        high = low + cells[STEP]
        y = low + cells[STEP] * (right - level[below]) / (level[below + 1] - level[below])
        if rising:
            for _ in range(NEWTON):
                g(y, numbers, g_now)
                slopes(y, numbers, h_now)
                value, slope = 0.0, 0.0
                for k in range(n_out):
                    value += d_now[k] * g_now[k]
                    slope += d_now[k] * h_now[k]
                if not slope > 0.0 or abs(right - value) <= EXACT * (1.0 + abs(right)):
                    break
                y = min(max(y + (right - value) / slope, low), high)
        return float(y)

    return _named(solve, g, slopes)


@lru_cache
def _lane_steps(into: Curves, out: Curves) -> tuple[Any, Any]:
    """``regress`` and ``push`` of one lane, for one pair of kinds of basis."""
    f, g, slopes = into.values, out.values, out.slopes
    inverse = inverse_of(out)

    def lane_regress(
        u: float, y: float, dt: float, orders: tuple[int, int, int, int, int], theta: Array,
        phi: Array, f_lag: Array, u_past: Array, g_lag: Array, h_lag: Array, g_now: Array, h_now: Array, d_now: Array,
        f_now: Array, into: Array, out: Array, curve: Array,
        level: Array, cells: Array,
    ) -> tuple[float, float, float]:  # fmt: skip
        """Fill phi; returns (z, dt, factor of the noise variance)."""
        na, nb, nk, linear, adaptive = orders
        n_in, n_out, depth = f_lag.shape[0], g_lag.shape[0], u_past.shape[0]
        at_d = na + nb
        at_bc = at_d + n_out - 1
        at_ad = at_bc + nb * (n_in - 1)
        if dt > GAP:
            for j in range(depth):
                u_past[j] = np.nan
                for k in range(n_in):
                    f_lag[k, j] = np.nan
            for i in range(g_lag.shape[1]):
                for k in range(n_out):
                    g_lag[k, i] = np.nan
        for j in range(depth - 1, 0, -1):
            u_past[j] = u_past[j - 1]
            for k in range(n_in):
                f_lag[k, j] = f_lag[k, j - 1]
        u_past[0] = u
        for j in range(depth if adaptive > 0 else 1):
            f(u_past[j], into, f_now)
            for k in range(n_in):
                f_lag[k, j] = f_now[k]
        started = 1.0
        for j in range(nb):
            phi[na + j] = -f_lag[0, nk + j]
            for k in range(n_in - 1):
                phi[at_bc + k * nb + j] = -f_lag[k + 1, nk + j]
        for i in range(na):
            phi[i] = g_lag[0, i]
            for k in range(n_out - 1):
                phi[at_ad + k * na + i] = g_lag[k + 1, i]
        for i in range(at_ad + na * (n_out - 1), phi.shape[0]):
            phi[i] = 1.0
        for i in range(phi.shape[0]):
            if i < at_d or i >= at_bc:
                started = started if abs(phi[i]) < LARGEST else cells[STARTED]
        cells[STARTED] = started
        right = past(theta, phi, d_now, cells[MINIMAL] > 0.0, na, nb, n_in, n_out)
        if linear > 0:
            cells[PREDICTED] = right
        else:
            cells[PREDICTED] = inverse(right, g_now, h_now, d_now, out, curve, level, cells)
        seen = abs(y) < LARGEST
        point = y if seen else cells[PREDICTED]
        g(point, out, g_now)
        variance = cells[VARIANCE]
        if variance > 0.0:
            slopes(point, out, h_now)
        for k in range(n_out):
            seen = seen and abs(g_now[k]) < LARGEST
        for k in range(n_out - 1):
            phi[at_d + k] = g_now[k + 1]
        cells[RAW] = y if seen else np.nan
        if seen:
            cells[LOWEST] = min(cells[LOWEST], y)
            cells[HIGHEST] = max(cells[HIGHEST], y)
        factor = noise_factor(theta, d_now, h_now, h_lag, na, n_out, variance) if variance > 0.0 else 1.0
        return -g_now[0] if seen else np.nan, dt if started > 0.0 else 0.0, factor

    def lane_push(
        seen: bool, ok: bool, orders: tuple[int, int, int, int, int], theta: Array, g_lag: Array, h_lag: Array,
        g_now: Array, h_now: Array, into: Array, out: Array, curve: Array, cells: Array, n_in: int,
    ) -> None:  # fmt: skip
        """The present output among the lags (a missing one stays missing), thresholds, and the grid."""
        na, nb, _, linear, adaptive = orders
        n_out, grid = curve.shape
        for k in range(n_out):
            for i in range(g_lag.shape[1] - 1, 0, -1):
                g_lag[k, i] = g_lag[k, i - 1]
                h_lag[k, i] = h_lag[k, i - 1]
            g_lag[k, 0] = g_now[k] if seen else np.nan
            h_lag[k, 0] = h_now[k]
        if adaptive > 0 and ok:
            x_c, at_bc = na + nb, na + nb + n_out - 1
            for k in range(2):
                total, size = 0.0, 0.0
                for j in range(nb):
                    size += theta[na + j] * theta[na + j]
                    total += theta[na + j] * theta[at_bc + k * nb + j] if cells[MINIMAL] == 0.0 else 0.0
                threshold = total / size if cells[MINIMAL] == 0.0 else theta[x_c + k]
                if abs(threshold) < LARGEST:
                    top, bottom = INSIDE * into[3] * (1 - k), -INSIDE * into[3] * k
                    into[1 + k] = min(max(threshold, bottom), top)
        if linear == 0 and cells[LOWEST] <= cells[HIGHEST]:
            last = cells[LOW] + (grid - 1) * cells[STEP]
            short = cells[LOWEST] < cells[LOW] and cells[LOW] > cells[BOTTOM]
            if cells[STEP] == 0.0 or short or (cells[HIGHEST] > last and last < cells[TOP]):
                width = cells[HIGHEST] - cells[LOWEST]
                margin = WIDER * (width if width > 0.0 else max(abs(cells[HIGHEST]), 1.0))
                cells[LOW] = max(cells[LOWEST] - margin, cells[BOTTOM])
                cells[STEP] = (min(cells[HIGHEST] + margin, cells[TOP]) - cells[LOW]) / (grid - 1)
                for i in range(grid):
                    g(min(cells[LOW] + i * cells[STEP], cells[TOP]), out, h_now)
                    for k in range(n_out):
                        curve[k, i] = h_now[k]

    return _named(lane_regress, f, g, slopes), _named(lane_push, g)


@lru_cache
def build(structure: Structure, nk: int, into: Curves, out: Curves, linear: bool, adaptive: bool) -> ModelSteps:
    """The steps of one structure; ``linear`` says that the output block is the identity."""
    na, nb, n_in, _, _ = structure
    lane_regress, lane_push = _lane_steps(into, out)
    orders = (na, nb, nk, int(linear), int(adaptive))

    @kernel
    def regress(s: State, l: int) -> None:
        s.cells[GIVEN, l] = s.noise[l]
        s.y[l], s.dt[l], factor = lane_regress(
            s.u[0, l], s.y[l], s.dt[l], orders, s.theta[:, l], s.phi[:, l], s.f_lag[:, :, l],
            s.u_past[:, l], s.g_lag[:, :, l], s.h_lag[:, :, l], s.g_now[:, l], s.h_now[:, l], s.d_now[:, l],
            s.f_now[:, l], s.into[:, l], s.out[:, l],
            s.curve[:, :, l], s.level[:, l], s.cells[:, l],
        )  # fmt: skip
        s.noise[l] *= factor

    @kernel
    def push(s: State, l: int) -> None:
        s.noise[l] = s.cells[GIVEN, l]
        s.y_hat[l] = s.cells[PREDICTED, l]
        lane_push(
            s.seen[l] > 0.0, s.ok[l] > 0.0, orders, s.theta[:, l], s.g_lag[:, :, l], s.h_lag[:, :, l],
            s.g_now[:, l], s.h_now[:, l], s.into[:, l], s.out[:, l], s.curve[:, :, l], s.cells[:, l], n_in,
        )  # fmt: skip

    return ModelSteps(regress, push)

"""The fast path of the exact smoother: elimination of one increment at a time, a refinement, and a test of both.

For a diagonal q, with U, z the information on theta_t (U theta = z), the increment of parameter i before sample t has
variance g = q_i drift_t drift_root_ti^2, and leaves

    f = 1 / (1 + g U_ii);   a_i = f,  a_j = -g f U_ji;   b = g f z_i
    U_jk <- U_jk + a_j U_ik,  U_ij <- f U_ij;   z_j <- z_j + a_j z_i,  z_i <- f z_i          forwards
    theta_i <- a' theta + b;   C_ii <- a' C a + g f,  C_ij <- (C a)_j                        backwards

between which the sample adds w phi phi' to U and w phi y to z. This is the recursion of flexible least squares,
theta_t = e_t + M_t theta_{t+1}, with M_t as a product of n steps, so O(n^2) for means and no matrix to invert.

Refinement: the same a, with the residuals of the path instead of y and its increments x as known shifts (z_i + x_i / g
instead of z_i), gives the correction delta, whose size estimates the error of the path before it.

The result is accepted if delta is small, no step cancelled more than six digits (f), and no sample has a leverage so
close to 1 that its leave-one-out residual is lost. Otherwise `driftfit.smooth.parts.two_filters` solves the problem;
drift far above the noise and collinear regressors fail the test.

Sources: Kalaba and Tesfatsion (1989); Wilkinson (1963) for refinement. Cost: O(T n^3), mostly means at O(T n^2).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.smooth.parts.walk import Path, Walk

Y, WEIGHT, DRIFT = 0, 1, 2
"""Columns of the samples."""

CORRECTION = 1e-10
"""Largest correction, relative to the largest value of the parameter."""

CANCELLED = 1e-6
"""Smallest f: below it U has lost more than six digits in one step."""

LEVERAGE = 1e-5
"""Smallest 1 - h: below it 1 - h has lost more than five digits."""


def smooth(walk: Walk) -> Path | None:
    """Solve a problem with a diagonal q and a diffuse start of full rank; None if the result is not accurate enough."""
    solved = smooth_and_weigh(walk)
    return None if solved is None else solved[0]


def smooth_and_weigh(walk: Walk) -> tuple[Path, float] | None:
    """The same, and the log of the diffuse likelihood of y given q, drift and weights, up to a constant.

    With U after the last sample, -2 log L = J + log |U| - sum log f, since each f is 1 / (1 + g U_ii).
    """
    T, n = walk.phi.shape
    work = workspace(n).copy()
    work["q"] = np.diag(walk.q)
    steps, samples = np.empty(T, step_type(n)), np.stack([walk.y, walk.weight, walk.drift], axis=1)
    drift_root = np.ascontiguousarray(walk.drift_root if len(walk.drift_root) else np.ones((1, n)))
    least = forwards(work, walk.phi, samples, drift_root, steps)
    C = inverse(work["U"][0])
    if C is None or least < CANCELLED:
        return None
    pivots = np.einsum("tii->ti", steps["a"])
    volume = float(np.linalg.slogdet(work["U"][0])[1]) - float(np.sum(np.log(pivots)))
    work["C"], work["theta"] = C, C @ work["z"][0]
    theta, var, left = np.empty((T, n)), np.empty((T, n)), np.empty(T)
    backwards(work, walk.phi, samples, drift_root, steps, theta, var, left)
    cost = residuals(work, walk.phi, samples, drift_root, steps, theta)
    work["theta"] = C @ work["z"][0]
    correct(work, steps, theta)
    correction = work["correction"][0] / np.maximum(work["size"][0], 1e-300)
    if not (correction.max() <= CORRECTION and left.min() > LEVERAGE and var.min() > 0.0):
        return None
    c, empty = np.sqrt(left), np.zeros((0, n, n))
    rho = np.where(walk.weight > 0.0, np.sqrt(walk.weight) * walk.residual(theta) / c, np.nan)
    return Path(theta, var, rho, c, cost, empty, empty, "fast"), -0.5 * (cost + volume)


def inverse(U: Array) -> Array | None:
    """U^-1 after scaling its diagonal to 1; None if U is numerically singular."""
    size = np.sqrt(np.diag(U))
    if not (size > 0.0).all():
        return None
    cross = np.outer(size, size)
    try:
        C: Array = np.linalg.inv(U / cross) / cross
    except np.linalg.LinAlgError:
        return None
    return C


@lru_cache
def workspace(n: int) -> Array:
    """Scratch space, to be copied; it is a record so that the compiler knows n."""
    square, vector = (np.float64, (n, n)), (np.float64, (n,))
    vectors = ("z", "theta", "v", "correction", "size", "q")
    return np.zeros(1, np.dtype([("U", *square), ("C", *square), *((name, *vector) for name in vectors)]))


def step_type(n: int) -> np.dtype[Any]:
    """The elimination of the n increments before a sample: a and b of each."""
    return np.dtype([("a", np.float64, (n, n)), ("b", np.float64, (n,))])


@Driver
def forwards(work: Array, phi: Array, samples: Array, drift_root: Array, steps: Array) -> float:
    """Eliminate every increment; leaves the last U and z in the scratch space and returns the smallest f."""
    s = work[0]
    n = s.z.shape[0]
    many = 1 if drift_root.shape[0] > 1 else 0
    least = 1.0
    for t in range(phi.shape[0]):
        a, b = steps[t].a, steps[t].b
        for i in range(n):
            g = s.q[i] * samples[t, DRIFT] * drift_root[t * many, i] ** 2
            f = 1.0 / (1.0 + g * s.U[i, i])
            least = min(least, f)
            for j in range(n):
                s.v[j] = -g * f * s.U[i, j]
            s.v[i] = f
            z = s.z[i]
            for j in range(n):
                a[i, j] = s.v[j]
                s.z[j] = (s.z[j] if j != i else 0.0) + s.v[j] * z
            b[i] = g * f * z
            for j in range(n):
                if j != i:
                    for k in range(j + 1):
                        if k != i:
                            s.U[j, k] += s.v[j] * s.U[i, k]
                            s.U[k, j] = s.U[j, k]
            for j in range(n):
                s.U[i, j] *= f
                s.U[j, i] = s.U[i, j]
        w = samples[t, WEIGHT]
        for j in range(n):
            for k in range(n):
                s.U[j, k] += w * phi[t, j] * phi[t, k]
            s.z[j] += w * phi[t, j] * samples[t, Y]
    return least


@Driver
def backwards(
    work: Array, phi: Array, samples: Array, drift_root: Array, steps: Array, theta: Array, var: Array, left: Array
) -> None:
    """theta, variances and 1 - leverage, from the last theta and C in the scratch space."""
    s = work[0]
    n = s.z.shape[0]
    many = 1 if drift_root.shape[0] > 1 else 0
    for t in range(phi.shape[0] - 1, -1, -1):
        a, b = steps[t].a, steps[t].b
        h = 0.0
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += s.C[j, k] * phi[t, k]
            h += phi[t, j] * total
            theta[t, j] = s.theta[j]
            var[t, j] = s.C[j, j]
        left[t] = 1.0 - samples[t, WEIGHT] * h
        for i in range(n - 1, -1, -1):
            x = b[i]
            for j in range(n):
                x += a[i, j] * s.theta[j]
            s.theta[i] = x
            own = s.q[i] * samples[t, DRIFT] * drift_root[t * many, i] ** 2 * a[i, i]
            for j in range(n):
                total = 0.0
                for k in range(n):
                    total += s.C[j, k] * a[i, k]
                s.v[j] = total
            for j in range(n):
                own += a[i, j] * s.v[j]
            for j in range(n):
                s.C[i, j] = s.v[j]
                s.C[j, i] = s.v[j]
            s.C[i, i] = own


@Driver
def residuals(work: Array, phi: Array, samples: Array, drift_root: Array, steps: Array, theta: Array) -> float:
    """The forward pass of the refinement: b of the residuals; returns the cost of the path."""
    s = work[0]
    n = s.z.shape[0]
    many = 1 if drift_root.shape[0] > 1 else 0
    cost = 0.0
    for i in range(n):
        s.z[i] = 0.0
    for t in range(phi.shape[0]):
        a, b = steps[t].a, steps[t].b
        for i in range(n):
            g = s.q[i] * samples[t, DRIFT] * drift_root[t * many, i] ** 2
            x = theta[t, i] - theta[t - 1, i] if t > 0 else 0.0
            shift = x / g if g > 0.0 else 0.0
            cost += x * shift
            z = s.z[i] + shift
            b[i] = g * a[i, i] * z
            for j in range(n):
                s.z[j] = (s.z[j] if j != i else -shift) + a[i, j] * z
        e = samples[t, Y]
        for j in range(n):
            e -= phi[t, j] * theta[t, j]
        cost += samples[t, WEIGHT] * e * e
        for j in range(n):
            s.z[j] += samples[t, WEIGHT] * phi[t, j] * e
    return cost


@Driver
def correct(work: Array, steps: Array, theta: Array) -> None:
    """The backward pass of the refinement: adds the correction to theta and stores the sizes of both."""
    s = work[0]
    n = s.z.shape[0]
    for i in range(n):
        s.correction[i] = s.size[i] = 0.0
    for t in range(theta.shape[0] - 1, -1, -1):
        a, b = steps[t].a, steps[t].b
        for i in range(n):
            theta[t, i] += s.theta[i]
            s.correction[i] = max(s.correction[i], abs(s.theta[i]))
            s.size[i] = max(s.size[i], abs(theta[t, i]))
        for i in range(n - 1, -1, -1):
            x = b[i]
            for j in range(n):
                x += a[i, j] * s.theta[j]
            s.theta[i] = x

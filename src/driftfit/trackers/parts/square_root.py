"""The Kalman filter of a random walk on square roots of information: positive by construction.

    predict   theta <- theta + diag(d)^(1/2) G w sqrt(dt), G G' = q    spread
    correct   (phi' theta = y) / sqrt(r / w)                      absorb;  theta = S^-1 d,  P = S^-1 S^-T
              s = |S^-T phi|^2 + r / w,  e = y - phi' theta       with S before the sample

Use it through ``Kalman(form="sqrt")``. The diffuse start (`driftfit.trackers.parts.diffuse`) is in this form too. The
rotations are in `driftfit.trackers.parts.information`.

Source: Bierman (1977), chapter 6. Cost per sample: O(n^3).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.drivers import TrackerSteps, diagonal
from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.parts.diffuse import drifted, scale_drift, spanned_variance, take_in
from driftfit.trackers.parts.faults.contradictions import add_to_block
from driftfit.trackers.parts.faults.judged_start import judged
from driftfit.trackers.parts.information import absorb, invert, solve, spread, triangular_root
from driftfit.trackers.parts.varying_drift import read_drift


def state(theta0: Array, p0: Array | None) -> Mapping[str, Any]:
    """Further fields of the square-root form."""
    from scipy import linalg  # a fifth of a second to import

    n = len(theta0)
    S = np.zeros((n, n)) if p0 is None else linalg.solve_triangular(triangular_root(p0), np.eye(n))
    return {"S": S, "d": S @ theta0, "row": np.zeros(n), "x": np.zeros(n)}


@kernel
def grow(s: State, l: int) -> None:
    scale_drift(s, l)
    spread(s.S, s.d, s.H, np.sqrt(s.dt[l] * s.drift[l]), s.pivot, l)


@kernel
def rotate_in(s: State, l: int) -> None:
    """Absorb the sample, if there is one."""
    root = np.sqrt(s.ok[l] / (s.r[l] * s.noise[l]))
    for i in range(s.theta.shape[0]):
        s.row[i, l] = root * s.phi[i, l]
    absorb(s.S, s.d, s.row, root * s.y[l], l)


@kernel
def read_out(s: State, l: int) -> None:
    """theta, which only a sample moves, and the lower triangle of P."""
    n = s.theta.shape[0]
    solve(s.S, s.d, s.row, l)
    for i in range(n):
        s.theta[i, l] = s.row[i, l] if s.ok[l] > 0.0 else s.theta[i, l]
    invert(s.S, s.R, l)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += s.R[i, k, l] * s.R[j, k, l]
            s.P[i, j, l] = total


@kernel
def innovation_variance(s: State, l: int) -> float:
    """|S^-T phi|^2."""
    total = 0.0
    for i in range(s.theta.shape[0]):
        t = s.phi[i, l]
        for j in range(i):
            t -= s.S[j, i, l] * s.x[j, l]
        s.x[i, l] = t / s.S[i, i, l]
        total += s.x[i, l] * s.x[i, l]
    return total


@kernel
def correct(s: State, l: int) -> None:
    s.s[l] = innovation_variance(s, l) + s.r[l] * s.noise[l]
    add_to_block(s, s.e[l] * s.e[l] / s.s[l], l)
    rotate_in(s, l)
    read_out(s, l)


@kernel
def begin(s: State, l: int) -> None:
    drifted(s, s.dt[l] * s.drift[l], l)
    take_in(s, l)
    spanned_variance(s, l)
    s.root[l] = 1 if s.rank[l] < s.theta.shape[0] else 0


STEPS = judged(begin, TrackerSteps(grow, correct, diagonal, read_extra=read_drift), variance=innovation_variance)

"""Piecewise constant parameters: least squares on each segment between two changes.

    theta_k = argmin sum_{t in segment k} w_t (y_t - phi_t' theta)^2,   cov = r (Phi' W Phi)^-1

This is the limit of the smoother with given events as the covariance of a jump grows and that of the drift vanishes.
Changes come from a `Bank`, or from the user; samples at which a bank detects a sensor fault are left out. r is pooled
over the segments unless it is given. A segment that does not determine a direction takes the minimum-norm solution
there, and its std is inf.

Use it if parameters are constant between changes and the segments are of interest. Cost: O(T n^2).
"""

from __future__ import annotations

from itertools import pairwise
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.bank.results.results import Hypotheses
from driftfit.bank.results.smoothed import faulty
from driftfit.engine.kernel import Array
from driftfit.run.result import Track
from driftfit.show.axes import BLUE, GREY, date_axis, frame, panels, settled, time_label
from driftfit.smooth.problem import replay
from driftfit.smooth.solvers.rank import column_sizes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Segments:
    """Segments of a record with constant parameters.

    ``bounds`` (k + 1,): segment j goes from ``bounds[j]`` to ``bounds[j + 1]``, without the end; ``theta``, ``std``
    (k, n); ``covs`` (k, n, n); ``used`` (k,) samples; ``r`` the noise variance.
    """

    def __init__(self, run: Track, breaks: Any = None, r: float | None = None) -> None:
        if breaks is None:
            breaks = [event.span.date for event in Hypotheses(run).events() if event.kind == "change"]
        T = len(run)
        inner = sorted({int(b) for b in breaks})
        if inner and not 0 < inner[0] <= inner[-1] < T:
            raise ValueError(f"piecewise: breaks must be samples within 1 .. {T - 1}; got {inner}.")
        self.run, self.names, self.bounds = run, run.names, np.array([0, *inner, T])
        replayed = replay(run)
        known = replayed["ok"][:, 0] > 0.0
        if run.tracker.weighs:  # samples with a sensor fault carry no information about the segment
            known &= ~faulty(run, Hypotheses(run).found())
        phi, y, weight = replayed["phi"][..., 0], replayed["y"][:, 0], 1.0 / replayed["used_noise"][:, 0]
        thetas, covs, used, rest, free = [], [], [], 0.0, 0
        for a, b in zip(self.bounds[:-1], self.bounds[1:], strict=True):
            rows = np.flatnonzero(known[a:b]) + a
            root = np.sqrt(weight[rows])
            A, d = phi[rows] * root[:, None], y[rows] * root
            size = column_sizes(A, np.sum)
            A /= size
            U, long, axes = np.linalg.svd(A, full_matrices=False)
            rank = int(np.sum(long > np.finfo(float).eps * max(A.shape) * long.max(initial=0.0)))
            U, axes = U[:, :rank], axes[:rank].T
            roots = axes / long[:rank]  # the moments A' A would have half of the digits
            theta = roots @ (U.T @ d)
            thetas.append(theta / size)
            cov = roots @ roots.T / np.outer(size, size)
            loose = np.sum(axes * axes, axis=1) < 1.0 - 1e-9
            cov[loose, loose] = np.inf
            covs.append(cov)
            rest += float(np.sum((d - A @ theta) ** 2))
            free += len(rows) - int(rank)
            used.append(len(rows))
        self.r = r if r is not None else rest / free if free > 0 else float("nan")
        self.theta, self.covs, self.used = np.array(thetas), self.r * np.array(covs), np.array(used)

    @property
    def std(self) -> Array:
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.covs)))

    @property
    def path(self) -> Array:
        """(T, n)"""
        return np.repeat(self.theta, np.diff(self.bounds), axis=0)

    def table(self) -> Any:
        """One row per segment, as a polars table: start, end, samples, parameters and their standard deviations."""
        import polars as pl

        columns: dict[str, Any] = {"start": self.bounds[:-1], "end": self.bounds[1:] - 1, "samples": self.used}
        for i, name in enumerate(self.names):
            columns |= {name: self.theta[:, i], f"std_{name}": self.std[:, i]}
        return pl.DataFrame(columns)

    def plot(self, level: float = 0.95, ax: Any = None) -> Figure:
        """Parameters of the segments with bands, over the tracked path. ``ax`` as for `Track.plot`."""
        run, n = self.run, len(self.names)
        figure, axes = panels(ax, (9.0, 1.7 * n + 0.8), n, sharex=True)
        half = NormalDist().inv_cdf(0.5 + level / 2.0) * self.std
        for i, axis in enumerate(axes):
            axis.plot(run.time, run.theta[:, i], color=GREY, lw=0.8, label="tracked")
            for k, (a, b) in enumerate(pairwise(self.bounds.tolist())):
                reach, value = run.time[[a, b - 1]], self.theta[k, i]
                axis.plot(reach, [value, value], color=BLUE, lw=1.6, label="segment" if k == 0 else None)
                if np.isfinite(half[k, i]):
                    axis.fill_between(reach, value - half[k, i], value + half[k, i], color=BLUE, alpha=0.2, lw=0)
            low, high = self.theta[:, i] - half[:, i], self.theta[:, i] + half[:, i]
            frame(axis, np.concatenate([low, high, run.theta[settled(run), i]]))
            axis.set_ylabel(run.names[i])
            axis.grid(alpha=0.25, lw=0.5)
        axes[0].legend(loc="best", fontsize=8, ncols=2, frameon=False)
        axes[-1].set_xlabel(time_label(run))
        date_axis(axes[-1], run)
        return figure


def piecewise(run: Track, breaks: Any = None, r: float | None = None) -> Segments:
    """Segments between ``breaks``: the first samples of new segments, or the changes that a bank found."""
    return Segments(run, breaks, r)

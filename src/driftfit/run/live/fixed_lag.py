"""Fixed-lag smoothing: estimates of the last few samples of a stream from past and future, in constant memory.

A window contains the last ``lag`` + 1 samples. A square-root information filter
(`driftfit.trackers.forms.information`) holds the information of all samples before the window. Smoothing the window
from there is exact: row 0 equals the smoother of the whole record that ends now.

Cost: one step of the filter per sample, O(n^3), and one exact smoothing of the window, O(lag n^3), per call.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.data.storage import fields
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.smooth.solvers import slopes, two_filters
from driftfit.smooth.solvers.walk import Walk, room_for_signals
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.information import triangular_root

SAMPLES = ("phi", "y", "weight", "drift", "drift_root", "trend")
"""What is saved of the samples of a window."""
ARRAYS = ("phi", "signals", "drift_root", "trend")
"""The arrays in which they are stored."""


class FixedLag(NamedTuple):
    """The samples of the window, oldest first."""

    theta: Array
    """(k, n), k = lag + 1 once that many samples have been observed."""
    std: Array
    """(k, n): inf for parameters that are not determined yet."""


class Window:
    """The last ``lag`` + 1 samples of a stream, and the information from earlier samples."""

    def __init__(self, model: Model, tracker: Tracker, lag: int) -> None:
        if model.implicit and model.implicit.noise_varies:
            raise ValueError(
                "Live: lag= does not support the output_noise of a model; smooth the record, or leave output_noise out."
            )
        prior = tracker.random_walk(model)
        n, r = model.n, 1.0 if prior.r is None else prior.r
        p0 = None if prior.p0 is None else prior.p0 / r
        self.walk = Walk(
            np.zeros((lag + 1, n)), room_for_signals(lag + 1, n), prior.q / r, prior.theta0, p0, prior.r,
            np.ones((lag + 1, n)), np.zeros((lag + 1) * prior.slopes),
        )  # fmt: skip
        G = triangular_root(self.walk.q)
        self.G = slopes.root(G) if prior.slopes else G
        self.count = 0
        self.drifts = not prior.at_first_sample and p0 is not None
        self.before = two_filters.workspace(len(self.G), 2).copy()
        self.before["G"] = self.G[:, :, None]
        if p0 is not None:
            begin = two_filters.start(self.walk, np.ones(n), np.eye(n))
            self._filter(0, begin.rows, begin.values)

    def _filter(self, count: int, rows: Array, values: Array) -> None:
        """Update the earlier information by the first ``count`` samples of the window."""
        scratch = np.zeros(1, two_filters.block_type(len(self.G)))
        self.before["S"][..., 1] = self.before["d"][..., 1] = 0.0
        two_filters.filter_both(self.before, self._first(count), rows, values, scratch)

    def _first(self, count: int) -> Walk:
        """The smoothing problem of the first ``count`` samples of the window."""
        walk = self.walk._replace(**{name: getattr(self.walk, name)[:count] for name in ARRAYS})
        return slopes.expanded(walk) if len(self.walk.trend) else walk

    def push(self, tile: Array, known: tuple[float, float, float], lane: int = 0) -> None:
        """Add the sample that a lane of the tile has just processed; ``known`` are its known factors."""
        s, walk = tile[0], self.walk
        if self.count == len(walk.y):
            self._filter(1, np.zeros((0, len(self.G))), np.zeros(0))
            for name in ARRAYS:
                values = getattr(walk, name)
                values[:-1] = values[1:]
            self.count -= 1
        k, dt = self.count, float(s["dt"][lane])
        _, noise, factor = known
        walk.phi[k], walk.y[k] = s["phi"][:, lane], s["y"][lane]
        # the noise variance may move, and then r is its last estimate; otherwise the ratio is 1
        walk.weight[k] = s["ok"][lane] / noise * ((1.0 if walk.r is None else walk.r) / s["r"][lane])
        walk.drift[k] = dt * factor if self.drifts else 0.0
        walk.drift_root[k] = s["drift_root"][:, lane] if "drift_root" in fields(tile) else 1.0
        walk.trend[k : k + 1] = dt if self.drifts else 0.0
        self.drifts = self.drifts or dt > 0.0
        self.count += 1

    def smooth(self, tile: Array, lane: int = 0) -> FixedLag:
        """Smooth the window; a lane of the tile gives the directions that are determined, and the noise variance."""
        N, walk = len(self.G), self._first(self.count)
        rows, values = self.before["S"][0, ..., 0], self.before["d"][0, :, 0]
        hidden = np.zeros(N, bool)
        if tile["rank"][0, lane] < N:
            vectors = np.triu(tile["R"][0, ..., lane])[:, np.diagonal(tile["S"][0, ..., lane]) == 0.0]
            tau = float(tile["tau"][0, lane]) if len(walk.trend) else 0.0
            if len(walk.trend):  # the vectors refer to now, and theta0 to the first sample
                vectors[: N // 2] -= tau * vectors[N // 2 :]
            unseen = two_filters.unspanned(vectors, np.ones(N))
            values = np.append(values, unseen @ walk.theta0)
            hidden = two_filters.undetermined(unseen)
            if len(walk.trend):
                time = tau + np.cumsum(walk.trend) - walk.trend.sum()
                hidden = slopes.undetermined(unseen, time)
                unseen = slopes.moved(unseen, float(time[0]))
            rows = np.vstack([rows, unseen])
        path, _ = two_filters.meeting(walk, self.G, rows, values)
        r, n = float(tile["scale"][0, lane]) if walk.r is None else walk.r, self.walk.phi.shape[1]
        var = np.where(hidden, np.inf, path.var)
        return FixedLag(path.theta[:, :n], np.sqrt(r * var[:, :n]))

    def plain(self) -> dict[str, Any]:
        """The state as plain data."""
        arrays = {name: getattr(self.walk, name) for name in SAMPLES}
        arrays |= {name: self.before[name][0, ..., 0] for name in ("S", "d")}
        return {"count": self.count, "drifts": self.drifts, **{name: array.tolist() for name, array in arrays.items()}}

    def restore(self, state: dict[str, Any]) -> None:
        """The inverse of `plain`."""
        self.count, self.drifts = state["count"], state["drifts"]
        for name in SAMPLES:
            getattr(self.walk, name)[...] = state[name]
        for name in ("S", "d"):
            self.before[name][0, ..., 0] = state[name]

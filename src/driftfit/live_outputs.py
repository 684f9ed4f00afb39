"""Streams with several outputs: the same steps as `driftfit.outputs`, one sample at a time, bit for bit."""

from __future__ import annotations

from os import PathLike
from typing import Any, Self

import numpy as np

from driftfit import storage
from driftfit.drivers import drivers, known_factors, output_type
from driftfit.kernel import Array
from driftfit.models.base import Model
from driftfit.outputs import joint_tile, row_model
from driftfit.settings import whole
from driftfit.signals import as_numbers, check_ready, factor, interval_of, noise_of
from driftfit.trackers.base import Tracker

Steps = tuple[Array, Array, Array, Array]
"""(y_hat, e, s, ok), each (ny,)."""


class LiveOutputs:
    """Track a stream with several outputs; what `Live` gives for a model with ``ny`` above 1.

    ``theta`` and ``std`` are (ny, n), or (n,) where the outputs share one theta. Times, weights and drifts are those of
    `Live`.
    """

    def __init__(self, model: Model, tracker: Tracker, dt: Any = None, lag: int = 0) -> None:
        if whole("Live", "lag", lag, 0):
            raise ValueError("Live: lag= is for single outputs.")
        self.model = model if model.shared else model.bind(model.m)
        self.tracker = check_ready(tracker)
        self.dt = dt
        self._last: Any = None
        self._ignored = 0
        self._rows = row_model(self.model, tracker) if self.model.shared else self.model
        self._tile = joint_tile(self._rows, tracker)
        self._out = np.empty(1, output_type(self._tile, tracker.outputs))
        self._run = drivers(self._rows.steps, tracker.steps_for(self._rows)).run

    def update(self, y: Any, u: Any = None, time: Any = None, weight: float = 1.0, drift: float = 1.0) -> Steps:
        """Take one sample in: y (ny,), u (m,), or (ny, m) where the outputs share one theta."""
        interval = 1.0 if time is None else interval_of(self._last, time, self.dt)
        if not interval > 0.0:
            self._ignored += 1
            nothing = np.full(len(self.model.outputs), np.nan)
            return nothing, nothing, nothing, np.zeros(len(nothing), bool)
        self._last = self._last if time is None else time
        known = known_factors(interval, noise_of(weight), factor("drift", drift))
        return self._step(self._tile, as_numbers("y", y), u, known)

    def predict(self, u: Any = None) -> tuple[Array, Array]:
        """(y_hat, s), each (ny,): what the next outputs are expected to be; the state stays as it is."""
        missing = np.full(len(self.model.outputs), np.nan)
        y_hat, _, s, _ = self._step(self._tile.copy(), missing, u, known_factors())
        return y_hat, s

    def _step(self, tile: Array, y: Array, u: Any, known: Array) -> Steps:
        """One call of the driver, or one for each row of the instant."""
        ny, m = len(self.model.outputs), self._rows.m
        if y.shape != (ny,):
            raise ValueError(f"Live.update: y must be ({ny},); got shape {y.shape}.")
        shape = (ny, m) if self.model.shared else (m,)
        inputs = np.full(shape, np.nan) if u is None else as_numbers("u", u).reshape(-1)
        if inputs.size != ny * m if self.model.shared else inputs.size != m:
            raise ValueError(f"Live.update: u must have shape {shape}; got shape {np.shape(u)}.")
        if not self.model.shared:
            lanes = np.repeat(inputs.reshape(1, m, 1), ny, axis=2)
            self._run(tile, y[None], lanes, np.repeat(known[:, :, None], ny, axis=2), self._out)
            return self._said()
        said = []
        for j, row in enumerate(inputs.reshape(ny, m)):
            same = known.copy()
            same[0, 0] *= j == 0
            self._run(tile, y[None, j : j + 1], row[None, :, None], same[:, :, None], self._out)
            said.append(self._said())
        y_hat, e, s, ok = (np.concatenate(values) for values in zip(*said, strict=True))
        return y_hat, e, s, ok

    def _said(self) -> Steps:
        """What the driver wrote, a number for each lane."""
        out = self._out[0]
        return out["y_hat"].copy(), out["e"].copy(), out["s"].copy(), out["ok"] > 0.0

    @property
    def theta(self) -> Array:
        """Parameters now."""
        theta: Array = self._tile["theta"][0].T.copy()
        return theta[0] if self.model.shared else theta

    @property
    def std(self) -> Array:
        """Their standard deviations."""
        lanes = range(self._tile["theta"].shape[-1])
        states = ({name: self._tile[name][0, ..., l] for name in storage.fields(self._tile)} for l in lanes)
        std: Array = np.sqrt([np.diag(self.tracker.cov(state)) for state in states])
        return std[0] if self.model.shared else std

    @property
    def names(self) -> tuple[Any, ...]:
        """Names of the parameters, of each output where they have one theta each."""
        return self._rows.names if self.model.shared else tuple(map(self.model.names_of, self.model.outputs))

    @property
    def ignored(self) -> int:
        """Samples that came with a time not after the last."""
        return self._ignored

    def save(self, path: str | PathLike[str]) -> None:
        """Write model, settings and state to one file, without pickle; complete or not at all."""
        extra = {"dt": self.dt, "last": self._last, "ignored": self._ignored}
        header = {"model": storage.describe(self.model), "tracker": storage.describe(self.tracker), "extra": extra}
        states = {f"state_{name}": self._tile[name][0] for name in storage.fields(self._tile)}
        storage.write(path, {"kind": "outputs", **header}, states)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Continue from a file as if never stopped."""
        header, arrays = storage.read(path, "outputs")
        tracker = storage.rebuild(header["tracker"], Tracker)
        live = cls(storage.rebuild(header["model"], Model), tracker, header["extra"]["dt"])
        live._last, live._ignored = header["extra"]["last"], header["extra"]["ignored"]
        into = {name: live._tile[name][0] for name in storage.fields(live._tile)}
        storage.restore(path, tracker, arrays, "state_", into)
        return live

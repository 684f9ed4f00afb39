"""Streams of models of different sizes that share compiled steps.

The step of a stream is compiled for one number of parameters and one set of orders, which takes a second. Here the
state of a stream moves to a record of the largest model of its family (`Model.as_large_as`) before a step, and back to
its own when anything else reads or changes it: what a stream offers is what a stream that runs alone offers, bit for
bit. Cost: a move takes a few microseconds; `LiveSelection` needs none from sample to sample.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from driftfit.data import storage
from driftfit.engine.kernel import Array
from driftfit.engine.tiles import as_compiled
from driftfit.run.layout import words_of
from driftfit.run.live.live import Live
from driftfit.run.program import Program
from driftfit.trackers.parts.common_size import SIZES, padded, places


class SharedStream(Live):
    """A stream whose samples may be processed in the record of a wider program; before `within` in its own."""

    _wide: _Wide | None = None
    _away = False
    """Whether the state is in the wide record."""

    def _state_tile(self) -> Array:
        self._return()
        return self._tile

    def within(self, wide: Program) -> None:
        """Process samples in records of this program from now on, which compiles its step."""
        self._wide = _Wide(self._state_tile(), self.program, wide)

    def _stepper(self) -> Any:
        return self._in_wide

    def _in_wide(self, compiled: Array, y: float, u: Any) -> Any:
        """The compiled step, on the state of the stream or on the copy of it with which `predict` works."""
        if self._wide is None:
            self.within(self.program)
        wide = self._wide
        assert wide is not None
        if compiled is not self._compiled:
            wide.take(self._scratch, wide.scratch)
            return wide.step(wide.compiled_scratch, y, u)
        if not self._away:
            wide.take(self._tile, wide.tile)
            self._away, self._interval = True, wide.tile["interval"][0]
        return wide.step(wide.compiled, y, u)

    def _return(self) -> None:
        if self._away:
            assert self._wide is not None
            self._wide.give(self._tile)
            self._away, self._interval = False, self._tile["interval"][0]

    def predict(self, u: Any = None) -> tuple[Any, Any]:
        self._return()
        return super().predict(u)

    def _of_lanes(self, name: str) -> Array:
        if not self._away:
            return super()._of_lanes(name)
        assert self._wide is not None
        values: Array = self._wide.tile[name][0, : self._rows.n, 0].copy()
        return values


class _Wide:
    """The record of a wider program, and where in it the numbers of a stream are."""

    def __init__(self, own: Array, program: Program, wide: Program) -> None:
        n, N = program.model.n, wide.model.n
        self.tile = wide.tile(padded(program.tracker, n, N))
        self.scratch = self.tile.copy()
        self.step = wide.drivers().updater(self.tile, wide.model.m)
        self.compiled, self.compiled_scratch = as_compiled(self.tile), as_compiled(self.scratch)
        self._absent = N - n if "S" in storage.fields(own) else 0
        names = [name for name in storage.fields(own) if not (self._absent and name in ("rank", "absent"))]
        self._from = np.concatenate([_rows(own, name, own, 0) for name in names])
        self._into = np.concatenate([_rows(self.tile, name, own, N - n) for name in names])

    def take(self, own: Array, tile: Array) -> None:
        """Copy the state of a stream into a wide record; what is absent stays as it is."""
        words_of(tile)[self._into] = words_of(own)[self._from]
        if self._absent:
            tile["rank"] = own["rank"] + self._absent

    def give(self, own: Array) -> None:
        """Copy the state back."""
        words_of(own)[self._from] = words_of(self.tile)[self._into]
        if self._absent:
            own["rank"] = self.tile["rank"] - self._absent


def _rows(tile: Array, name: str, own: Array, absent: int) -> Array:
    """The rows of `words_of` of a tile that hold a field of the own one, which has fewer parameters."""
    fields: Mapping[str, Any] = tile.dtype.fields or {}
    found: Array = fields[name][1] // 8 + places(name, own[name].shape[1:-1], tile[name].shape[1:-1], absent).reshape(
        -1
    )
    return found


def share(streams: Sequence[SharedStream]) -> None:
    """Compile the steps of streams: one for all of a family of nearly the same size, and one for each other stream."""
    families: dict[Any, list[SharedStream]] = {}
    for k, live in enumerate(streams):
        model = live.program.model
        shared = live.tracker.pads and model.family is not None
        families.setdefault((model.family, bisect_left(SIZES, model.n)) if shared else k, []).append(live)
    for alike in families.values():
        models = [live.program.model for live in alike]
        for live, model in zip(alike, models, strict=True):
            wide = model.as_large_as(models) if len(models) > 1 else model
            live.within(Program(wide, live.tracker))

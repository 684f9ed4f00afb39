"""ARX models of different orders in one compiled driver.

    phi_t[i] = a past output, entry picks[i] of the lags of the inputs, the constant 1, or 0 after the own regressors

A driver is compiled for one number of parameters and one set of orders. To run many orders side by side, each model
gets the size of the largest, with regressors of 0 after its own, and its orders are numbers in the record instead of
constants of the compiled routines. Bits are those of the `ARX`; a sample takes longer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import ModelSteps, TrackerSteps
from driftfit.engine.kernel import State, kernel
from driftfit.models.base import GAP
from driftfit.models.lags.doubted_lags import doubted, no_doubts, shift_doubts
from driftfit.models.lags.output_lags import shift_inputs, take_output, wait_for_lags
from driftfit.models.wider import Wider

PAST, ONE, ABSENT = -1, -2, -3
"""Regressors that are no lags of inputs: a past output (these are the first), the constant, and 0."""


@dataclass(frozen=True)
class RunTimeARX(Wider):
    """A bound `ARX` in the record of a larger one.

    ``na`` and ``picks`` (n,) are its orders; ``room`` is (lags of the output, lags of each input).
    """

    na: int
    picks: tuple[int, ...]
    room: tuple[int, int]

    def memory(self) -> Mapping[str, Any]:
        own, (length, depth) = self.model.memory(), self.room
        unknown = own["y_lag"][0]
        lags = {"y_lag": np.full(length, unknown), "u_lag": np.full((len(own["u_lag"]), depth), unknown)}
        picks = np.array((*self.picks, *(ABSENT,) * (self.size - len(self.picks))))
        return {**own, **lags, "picks": picks, "na": np.array(self.na)}

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.m, False)

    def memory_for(self, tracker: TrackerSteps) -> Mapping[str, Any]:
        return {**self.memory(), **no_doubts(1, self.room[0])} if tracker.doubts else self.memory()

    def steps_for(self, tracker: TrackerSteps) -> ModelSteps:
        return _steps(self.m, tracker.doubts)


@lru_cache
def _steps(m: int, doubts: bool) -> ModelSteps:
    """The steps for m inputs; compare those of `driftfit.models.arx`."""

    @kernel
    def regress(s: State, l: int) -> None:
        broken = s.dt[l] > GAP
        length, depth = s.y_lag.shape[0], s.u_lag.shape[1]
        for i in range(length):
            if i < s.na[l]:
                lag = s.y_lag[i, l]
                lag = np.nan if broken else lag
                s.y_lag[i, l] = lag
                s.phi[i, l] = doubted(s, 0, i, l, lag) if doubts else lag
        shift_inputs(s, m, l)
        for i in range(s.phi.shape[0]):
            pick = s.picks[i, l]
            if pick >= 0:
                s.phi[i, l] = s.u_lag[pick // depth, pick % depth, l]
            elif pick != PAST:
                s.phi[i, l] = 1.0 if pick == ONE else 0.0
        wait_for_lags(s, l)

    @kernel
    def push(s: State, l: int) -> None:
        na = s.na[l]
        if doubts and na > 0:
            shift_doubts(s, 0, l, l, l, 1, 1, na)
        for i in range(s.y_lag.shape[0] - 1, 0, -1):
            if i < na:
                s.y_lag[i, l] = s.y_lag[i - 1, l]
        take_output(s, na, l)

    return ModelSteps(regress, push)

"""Hammerstein-Wiener models of different orders in one compiled driver.

A driver is compiled for one number of parameters and one set of orders. To compare many orders, each model gets the
size of the largest, with regressors of 0 after its own, and its orders are numbers in the record instead of constants
of the compiled routines. Bits are the same; a sample takes longer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import ModelSteps
from driftfit.engine.kernel import State, floats, kernel, machine, wholes
from driftfit.models.hammerstein_wiener.evaluate_bases import Kind, level_of
from driftfit.models.hammerstein_wiener.output_curve import refining
from driftfit.models.hammerstein_wiener.step_memory import (
    DT,
    EACH,
    FACTOR,
    G_PAST,
    GIVEN,
    IDENTITY,
    INPUTS,
    LATE,
    N_OUT,
    NA,
    NB,
    NEXT,
    NOW,
    OWN,
    PREDICTED,
    US,
    N,
    Y,
)
from driftfit.models.hammerstein_wiener.steps import regress_work, settle_output
from driftfit.models.wider import Wider


@dataclass(frozen=True)
class RunTimeOrders(Wider):
    """A bound `HammersteinWiener` in the record of a larger one.

    ``kinds`` are the compiled functions of its bases, that of the output last; ``places`` its orders, and where the
    arrays in its memory begin; ``room`` is the size of the memory.
    """

    kinds: tuple[Kind, ...]
    places: tuple[int, ...]
    room: int

    def memory(self) -> Mapping[str, Any]:
        memory = self.model.memory()
        blocks = np.append(memory["blocks"], np.zeros(self.room - memory["blocks"].size))
        return {**memory, "blocks": blocks, "orders": np.array(self.places)}

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.kinds[:-1], self.kinds[-1])


@lru_cache
def _steps(into: tuple[Kind, ...], out: Kind) -> ModelSteps:
    """The steps for the compiled bases of the inputs and of the output."""
    work, refine, count = regress_work(into, out, False), refining(level_of(out)), OWN + EACH * len(into)

    def machine_regress_any(blocks: int, theta: int, orders: int) -> None:
        p = wholes(orders, 1, count)[0]
        work(floats(blocks, p[US] + p[INPUTS], 1), p, floats(theta, p[N], 1))

    def machine_push_any(blocks: int, orders: int) -> None:
        p = wholes(orders, 1, count)[0]
        m = floats(blocks, p[US] + p[INPUTS], 1)
        if m[LATE, 0] > 0.0:
            m[PREDICTED, 0] = refine(m, p, m[PREDICTED, 0])

    regress_any, push_any = machine(machine_regress_any), machine(machine_push_any)

    @kernel
    def regress(s: State, l: int) -> None:
        s.blocks[GIVEN, l], s.blocks[Y, l], s.blocks[DT, l] = s.noise[l], s.y[l], s.dt[l]
        for i in range(s.orders[INPUTS, l]):
            s.blocks[s.orders[US, l] + i, l] = s.u[i, l]
        regress_any(s.blocks.ctypes.data, s.theta.ctypes.data, s.orders.ctypes.data)
        for i in range(s.orders[N, l]):
            s.phi[i, l] = s.blocks[s.orders[NOW, l] + i, l]
        at = s.orders[NA, l] + s.orders[NB, l]
        for k in range(s.orders[N_OUT, l] - 1):
            s.phi[at + k, l] = s.blocks[s.orders[G_PAST, l] + 1 + k, l]
        s.y[l], s.dt[l] = s.blocks[Y, l], s.blocks[DT, l]
        s.noise[l] *= s.blocks[FACTOR, l]

    @kernel
    def push(s: State, l: int) -> None:
        s.noise[l] = s.blocks[GIVEN, l]
        if s.orders[IDENTITY, l] == 0:
            push_any(s.blocks.ctypes.data, s.orders.ctypes.data)
        s.y_hat[l] = s.blocks[PREDICTED, l]
        settle_output(s, l)
        for i in range(s.orders[N, l]):
            s.blocks[s.orders[NOW, l] + i, l] = s.blocks[s.orders[NEXT, l] + i, l]

    def ready(L: int) -> None:
        assert L == 1
        for routine in (*(one[0] for one in into), out[0], regress_any, push_any):
            routine.load()

    return ModelSteps(regress, push, ready)

"""ARX with several outputs: one regression per output, all on the same regressors.

    phi_t = [y1_{t-1} .. y1_{t-na}, y2_{t-1} .., u1_{t-nk} .., (1)],   yo_t = phi_t' theta_o,t + v_o,t

The outputs are lanes of one tile, so every tracker runs unchanged. Each lane keeps a copy of the lags of all outputs.
``push`` fills them from ``y`` of the other lanes, or from their predictions if y is missing, by the rule of `ARX`.

`ARX(.., ny=2)` turns into this model when it is bound. Cost per sample: O(ny (ny na + nb)) for the lags.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.models.arx import ARX, GAP


@dataclass(frozen=True)
class JointARX(ARX):
    """A bound `ARX` with several outputs."""

    @property
    def names(self) -> tuple[str, ...]:
        own = [f"a{i + 1}[<-{output}]" for output in self.outputs for i in range(self.na)]
        return (*own, *self._input_names())

    def names_of(self, output: str) -> tuple[str, ...]:
        named = []
        for name in self.names:
            head, _, source = name.partition("[")
            source = source.removeprefix("<-").removesuffix("]") or ("" if head == "intercept" else "u")
            named.append(f"{head}[{output}<-{source}]" if source else f"{head}[{output}]")
        return tuple(named)

    @property
    def dimensions(self) -> None:  # type: ignore[override]
        return None

    def memory(self) -> Mapping[str, Any]:
        count = len(self.outputs)
        unknown = np.nan if self.start == "drop" else 0.0
        return {**super().memory(), "y_lag": np.full((count, max(self.na, 1)), unknown), "filled": np.zeros(count)}

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.na, self.lags, self.intercept, len(self.outputs))

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
        raise ValueError("simulate: the outputs of a joint ARX feed each other; one alone cannot be run forward.")

    def polynomials(self, theta: Array) -> tuple[Array, list[Array]]:
        raise ValueError("polynomials: A(z) of several outputs is a matrix; take it from run.theta by run.names.")


@lru_cache
def _steps(na: int, lags: tuple[tuple[int, int], ...], intercept: bool, ny: int) -> ModelSteps:
    m = len(lags)
    nb = tuple(b for b, _ in lags) or (0,)
    nk = tuple(k for _, k in lags) or (0,)
    at = tuple(int(ny * na + sum(nb[:j])) for j in range(max(m, 1)))
    n = ny * na + sum(nb)

    @kernel
    def regress(s: State, l: int) -> None:
        broken = s.dt[l] > GAP
        depth = s.u_lag.shape[1]
        for o in range(ny):
            for i in range(na):
                s.y_lag[o, i, l] = np.nan if broken else s.y_lag[o, i, l]
                s.phi[o * na + i, l] = s.y_lag[o, i, l]
        for j in range(m):
            for i in range(depth - 1, 0, -1):
                s.u_lag[j, i, l] = np.nan if broken else s.u_lag[j, i - 1, l]
            s.u_lag[j, 0, l] = s.u[j, l]
            for i in range(nb[j]):
                s.phi[at[j] + i, l] = s.u_lag[j, nk[j] + i, l]
        if intercept:
            s.phi[n, l] = 1.0
        started = 1.0
        for i in range(s.phi.shape[0]):
            started = started if abs(s.phi[i, l]) < LARGEST else s.started[l]
        s.started[l] = started
        s.dt[l] = s.dt[l] if started > 0.0 else 0.0

    @kernel
    def push(s: State, l: int) -> None:
        for o in range(ny):  # lane o belongs to output o
            for i in range(na - 1, 0, -1):
                s.y_lag[o, i, l] = s.y_lag[o, i - 1, l]
            informed = (s.s[o] != np.inf) | (s.noise[o] == np.inf)
            fill = s.y_hat[o] if s.valid[o] > 0.0 and informed and s.filled[o, l] < na else np.nan
            s.filled[o, l] = 0.0 if s.seen[o] > 0.0 else s.filled[o, l] + 1.0
            if na > 0:
                s.y_lag[o, 0, l] = s.y[o] if s.seen[o] > 0.0 else fill

    return ModelSteps(regress, push)

"""Linear regression: y_t = phi_t' theta_t + v_t, where the user's inputs are the regressors.

    phi_t = [u_t1 .. u_tm, (1)]

Use it if the regressors are known at the time of the output (hedge ratios, factor betas, sensor calibration); use
`ARX` if the output depends on its past. Several outputs either have one theta each, on the same regressors (``ny=2``),
or measure the same theta, each with its own regressors (``ny=2, shared=True``). A sample with a missing regressor or
output is skipped: time passes, but nothing is learned. Cost per sample: O(n).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import ModelSteps
from driftfit.engine.kernel import Array, State, kernel, nothing
from driftfit.engine.settings import output_names
from driftfit.models.base import Term
from driftfit.models.inputs import CountedInputs


@dataclass(frozen=True)
class Regression(CountedInputs):
    """Regression on the rows of u.

    Parameters
    ----------
    regressors : int, names, or None
        How many columns u has, or their names. None: as many as u has.
    intercept : bool
        Add a regressor that is always 1, as the last parameter.
    ny : int or names
        Outputs, columns of y.
    shared : bool
        All outputs measure one theta: u is then (T, ny, m), with a row of regressors for each output.
    """

    regressors: int | tuple[str, ...] | None = None
    intercept: bool = False
    ny: int | tuple[str, ...] = 1
    shared: bool = False
    inputs_setting = "regressors"
    constant = "intercept"

    def __post_init__(self) -> None:
        self._check_inputs()
        if not isinstance(self.ny, int):
            self._set("ny", output_names("Regression", self.ny))
        if self.shared and len(self.outputs) == 1:
            raise ValueError("Regression: shared=True needs several outputs; give their number, as in ny=2.")
        if self.regressors is not None and self.n == 0:
            raise ValueError("Regression: there is nothing to estimate with 0 regressors and no intercept.")

    @property
    def m(self) -> int:
        if self.regressors is None:
            raise ValueError(
                "Regression: give the number of regressors, as in Regression(3) or Regression(['income'])."
            )
        return super().m

    @property
    def input_names(self) -> tuple[str, ...]:
        return () if self.shared else super().input_names

    @property
    def names(self) -> tuple[str, ...]:
        given = self.regressors
        own = tuple(f"theta{i + 1}" for i in range(self.m)) if isinstance(given, int) else tuple(given or ())
        return own + (("intercept",) if self.intercept else ())

    @property
    def outputs(self) -> tuple[str, ...]:
        return output_names("Regression", self.ny)

    @property
    def dimensions(self) -> tuple[tuple[int, int | None], ...]:
        return (*((1, j) for j in range(self.m)), *([(1, None)] if self.intercept else []))

    @property
    def reach(self) -> int:
        return 0

    @property
    def terms(self) -> tuple[Term, ...]:
        return (*(("u", j, 0) for j in range(self.m)), *([("1", 0, 0)] if self.intercept else []))

    def memory(self) -> Mapping[str, Any]:
        return {}

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.m, self.intercept)

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
        rest = theta[:, -1:] if self.intercept else 0.0
        return np.asarray(np.sum(u[:, y.shape[1] :] * theta[:, None, : self.m], axis=2) + rest + noise)


@lru_cache
def _steps(m: int, intercept: bool) -> ModelSteps:
    @kernel
    def regress(s: State, l: int) -> None:
        for i in range(m):
            s.phi[i, l] = s.u[i, l]
        if intercept:
            s.phi[m, l] = 1.0

    return ModelSteps(regress, nothing)

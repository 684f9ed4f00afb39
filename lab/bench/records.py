"""The input and the output of a method in the benchmark.

Record   y (T,), u (T, m), the model, and the regressors phi (T, n) for packages that know no lags
Outcome  theta (T, n) and its std after each sample, prediction (T,) and its std before it
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.results import Track
from lab.scenarios import Simulated, simulate

MODELS: dict[str, Model] = {"regression": Regression(3), "arx": ARX(2, 2)}
"""The models of the scenarios, by kind."""


class Outcome(NamedTuple):
    """The results of a method on a record; NaN where there are none."""

    theta: Array
    std: Array
    prediction: Array
    prediction_std: Array

    @classmethod
    def of(cls, run: Track) -> Outcome:
        """The same of a run of ours."""
        return cls(run.theta, run.std, run.prediction, run.innovation_std)


@dataclass(frozen=True)
class Record:
    """A record, simulated or real; ``truth`` is None for a real one."""

    model: Model
    y: Array
    u: Array
    truth: Simulated | None = None

    @cached_property
    def phi(self) -> Array:
        """Regressors (T, n); NaN where a lag is missing."""
        return regressors(self.model, self.y, self.u)

    @cached_property
    def usable(self) -> Array:
        """Samples (T,) whose output and regressors are all there."""
        return np.isfinite(self.y) & np.isfinite(self.phi).all(axis=1)

    def part(self, stop: int) -> Record:
        """The first samples."""
        return Record(self.model, self.y[:stop], self.u[:stop])


def simulated(name: str, kind: str, seed: int, T: int) -> Record:
    """A scenario played once."""
    truth = simulate(name, kind, seed, T)
    return Record(MODELS[kind].bind(truth.u.shape[1]), truth.y, truth.u, truth)


def regressors(model: Model, y: Array, u: Array) -> Array:
    """phi (T, n) of a regression or ARX model as a user of another package would build it: shifted columns."""
    columns = [] if isinstance(model, Regression) else [delayed(y, i + 1) for i in range(model.na)]  # type: ignore[attr-defined]
    if isinstance(model, ARX):
        columns += [delayed(u[:, j], nk + i) for j, (nb, nk) in enumerate(model.lags) for i in range(nb)]
    else:
        columns += list(u.T)
    if getattr(model, "intercept", False):
        columns.append(np.ones(len(y)))
    return np.column_stack(columns)


def delayed(column: Array, by: int) -> Array:
    """A column so many samples later; NaN before it."""
    return np.concatenate([np.full(by, np.nan), column[: len(column) - by]])

"""What the verdict and the diagnosis of a run share: its regression, the test of constancy, the errors of rivals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.kernel import Array
from driftfit.judge.compare import Errors, errors
from driftfit.judge.constant_fit import constant_least_squares
from driftfit.judge.left_out import without_left_out
from driftfit.judge.regressors import Distinct, Rows, distinct, regressors
from driftfit.judge.statistics.constancy import Constancy, constancy
from driftfit.run.result import Track


@dataclass(frozen=True)
class Evidence:
    """Each part is computed when it is first needed; ``lags`` and ``burn`` are those of `Track.verdict`."""

    run: Track
    lags: int | None = None
    burn: int | None = None

    @cached_property
    def _record(self) -> Record:
        return without_left_out(self.run)

    @cached_property
    def _steady(self) -> Array:
        return constant_least_squares(self.run.model, self._record)

    @cached_property
    def rows(self) -> Rows:
        """The record as samples of a regression."""
        return regressors(self.run, self._steady)

    @cached_property
    def _found(self) -> tuple[Distinct, Rows, Constancy]:
        """The parameters that a test can tell apart, the samples with their regressors, and the test."""
        rows, every = self.rows, Distinct(tuple(range(self.run.model.n)), ())
        test = constancy(rows.phi, rows.y, self.lags, rows.at, rows.step)
        found = distinct(rows.phi) if np.isnan(test.p_joint) else every
        if len(found.kept) in (0, self.run.model.n):
            return every, rows, test
        rows = rows._replace(phi=np.ascontiguousarray(rows.phi[:, found.kept]))
        return found, rows, constancy(rows.phi, rows.y, self.lags, rows.at, rows.step)

    @property
    def distinct(self) -> Distinct:
        """The parameters that the test can tell apart; it takes the others for 0."""
        return self._found[0]

    @property
    def tested(self) -> Rows:
        """The samples with the regressors of these parameters."""
        return self._found[1]

    @property
    def test(self) -> Constancy:
        """Whether constants explain them."""
        return self._found[2]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of these parameters."""
        return tuple(self.run.model.names[i] for i in self.distinct.kept)

    @cached_property
    def errors(self) -> Errors:
        """One-step errors of the run and of simpler predictors."""
        return errors(self.run, self._record, self.burn, self._steady)

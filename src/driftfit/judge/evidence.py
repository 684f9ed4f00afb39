"""What the verdict and the diagnosis of a run share: its regression, its changes, the errors of rivals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.kernel import Array
from driftfit.judge.changes.changes import Changes, changes
from driftfit.judge.changes.dates import LEVEL
from driftfit.judge.changes.null import modelled
from driftfit.judge.compare import Errors, errors
from driftfit.judge.constant_fit import constant_least_squares
from driftfit.judge.regressors import Distinct, Rows, judged_by_others, regressors
from driftfit.judge.statistics.coarse_readings import drawn_within
from driftfit.judge.statistics.robust import fit_in, noisy, orthonormal, sole
from driftfit.run.result import Track

REJECTED = 0.05
"""Level of the test where none is given."""


def least_rows(n: int) -> int:
    """Rows that a test of n parameters needs."""
    return 4 * n + 8


def judged_rows(
    rows: Rows, level: float, order: int | None = None, dates: float = LEVEL, fewest: int | None = None
) -> Changes | None:
    """The changes of rows; None if they are too few, do not determine every parameter, or have no noise."""
    N, n = rows.phi.shape
    if n == 0 or least_rows(n) > N:
        return None
    basis = orthonormal(rows.phi)
    if not basis.distinct or sole(basis.Q).any():
        return None
    y = rows.y if rows.step is None else drawn_within(basis.Q, rows.y, rows.step)
    fit = fit_in(basis, y)
    if not noisy(fit, rows.phi, y):
        return None
    found = changes(modelled(rows.phi, basis, y, fit, rows.lags, rows.root, order, fewest), level, dates)
    if rows.step is None or y is not rows.y or not len(found.found.breaks):
        return found
    y = drawn_within(basis.Q, y, rows.step, found.found.breaks)  # readings of segments, where constants explain none
    if y is rows.y:
        return found
    fit = fit_in(basis, y)
    return changes(modelled(rows.phi, basis, y, fit, rows.lags, rows.root, order, fewest), level, dates)


@dataclass(frozen=True)
class Evidence:
    """Each part is computed when it is first needed; ``lags`` and ``burn`` are those of `Track.verdict`."""

    run: Track
    lags: int | None = None
    burn: int | None = None
    level: float = REJECTED

    @cached_property
    def _record(self) -> Record:
        return self.run.used_record

    @cached_property
    def steady(self) -> Array:
        """Recursive least squares on the regressors of the run."""
        return constant_least_squares(self.run.model, self._record)

    @cached_property
    def rows(self) -> Rows:
        """The record as samples of a regression."""
        return regressors(self.run, self.steady)

    @cached_property
    def _found(self) -> tuple[Distinct, Rows, Changes | None]:
        """The parameters that a test can tell apart, the samples with their regressors, and what changed."""
        rows, every = self.rows, Distinct(tuple(range(self.run.model.n)), ())
        found = judged_rows(rows, self.level, self.lags)
        if found is not None:
            return every, rows, found
        others, apart = judged_by_others(rows)
        if not apart.kept or (len(apart.kept) == self.run.model.n and len(others.y) == len(rows.y)):
            return every, rows, None
        others = others.only(np.arange(len(others.y)), apart.kept)
        return apart, others, judged_rows(others, self.level, self.lags)

    @property
    def distinct(self) -> Distinct:
        """The parameters that the test can tell apart; it takes the others for 0."""
        return self._found[0]

    @property
    def tested(self) -> Rows:
        """The samples with the regressors of these parameters."""
        return self._found[1]

    @property
    def changes(self) -> Changes | None:
        """What changed in them; None if that cannot be tested."""
        return self._found[2]

    @property
    def p(self) -> float:
        """p-value of constants; NaN if they cannot be tested."""
        return float("nan") if self.changes is None else self.changes.test.p

    @property
    def names(self) -> tuple[str, ...]:
        """Names of these parameters."""
        return tuple(self.run.model.names[i] for i in self.distinct.kept)

    @cached_property
    def errors(self) -> Errors:
        """One-step errors of the run and of simpler predictors."""
        return errors(self.run, self._record, self.burn, self.steady)

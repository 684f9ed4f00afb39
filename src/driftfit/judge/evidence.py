"""What the verdict and the diagnosis of a run share: its regression, the test of constancy, the errors of rivals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.kernel import Array
from driftfit.judge.compare import Errors, errors
from driftfit.judge.constant_fit import constant_least_squares
from driftfit.judge.regressors import Distinct, Rows, judged_by_others, regressors
from driftfit.judge.segments.noise_of_regressors import relative_size
from driftfit.judge.statistics.constancy import Constancy, constancy
from driftfit.run.result import Track


def of_one_size(rows: Rows, test: Constancy, lags: int | None) -> tuple[Rows, Constancy]:
    """Rows and their test of constancy, the rows divided by the size of their noise if that depends on the regressors
    (`driftfit.judge.segments.noise_of_regressors`)."""
    noise = test.noise
    size = None if noise is None or noise.rare else relative_size(rows.phi, rows.y, noise)
    if noise is None or size is None:
        return rows, test
    step = None if rows.step is None else rows.step / size
    weighted = rows._replace(phi=rows.phi / size[:, None], y=rows.y / size, step=step)
    again = constancy(weighted.phi, weighted.y, lags, rows.at, step)
    # weights also change the correlation of the noise: there they must explain breaks, not add some
    if again.noise is None or (len(again.noise.ar) and len(again.noise.breaks) >= len(noise.breaks)):
        return rows, test
    return weighted, again


@dataclass(frozen=True)
class Evidence:
    """Each part is computed when it is first needed; ``lags`` and ``burn`` are those of `Track.verdict`."""

    run: Track
    lags: int | None = None
    burn: int | None = None

    @cached_property
    def _record(self) -> Record:
        return self.run.used_record

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
        if not np.isnan(test.p_joint):
            return every, rows, test
        rows, found = judged_by_others(rows)
        if not found.kept or (len(found.kept) == self.run.model.n and len(rows.y) == len(self.rows.y)):
            return every, self.rows, test
        rows = rows._replace(phi=np.ascontiguousarray(rows.phi[:, found.kept]))
        return found, rows, constancy(rows.phi, rows.y, self.lags, rows.at, rows.step)

    @cached_property
    def _weighted(self) -> tuple[Rows, Constancy]:
        return of_one_size(*self._found[1:], self.lags)

    @property
    def distinct(self) -> Distinct:
        """The parameters that the test can tell apart; it takes the others for 0."""
        return self._found[0]

    @property
    def tested(self) -> Rows:
        """The samples with the regressors of these parameters, divided by the size of the noise."""
        return self._weighted[0]

    @property
    def test(self) -> Constancy:
        """Whether constants explain them."""
        return self._weighted[1]

    @property
    def unweighted(self) -> tuple[Rows, Constancy]:
        """Samples and test before that division."""
        return self._found[1:]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of these parameters."""
        return tuple(self.run.model.names[i] for i in self.distinct.kept)

    @cached_property
    def errors(self) -> Errors:
        """One-step errors of the run and of simpler predictors."""
        return errors(self.run, self._record, self.burn, self._steady)

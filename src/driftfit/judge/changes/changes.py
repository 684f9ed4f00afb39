"""One object that says how the parameters of a regression changed: the test, the dates, the parameters, the kind.

`Track.verdict`, `Track.segment`, the page, fleets and diagnoses are views of it. If the test rejects constants there is
a date, or a gradual change; if it does not, there is none. The steps are `driftfit.judge.changes.fit` (noise and
segments together), `null` (the test), `dates`, `which` and `kinds`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.dates import LEVEL, Dated, counted, dated
from driftfit.judge.changes.fit import NONE, order_of, white_rows
from driftfit.judge.changes.kinds import UNIT_ROOT, Kind, kind
from driftfit.judge.changes.null import Model, Tested, tested
from driftfit.judge.changes.which import Which, which


@dataclass(frozen=True)
class Changes:
    """What a record of N rows says about n parameters. What is found beyond the test is computed when it is needed."""

    model: Model
    test: Tested
    level: float
    dates: float
    """Level of the intervals of dates."""
    start: tuple[Array, Array, tuple[float, float]]
    """What `driftfit.judge.changes.dates.counted` found; no break where constants are not rejected."""

    @cached_property
    def _all(self) -> tuple[Dated, Which, Kind]:
        model, (breaks, ar, prices) = self.model, self.start
        N, n = model.phi.shape
        found = dated(model, breaks, ar, prices, self.dates)
        none = Which(NONE, (), (), (), found.theta, found.std[1:], found.rss, n)
        changed = which(model, found) if len(breaks) else none
        if (changed.dates != found.breaks).any():
            found = dated(model, changed.dates, ar, prices, self.dates, final=True)
        moving = tuple(sorted({j for own in changed.at for j in own}))
        if self.rejected and not moving:
            moving = tuple(range(n))
        own = kind(model, found, changed, moving) if moving else Kind("", {}, (0, N - 1), np.zeros((N, 0)), (), ())
        moved = model.offset + np.zeros((len(found.breaks) + 1, 1))
        return (
            found._replace(theta=found.theta + moved),
            changed._replace(theta=changed.theta + moved),
            own._replace(path=own.path + model.offset) if own.path.size else own,
        )

    @property
    def found(self) -> Dated:
        """The segments."""
        return self._all[0]

    @property
    def which(self) -> Which:
        """The parameters that change at each date."""
        return self._all[1]

    @property
    def kind(self) -> Kind:
        """The kind of change."""
        return self._all[2]

    @property
    def moving(self) -> tuple[int, ...]:
        """Parameters that change."""
        return self.kind.moves

    @property
    def rejected(self) -> bool:
        """Whether constants are rejected."""
        return bool(self.test.p < self.level)

    @property
    def scores(self) -> Array:
        """(N, n): sums of the scores of constants over the root of their sum of squares."""
        lags, g = self.model.noise.lags, self.model.noise.g
        Z, z = white_rows(self.model.phi, self.model.y, lags, self.test.ar, g)
        own = Z * (z - Z @ (self.test.theta - self.model.offset))[:, None]
        size = np.sqrt(np.sum(own**2, axis=0))
        return np.vstack([np.zeros((order_of(lags), Z.shape[1])), np.cumsum(own, axis=0) / np.where(size > 0, size, 1)])

    @property
    def wandering_noise(self) -> bool:
        """Whether the noise may be a random walk: then a level that wanders looks the same."""
        return bool(len(self.model.noise.lags) and len(self.model.y) * (1.0 - self.test.root) < UNIT_ROOT)


def changes(model: Model, level: float, dates: float = LEVEL) -> Changes:
    """Judge a regression: at which dates its coefficients changed, by a test with the error rate ``level``, with
    intervals of the level ``dates``."""
    test, draws = tested(model)
    start = counted(model, test, draws, level) if test.p < level else (NONE, test.ar, (np.nan, np.nan))
    return Changes(model, test._replace(theta=test.theta + model.offset), level, dates, start)

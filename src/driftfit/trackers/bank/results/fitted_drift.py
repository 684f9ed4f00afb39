"""The drift between events of a bank without a given drift: for each parameter the factor of greatest likelihood.

    max_f sum_t log N(y_t; phi_t' m_t, c s_t),   Q_t = D Q_0 D,   D = diag(f_i)^(1/2)   between events,   f_i >= 1

The drift of `Bank()` is a guess, which is too small if parameters walk all the time: between events the path would be
taken as certain. c = 1, or where the noise variance is unknown the mean of e_t^2 / s_t: the bank's estimate contains
drift that its own hypotheses do not explain. All covariances are multiplied by c.

A bank whose drift is too small explains a random walk by changes, and the fit then underestimates the drift. So a
change of prior probability p is kept if, with the drift fitted to those that are left, it multiplies the likelihood by
more than (1 - p) / p; the weaker half of the others goes, until all that are left are kept.

Bands also contain the uncertainty of the factors: for each of them in turn, the paths at other values, weighted by
their likelihood and a prior that is flat in the standard deviation of the drift, f^(1/2),

    C_s + sum_i sum_g w_ig (C_ig - C_s + (m_ig - m_s)(m_ig - m_s)'),    w_ig proportional to L(f_ig) f_ig^(1/2) d log f

The likelihood of a short record is flat towards small drifts, all of which a prior flat in log f would count as
evidence that nothing moves.

Source: the likelihood is by Schweppe (1965), the prior by Gelman (2006), section 7.1; the rest is ours. Cost: O(T n^2)
for each of some hundred likelihoods, and O(T n^3) for each value of a factor that is likely enough.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.trackers.bank.results.given_steps import Problem, forward, solve

WIDER = 1e7
"""Largest factor of a drift."""
STARTS = (1.0, 1e2, 1e4)
"""Factors at which the search begins: the likelihood may be flat where a drift is too small to be detected."""
AWAY = np.arange(-7.0, 8.0)
"""Values at which the likelihood of a factor is computed, as natural logarithms."""
LIKELY = 0.01
"""Values of a factor that are less likely than this share of the best are left out."""


class FittedDrift:
    """A path with the drift of greatest likelihood.

    ``problem`` is the regression with that drift; ``widened`` (n,) the factors; ``dates`` the changes that were kept.

    Parameters
    ----------
    problem : the regression given all events
    base (T, n, n) : covariances of the steps where nothing else happens
    changes : the samples of changes, and their prior probabilities
    unknown : whether the noise variance is unknown
    """

    def __init__(self, problem: Problem, base: Array, changes: Mapping[int, float], unknown: bool) -> None:
        self._given, self._base, self._unknown = problem, base, unknown
        self.dates, self._logs = sorted(changes), np.zeros(base.shape[1])
        self._count = max(int(np.isfinite(problem.r).sum()) - base.shape[1], 1)
        self._m, self._C = np.empty(problem.phi.shape), np.empty(base.shape)
        self._fit([np.full(base.shape[1], np.log(factor)) for factor in STARTS])
        while self.dates:
            gains = {date: self._cost(self._logs, date) - self._cost(self._logs) for date in self.dates}
            missing = {date: gain - 2.0 * np.log(1.0 / changes[date] - 1.0) for date, gain in gains.items()}
            weak = sorted((date for date in missing if missing[date] < 0.0), key=lambda date: missing[date])
            if not weak:
                break
            gone = weak[: -(-len(weak) // 2)]
            self.dates = [date for date in self.dates if date not in gone]
            self._fit([self._logs])

    @property
    def widened(self) -> Array:
        return np.exp(self._logs)

    @property
    def problem(self) -> Problem:
        return self._scaled(self._logs)

    def _at(self, logs: Array, without: int | None = None) -> Problem:
        """The regression with these factors, and without one change."""
        root, dates = np.exp(0.5 * logs), [date for date in self.dates if date != without]
        Q = self._base * (root[:, None] * root)
        Q[dates] = self._given.Q[dates]
        return self._given._replace(Q=Q)

    def _deviance(self, tried: Problem) -> tuple[float, float]:
        """-2 log L, but for a constant, and c."""
        phi, y, r, Q, m0, C0 = tried
        logs, squares = forward(phi, y, r, Q, m0, C0.copy(), self._m, self._C)
        scale = squares / self._count if self._unknown and squares > 0.0 else 1.0
        return float(logs + self._count * np.log(scale) + squares / scale), scale

    def _cost(self, logs: Array, without: int | None = None) -> float:
        return self._deviance(self._at(logs, without))[0]

    def _scaled(self, logs: Array) -> Problem:
        tried = self._at(logs)
        scale = self._deviance(tried)[1]
        return tried._replace(r=tried.r * scale, Q=tried.Q * scale, C0=tried.C0 * scale)

    def _fit(self, starts: list[Array]) -> None:
        from scipy.optimize import minimize

        start = min(starts, key=self._cost)
        bounds = [(0.0, np.log(WIDER))] * len(start)
        found = minimize(self._cost, start, method="L-BFGS-B", bounds=bounds, options={"eps": 1e-3})
        self._logs = found.x if found.fun < self._cost(start) else start

    def spread(self) -> Array:
        """Covariances that the uncertainty of the factors adds to the path, (T, n, n)."""
        m, C, _ = solve(self.problem)
        more = np.zeros_like(C)
        for i in range(len(self._logs)):
            values = np.unique(np.clip(self._logs[i] + AWAY, 0.0, np.log(WIDER)))
            tried = np.tile(self._logs, (len(values), 1))
            tried[:, i] = values
            costs = np.array([self._cost(one) - one[i] for one in tried])  # -2 log of likelihood and prior
            weights = np.exp(-0.5 * (costs - costs.min()))
            weights[weights < LIKELY] = 0.0
            for weight, one in zip(weights / weights.sum(), tried, strict=True):
                if weight > 0.0 and one[i] != self._logs[i]:
                    other, C_other, _ = solve(self._scaled(one))
                    far = other - m
                    more += weight * (C_other - C + far[:, :, None] * far[:, None, :])
        return more

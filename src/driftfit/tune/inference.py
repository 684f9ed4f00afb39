"""Tests of parameters and of settings, information criteria, and the standard errors of constants.

    wald               W = (R theta - c)' (R P R')^-1 (R theta - c),   F = W / k
    likelihood_ratio   LR = 2 (log L of the full model - log L of the restricted one)
    aic, bic           -2 log L + 2 p,   -2 log L + p log N

k equations, P the covariance of theta, p the estimated settings and the parameters whose start is unknown, N the
samples that were used. F has Student's degrees of freedom where the tracker estimates the noise variance, otherwise W
is chi-square. LR is chi-square with as many degrees of freedom as settings are free in the full model alone. A variance
that the restricted model sets to 0 is at the end of its range, where half of the estimates stay: with m of them and
f others LR is a mixture of chi-squares of f + j degrees of freedom with weights binomial(m, j) / 2^m, for estimates of
variances that are independent. A random walk that starts unknown stays at 0 in about two records of three instead of
one of two, so this test rejects constants less often than it says (docs/tuning.md has the shares).

Source: Self and Liang (1987), JASA 82, cases 5 and 6; Shephard and Harvey (1990), J. Time Series Analysis 11, for the
share of zeros. The likelihood is diffuse, and two models can be compared only if they have the same regressors.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult

from driftfit.judge.regressors import refuse_hidden, regressors
from driftfit.run.program import state_of
from driftfit.run.result import Track
from driftfit.show.text import Printed, facts, shortened
from driftfit.tune.tuned import Tuned
from driftfit.use.constrained import half_space


@dataclass(frozen=True)
class Tested(Printed):
    """A statistic with its distribution and p-value; ``df`` is (k,) or, of an F statistic, (k, degrees)."""

    null: str
    statistic: float
    distribution: str
    df: tuple[float, ...]
    p: float

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        of = ", ".join(f"{one:g}" for one in self.df)
        yield facts(
            ("Null hypothesis", self.null),
            (f"{self.distribution}({of})", f"{self.statistic:.6g}"),
            ("p", f"{self.p:.4g}"),
        )


def degrees_of_freedom(run: Track, at: int = -1) -> float:
    """Residuals from which the tracker estimates the noise variance after sample ``at``; inf if it is given, or has a
    distribution that the standard errors include.
    """
    if not run.tracker.learns_noise:
        return np.inf
    return float((run.state if at in (-1, len(run) - 1) else run.lane(at))["count"])


def wald(run: Track, *equations: str, at: int = -1, names: tuple[str, ...] = ()) -> Tested:
    """Test linear equations, such as "income == 1" and "b1 + b2 == 0", of theta after sample ``at``.

    ``names`` are those of the parameters in the equations, if they are not those of the run.

    ValueError for a tracker without a covariance, inequalities, and equations that depend on each other or on
    parameters that are not determined yet. Cost O(n^3), after a replay of the record up to ``at``.
    """
    from scipy.stats import chi2, f

    if not run.tracker.covariance:
        raise ValueError(f"wald: {type(run.tracker).__name__} has no covariance; use RLS or Kalman.")
    planes = [half_space(one, names or run.names, "wald") for one in equations]
    if not planes or any(one.low != one.high for one in planes):
        raise ValueError(f'wald: give equations, such as "b1 == 1"; got {", ".join(map(repr, equations)) or "none"}.')
    R = np.array([one.g for one in planes])
    P = run.cov(at)
    unknown = ~np.isfinite(np.diag(P)) & R.any(axis=0)
    if unknown.any():
        found = ", ".join(np.array(names or run.names)[unknown])
        raise ValueError(f"wald: the record does not determine {found} up to sample {at}; test a later sample.")
    P = np.where(np.outer(R.any(axis=0), R.any(axis=0)), P, 0.0)
    S, k = R @ P @ R.T, len(R)
    unit = np.sqrt(np.diag(S))  # parameters may have units that are far apart
    S /= np.where(np.outer(unit, unit) > 0.0, np.outer(unit, unit), 1.0)
    if np.linalg.matrix_rank(S, hermitian=True) < k:
        raise ValueError("wald: the equations depend on each other; leave out those that follow from others.")
    off = (R @ run.theta[at] - [one.low for one in planes]) / unit
    W, left = float(off @ np.linalg.solve(S, off)), degrees_of_freedom(run, at)
    null = ", ".join(equations)
    if np.isfinite(left):
        return Tested(null, W / k, "F", (k, left), float(f.sf(W / k, k, left)))
    return Tested(null, W, "chi-square", (k,), float(chi2.sf(W, k)))


def likelihood_ratio(restricted: Tuned | Track, full: Tuned | Track, df: int = 0) -> Tested:
    """Test the settings that are free in ``full`` alone, by the likelihoods of two tunings or runs of the same record.

    The settings of the restricted tracker are part of those of the full one: `Kalman(q=0.0)` of ``Kalman()``, or one q
    for all parameters of ``groups="each"``. A run does not know which of its settings were estimated: of runs with the
    likeliest settings ``df`` says how many of ``full`` were that are given in ``restricted``. ``Tested.df`` are the
    lowest and the highest degrees of freedom of the mixture. ValueError for tunings by another criterion than "ml", of
    different samples, or none that is free in full alone.
    """
    from scipy.stats import chi2

    if any(getattr(one, "method", "ml") != "ml" for one in (restricted, full)):
        raise ValueError('likelihood_ratio: both tunings must be by method="ml".')
    a, b = (one.used if isinstance(one, Tuned) else np.isfinite(one.log_density).sum() for one in (restricted, full))
    if a != b:
        raise ValueError(f"likelihood_ratio: {a} and {b} samples have a likelihood; give both the same record.")
    free = df or getattr(full, "settings", 0) - getattr(restricted, "settings", 0)
    if free < 1:
        raise ValueError(
            f"likelihood_ratio: {free} more settings are free in full than in restricted; restricted comes first, and "
            "of runs df= says how many settings of full were estimated that are given in restricted."
        )
    zeros = 0 if np.any(getattr(restricted.tracker, "q", 1.0)) else free
    weights = np.array([comb(zeros, j) for j in range(zeros + 1)]) / 2.0**zeros
    each = range(free - zeros, free + 1)
    LR = max(2.0 * (full.loglik - restricted.loglik), 0.0)
    p = float(sum(w * (chi2.sf(LR, k) if k else float(LR <= 0.0)) for w, k in zip(weights, each, strict=True)))
    null = shortened(repr(restricted.tracker))
    return Tested(null, LR, "chi-square", (each[0], each[-1]) if zeros else (free,), p)


def constants(run: Track, **settings: Any) -> Any:
    """The regression of the run with constant parameters, fitted by statsmodels: its results with all they offer.

    ``settings`` are those of statsmodels' ``OLS.fit``: ``cov_type="HAC", cov_kwds={"maxlags": 4}``
    gives standard errors that hold in correlated noise of changing size. Rows are those that the run can use, weighted
    as they were. ModuleNotFoundError without statsmodels; ValueError for a model that is no regression.
    """
    import pandas as pd
    from statsmodels.api import OLS

    refuse_hidden("constants", run.model, "run.smooth()")
    rows = regressors(run)
    return OLS(pd.Series(rows.y, rows.at, name="y"), pd.DataFrame(rows.phi, rows.at, run.names)).fit(**settings)


def unknown_at_start(run: Track) -> int:
    """Number of parameters whose start is unknown."""
    start = state_of(run.fresh())
    return len(run.names) - int(start["rank"]) if "rank" in start else 0


def information(run: Track, settings: int, price: float | None = None) -> float:
    """-2 log L + price p, with p the estimated settings and the unknown starts; the price is log N unless given. NaN
    without a sample that is used.
    """
    N = int(run.ok.sum())
    each = (float(np.log(N)) if price is None else price) if N else float("nan")
    return -2.0 * run.loglik + each * (settings + unknown_at_start(run))

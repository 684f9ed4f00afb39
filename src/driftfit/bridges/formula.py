"""Regressions with time-varying coefficients by formula, with results in the manner of statsmodels.

    result = TimeVaryingRegression.from_formula("demand ~ income + rate", data).fit()
    result.params, result.bse, result.tvalues, result.conf_int(), result.summary(), result.plot_cusum()

Formulas are those of formulaic (R's and patsy's grammar: interactions, transforms, categories). Rows are in order of
time; an index of dates labels them, and sorts them with a warning if it is not in order. ``params`` are the
coefficients after the last row and ``params_path`` those after every row; ``smoothed_path`` uses the whole sample.

    fittedvalues_t = x_t' params_(t-1)
    forecasts_t    = fittedvalues_t + what the tracker expects besides: correlated noise, and the slopes of coefficients

Needs formulaic and pandas (``pip install "driftfit[formula]"``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Self

import formulaic
import numpy as np
import pandas as pd
from formulaic.materializers import FormulaMaterializer
from formulaic.utils.null_handling import find_nulls
from scipy.special import ndtr, stdtr

from driftfit.data.arguments import chronological
from driftfit.models.regression import Regression
from driftfit.readings.left_out import remarks_of
from driftfit.results import Track
from driftfit.show.axes import BLUE, RED, panels
from driftfit.show.summary import not_learned
from driftfit.show.text import WIDTH
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.base import Tracker
from driftfit.trackers.kalman import Kalman
from driftfit.tracking import track
from driftfit.tune.inference import Tested, degrees_of_freedom, wald

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INTERCEPT = "Intercept"

_SQUARES = {
    0.20: (1.0729830, -0.6698868, -0.5816458),
    0.10: (1.2238734, -0.6700069, -0.7351697),
    0.05: (1.3581015, -0.6701218, -0.8858694),
    0.02: (1.5174271, -0.6702672, -1.0847745),
    0.01: (1.6276236, -0.6703724, -1.2365861),
}
"""By level, the coefficients of the limits of the sum of squares."""


@dataclass(frozen=True)
class TimeVaryingRegression:
    """y_t = x_t' beta_t + noise, where beta drifts as the tracker assumes.

    Parameters
    ----------
    endog : pandas Series (T,)
        Outputs; NaN is missing.
    exog : pandas DataFrame (T, k)
        Regressors by name. A column "Intercept" is the constant.
    tracker : Tracker or None
        None is ``AdaptiveKalman()``, which needs no settings. ``RLS(1.0)`` gives recursive least squares.
    gate : bool, Gate or None
        Whether readings are judged before they are used, as for `driftfit.track`.
    """

    endog: pd.Series
    exog: pd.DataFrame
    tracker: Tracker | None = None
    gate: Any = None
    weights: Any = 1.0
    spec: Any = None

    @classmethod
    def from_formula(
        cls, formula: str, data: Any, tracker: Tracker | None = None, gate: Any = None, weights: Any = 1.0
    ) -> Self:
        """Read a formula such as ``"y ~ x1 + log(x2) + C(region)"``.

        A row in which a number or a category is missing is kept, and is not used. ValueError for a formula without a
        left-hand side, or with more than one output.
        """
        materializer = FormulaMaterializer.for_data(data)(data)
        matrices = materializer.get_model_matrix(formula, na_action="ignore", output="pandas")
        if not isinstance(matrices, formulaic.ModelMatrices):
            raise ValueError(f"from_formula: {formula!r} has no output; write it as in 'y ~ x1 + x2'.")
        left, right = (_numbers(side, materializer.factor_cache) for side in (matrices.lhs, matrices.rhs))
        if left.shape[1] != 1:
            raise ValueError(f"from_formula: {formula!r} has {left.shape[1]} outputs; a regression has one.")
        return cls(left.iloc[:, 0], right, tracker, gate, weights, matrices.rhs.model_spec)

    def fit(self) -> TimeVaryingResults:
        """Track the coefficients through all rows."""
        names = [str(name) for name in self.exog.columns if name != _INTERCEPT]
        model = Regression(tuple(names), intercept=_INTERCEPT in self.exog.columns)
        tracker = AdaptiveKalman() if self.tracker is None else self.tracker
        rows = chronological(self.endog.index)
        endog, exog = self.endog.iloc[rows], self.exog.iloc[rows]
        X = exog.drop(columns=_INTERCEPT, errors="ignore") if names else None
        weights = self.weights if np.ndim(self.weights) == 0 else np.asarray(self.weights)[rows]
        run = track(model, tracker, endog, X, gate=self.gate, weights=weights)
        columns = [*names, *([_INTERCEPT] if model.intercept else [])]
        return TimeVaryingResults(run, endog, pd.Index(columns), self.spec)


@dataclass(frozen=True)
class TimeVaryingResults:
    """Estimates in the words of statsmodels; ``run`` is the `Track` with everything else."""

    run: Track
    endog: pd.Series
    names: pd.Index
    spec: Any = None

    @property
    def params(self) -> pd.Series:
        """Coefficients after the last row, (k,)."""
        return pd.Series(self.run.theta[-1], self.names, name="params")

    @property
    def bse(self) -> pd.Series:
        """Their standard errors, (k,): inf where the rows do not determine a coefficient."""
        return pd.Series(self.run.std[-1], self.names, name="bse")

    @property
    def tvalues(self) -> pd.Series:
        """Coefficients over standard errors, (k,)."""
        return (self.params / self.bse).rename("tvalues")

    @property
    def df_resid(self) -> float:
        """Number of residuals from which the tracker estimates the noise variance: ``tvalues`` have Student's
        distribution with as many degrees of freedom. inf if the variance is given, or has a distribution that the
        standard errors include: theirs is normal.
        """
        return degrees_of_freedom(self.run)

    @property
    def pvalues(self) -> pd.Series:
        """Two-sided p-values of "this coefficient is zero now", (k,), from the distribution of ``df_resid``."""
        far = -self.tvalues.abs()
        tail = stdtr(self.df_resid, far) if np.isfinite(self.df_resid) else ndtr(far)
        return pd.Series(2.0 * tail, self.names, name="pvalues")

    def conf_int(self, alpha: float = 0.05) -> pd.DataFrame:
        """Limits of the 1 - alpha confidence interval of every coefficient after the last row, columns 0 and 1, from
        the same distribution.
        """
        return pd.DataFrame({side: path[-1] for side, path in enumerate(self.run.band(1.0 - alpha))}, self.names)

    def cov_params(self) -> pd.DataFrame:
        """Covariance of the coefficients after the last row, (k, k)."""
        return pd.DataFrame(self.run.cov(-1), self.names, self.names)

    def f_test(self, equations: str) -> Tested:
        """Test equations of the coefficients after the last row jointly, as in ``"income = 1, rate = 0"``: an F test if
        the tracker estimates the noise variance, otherwise chi-square (`driftfit.tune.inference`).
        """
        each = (re.sub(r"(?<![<>=])=(?!=)", "==", one) for one in equations.split(","))
        return wald(self.run, *each, names=tuple(map(str, self.names)))

    def predict(self, data: Any) -> pd.Series:
        """x' params for the rows of other data, (N,): the coefficients after the last row."""
        X = self._columns(data)
        return pd.Series(X.to_numpy() @ self.params.to_numpy(), X.index, name="predict")

    def get_forecast(self, data: Any, alpha: float = 0.05) -> pd.DataFrame:
        """Outputs of the rows that follow the record, with the regressors of ``data`` and its index: ``mean``,
        ``mean_se`` and the limits of the 1 - alpha interval, which contain drift and noise.
        """
        X = self._columns(data)
        ahead = self.run.forecast(len(X), X.drop(columns=_INTERCEPT, errors="ignore").to_numpy())
        low, high = ahead.band(1.0 - alpha)
        columns = {"mean": ahead.y_hat, "mean_se": ahead.y_std, "mean_ci_lower": low, "mean_ci_upper": high}
        return pd.DataFrame(columns, X.index)

    def _columns(self, data: Any) -> pd.DataFrame:
        """The regressors of other data by the formula, in the order of ``names``."""
        if self.spec is None:
            raise ValueError(
                "predict: the regression was made without a formula; use TimeVaryingRegression.from_formula."
            )
        return pd.DataFrame(self.spec.get_model_matrix(data, na_action="ignore")).astype(float)[list(self.names)]

    @property
    def params_path(self) -> pd.DataFrame:
        """Coefficients after every row, (T, k), from that row and those before it."""
        return pd.DataFrame(self.run.theta, self.endog.index, self.names)

    @property
    def bse_path(self) -> pd.DataFrame:
        """Their standard errors, (T, k)."""
        return pd.DataFrame(self.run.std, self.endog.index, self.names)

    @cached_property
    def smoothed_path(self) -> pd.DataFrame:
        """Coefficients at every row, (T, k), from all rows."""
        return pd.DataFrame(self.run.smooth().theta, self.endog.index, self.names)

    @property
    def fittedvalues(self) -> pd.Series:
        """x_t' params_(t-1), (T,): the regressors of each row times the coefficients after the row before."""
        before = np.concatenate([self.run.fresh()["theta"][..., 0], self.run.theta[:-1]])
        X = np.column_stack([self.run.u, np.ones(len(self.run))])[:, : len(self.names)]
        return pd.Series(np.sum(X * before, axis=1), self.endog.index, name="fittedvalues")

    @property
    def resid(self) -> pd.Series:
        """Outputs minus ``fittedvalues``, (T,)."""
        return (self.endog - self.fittedvalues).rename("resid")

    @property
    def forecasts(self) -> pd.Series:
        """One-step predictions of the tracker, (T,): of each row from those before it."""
        return pd.Series(self.run.prediction, self.endog.index, name="forecasts")

    @property
    def forecasts_error(self) -> pd.Series:
        """One-step prediction errors, (T,): outputs minus ``forecasts``."""
        return pd.Series(self.run.innovation, self.endog.index, name="forecasts_error")

    @property
    def llf(self) -> float:
        """Log-likelihood; with a diffuse start its diffuse form, see "Likelihood" in the chapter on tuning."""
        return self.run.loglik

    @property
    def aic(self) -> float:
        """Akaike's criterion, the coefficients counted whose start is unknown (`Track.aic`)."""
        return self.run.aic()

    @property
    def bic(self) -> float:
        """Schwarz's criterion, see `Track.bic`."""
        return self.run.bic()

    @property
    def nobs(self) -> int:
        """Number of rows that were used."""
        return int(np.sum(self.run.ok))

    @cached_property
    def recursive_residuals(self) -> pd.Series:
        """One-step errors of constant coefficients, each over its standard deviation, (T,).

        w_t = (y_t - x_t' beta_(t-1)) / sqrt(1 + x_t' (X'X)^-1 x_t) of Brown, Durbin and Evans (1975, eq. 2), whatever
        the tracker; NaN until the coefficients are determined.
        """
        run = self.run
        constant = track(run.model, Kalman(q=0.0, r=1.0), run.y, run.u)
        fit = constant.ok.astype(bool) & np.isfinite(constant.innovation_std)
        errors = constant.innovation / np.where(fit, constant.innovation_std, 1.0)
        return pd.Series(np.where(fit, errors, np.nan), self.endog.index, name="recursive residuals")

    @property
    def cusum(self) -> pd.Series:
        """Cumulative sum of the recursive residuals over their standard deviation, (T,), eq. 5 of the same paper."""
        w = self.recursive_residuals
        return (w.cumsum() / w.std(ddof=1)).rename("cusum")

    def cusum_limits(self, alpha: float = 0.05) -> pd.DataFrame:
        """Lower and upper limits of `cusum` if the coefficients are constant, (T, 2).

        +- a (sqrt(N) + 2 i / sqrt(N)) at the i-th of N errors, a = 1.143, .948, .850 for alpha = .01, .05, .10 (Brown,
        Durbin and Evans 1975, eq. 8). ValueError for another alpha.
        """
        factors = {0.01: 1.143, 0.05: 0.948, 0.10: 0.850}
        if alpha not in factors:
            raise ValueError(f"cusum_limits: alpha={alpha} has no tabulated factor; choose from {sorted(factors)}.")
        there = self.recursive_residuals.notna()
        root = np.sqrt(max(int(there.sum()), 1))
        limit = factors[alpha] * (root + 2 * np.cumsum(there) / root)
        return pd.DataFrame({"lower": -limit, "upper": limit}, self.endog.index)

    def plot_cusum(self, alpha: float = 0.05, ax: Any = None) -> Figure:
        """`cusum` with its limits. A path that leaves them contradicts constant coefficients.

        Returns a matplotlib figure; ``ax`` as for `Track.plot`.
        """
        return self._path(self.cusum, self.cusum_limits(alpha), f"CUSUM, limits at {alpha:.0%}", ax)

    @property
    def cusum_squares(self) -> pd.Series:
        """Sum of the squared recursive residuals so far over that of all, (T,), eq. 10 of the same paper."""
        squares = self.recursive_residuals**2
        return (squares.cumsum() / squares.sum()).rename("cusum of squares")

    def cusum_squares_limits(self, alpha: float = 0.05) -> pd.DataFrame:
        """Lower and upper limits of `cusum_squares` if coefficients and noise variance are constant, (T, 2).

        i / N -+ c at the i-th of N errors, c = a_1 / sqrt(n) + a_2 / n + a_3 / sqrt(n)^3, n = N / 2 - 1, with the
        coefficients of Edgerton and Wells (1994, table 1). ValueError for an alpha other than .01, .02, .05, .10, .20.
        """
        if alpha not in _SQUARES:
            raise ValueError(f"cusum_squares_limits: alpha={alpha} is not tabulated; choose from {sorted(_SQUARES)}.")
        there = self.recursive_residuals.notna()
        n = 0.5 * max(int(there.sum()), 4) - 1.0
        half = float(np.dot(_SQUARES[alpha], [n**-0.5, 1.0 / n, n**-1.5]))
        line = np.cumsum(there) / max(int(there.sum()), 1)
        return pd.DataFrame({"lower": line - half, "upper": line + half}, self.endog.index)

    def plot_cusum_squares(self, alpha: float = 0.05, ax: Any = None) -> Figure:
        """`cusum_squares` with its limits; it leaves them when the noise variance or a coefficient changes.

        Returns a matplotlib figure; ``ax`` as for `Track.plot`.
        """
        limits = self.cusum_squares_limits(alpha)
        return self._path(self.cusum_squares, limits, f"CUSUM of squares, limits at {alpha:.0%}", ax)

    def _path(self, path: pd.Series, limits: pd.DataFrame, title: str, ax: Any) -> Figure:
        figure, (axis,) = panels(ax, (8.0, 3.0))
        axis.plot(_places(self.endog), path, color=BLUE)
        axis.plot(_places(self.endog), limits, color=RED, linestyle="--", linewidth=1)
        axis.plot(_places(self.endog), limits.mean(axis=1), color="black", linewidth=0.6)
        axis.set_title(title)
        return figure

    def plot_coefficients(self, level: float = 0.95, ax: Any = None) -> Figure:
        """Every coefficient over time with its band, the prediction and the errors; ``ax`` as for `Track.plot`."""
        return self.run.plot(level, ax)

    def summary(self, alpha: float = 0.05) -> CoefficientTable:
        """The table of coefficients after the last row, as text, HTML or LaTeX."""
        limits = self.conf_int(alpha)
        t = "t" if np.isfinite(self.df_resid) else "z"
        table = pd.DataFrame({
            "coef": self.params, "std err": self.bse, t: self.tvalues, f"P>|{t}|": self.pvalues,
            f"[{alpha / 2:g}": limits[0], f"{1 - alpha / 2:g}]": limits[1],
        })  # fmt: skip
        facts = {
            "Dep. Variable": str(self.endog.name), "Tracker": repr(self.run.tracker), "Model": repr(self.run.model),
            "No. Observations": str(self.nobs), "Df Residuals": f"{self.df_resid:g}",
            "Log-Likelihood": f"{self.llf:.3f}",
            "AIC, BIC": f"{self.aic:.2f}, {self.bic:.2f}",
            **dict((*remarks_of(self.run.left_out), *not_learned(self.run))),
        }  # fmt: skip
        apart = float(np.sqrt(np.mean((self.forecasts - self.fittedvalues)[self.run.ok] ** 2)))
        if apart > 1e-9 * float(np.sqrt(np.mean(self.run.y[self.run.ok] ** 2))):
            facts["Forecasts"] = f"fittedvalues, and correlated noise or slopes ({apart:.4g}, root mean square)"
        return CoefficientTable(facts, table)


@dataclass(frozen=True)
class CoefficientTable:
    """The result of `summary`; ``print`` shows it as text, and a notebook as HTML."""

    facts: dict[str, str]
    table: pd.DataFrame

    def as_text(self) -> str:
        """Plain text."""
        body, width = self.table.to_string(float_format="{:.4f}".format), max(map(len, self.facts)) + 2
        longest = max(WIDTH, *map(len, body.splitlines()))
        facts = [f"{name + ':':<{width}}{value}" for name, value in self.facts.items()]
        lines = [line for fact in facts for line in wrap(fact, longest, subsequent_indent=" " * width)]
        rule = "=" * max(map(len, [*lines, *body.splitlines()]))
        return "\n".join([rule, *lines, rule, body, rule])

    def as_html(self) -> str:
        """Two HTML tables."""
        facts = pd.Series(self.facts).to_frame().to_html(header=False)
        table: str = self.table.to_html(float_format="{:.4f}".format)
        return f"{facts}{table}"

    def as_latex(self) -> str:
        """A LaTeX tabular."""
        rows = [" & ".join(["", *map(_escaped, self.table.columns)])]
        rows += [" & ".join([_escaped(str(name)), *(f"{x:.4f}" for x in row)]) for name, row in self.table.iterrows()]
        facts = [rf"\multicolumn{{1}}{{l}}{{{_escaped(k)}}} & \multicolumn{{6}}{{l}}{{{_escaped(v)}}}"
                 for k, v in self.facts.items()]  # fmt: skip
        body = " \\\\\n".join(facts) + " \\\\\n\\hline\n" + rows[0] + " \\\\\n\\hline\n" + " \\\\\n".join(rows[1:])
        return "\\begin{tabular}{lrrrrrr}\n\\hline\n" + body + " \\\\\n\\hline\n\\end{tabular}"

    def __str__(self) -> str:
        return self.as_text()

    def _repr_html_(self) -> str:
        return self.as_html()


def _numbers(side: Any, factors: Mapping[str, Any]) -> pd.DataFrame:
    """A side of a formula as numbers, NaN in all columns of a row in which one of its factors is missing.

    A missing category would otherwise be in no column, and so be the reference level.
    """
    table = pd.DataFrame(side).astype(float)
    missing = set().union(*(find_nulls(factors[factor.expr].values) for factor in side.model_spec.factors))
    table.iloc[sorted(missing)] = np.nan
    return table


def _escaped(text: str) -> str:
    """Text in which LaTeX's special characters are escaped."""
    special = {"&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "|": r"\textbar{}", ">": r"\textgreater{}"}
    return "".join(special.get(letter, letter) for letter in text)


def _places(endog: pd.Series) -> Any:
    """The index as matplotlib takes it."""
    index = endog.index
    return index.to_timestamp() if isinstance(index, pd.PeriodIndex) else index

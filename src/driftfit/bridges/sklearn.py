"""A tracked regression as a scikit-learn estimator.

    y_t = x_t' coef_t + intercept_t (+ a_1 y_(t-1) + .. + a_lags y_(t-lags)) + noise

Rows are samples in order of time, and coefficients drift from row to row. `fit` tracks the rows from first to last; if
their index of dates is not in order, it sorts them and warns. `predict` uses the coefficients after the last row
(`coef_`) for later rows; `coef_path_` has the coefficients after every row. `partial_fit` continues after the last row.

The order of rows matters: a shuffled split (``KFold(shuffle=True)``, ``train_test_split`` with its default) lets the
estimator look ahead and scores predictions that could not have been made. Use ``TimeSeriesSplit``.

Settings of the tracker are parameters of the estimator:

    GridSearchCV(TrackedRegressor(RLS(0.98)), {"tracker__forgetting": [0.9, 0.99]}, cv=TimeSeriesSplit())
    GridSearchCV(TrackedRegressor(), {"tracker": [AdaptiveKalman(), RLS(0.98)]}, cv=TimeSeriesSplit())

Needs scikit-learn 1.6 or later (``pip install "driftfit[sklearn]"``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_array, check_is_fitted, column_or_1d, validate_data

from driftfit.data.arguments import chronological, dated, held
from driftfit.engine.kernel import Array
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.results import Track
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.base import Tracker
from driftfit.tracking import track


class TrackedRegressor(RegressorMixin, BaseEstimator):
    """Linear regression whose coefficients are tracked while they change.

    Parameters
    ----------
    tracker : Tracker or None
        How coefficients are tracked; None is ``AdaptiveKalman()``, which needs no settings.
    lags : int
        Number of output lags among the regressors. With lags, `predict` assumes that its rows directly follow the
        fitted rows, and uses its own predictions as outputs.
    fit_intercept : bool
        Whether the model has an intercept, which drifts too.
    gate : bool, Gate or None
        Whether readings are judged before they are used, as for `driftfit.track`; ``run_.left_out`` lists what was not.

    Attributes
    ----------
    coef_, coef_std_ : (n_features,)
        Coefficients of the inputs after the last row, and their standard deviations.
    intercept_ : float
    coef_path_ : (n_rows, n_features)
        Coefficients after every row.
    lag_coef_ : (lags,)
    run_ : Track
        The underlying run: `run_.summary()`, `run_.verdict()`, `run_.plot()`. After `partial_fit`, of its rows only.
    n_features_in_, feature_names_in_
        As in every estimator.
    """

    def __init__(
        self, tracker: Tracker | None = None, lags: int = 0, fit_intercept: bool = True, gate: Any = None
    ) -> None:
        self.tracker = tracker
        self.lags = lags
        self.fit_intercept = fit_intercept
        self.gate = gate

    def fit(self, X: Any, y: Any, sample_weight: Any = None) -> Self:
        """Track rows X (n_rows, n_features) with outputs y (n_rows,), in order of time. NaN is missing in both.

        The noise variance of a row is inversely proportional to its ``sample_weight`` (n_rows,); a row of weight 0 is
        not used, and coefficients drift during it as during any other. ValueError for cells that are no numbers.
        """
        return self._follow(X, y, sample_weight, first=True)

    def partial_fit(self, X: Any, y: Any, sample_weight: Any = None) -> Self:
        """Continue with rows that follow those fitted so far; the first call is a `fit`."""
        return self._follow(X, y, sample_weight, first=not hasattr(self, "run_"))

    def predict(self, X: Any, return_std: bool = False) -> Any:
        """Outputs (n_rows,) of rows after the last fitted one; with ``return_std`` also their standard deviations.

        A standard deviation is that of an output. It includes the noise, the uncertainty of the coefficients, and their
        drift up to that row. It is NaN for a tracker without a covariance.
        """
        check_is_fitted(self)
        index: Any = getattr(X, "index", None)
        X = validate_data(self, X, reset=False, dtype=float, ensure_all_finite="allow-nan")
        if self.lags == 0 and not return_std:
            return X @ self.coef_ + self.intercept_
        order = np.argsort(index.asi8, kind="stable") if dated(index) else np.arange(len(X))
        ahead, place = self.run_.forecast(len(X), X[order]), np.argsort(order)
        mean = X @ self.coef_ + self.intercept_ if self.lags == 0 else ahead.y_hat[place]
        return (mean, ahead.y_std[place]) if return_std else mean

    def _follow(self, X: Any, y: Any, sample_weight: Any, first: bool) -> Self:
        rows = chronological(getattr(X, "index", None))
        if not isinstance(rows, slice):
            X, y = X.iloc[rows], y.iloc[rows] if hasattr(y, "iloc") else np.asarray(y)[rows]
        if hasattr(X, "columns") and len(X):
            held("X", X)  # names the column of a cell that is no number
        X = validate_data(self, X, reset=first, dtype=float, ensure_all_finite="allow-nan")
        weights: Any = 1.0
        if sample_weight is not None:
            weights = check_array(
                np.asarray(sample_weight)[rows], ensure_2d=False, dtype=float, ensure_non_negative=True
            )
            if weights.shape != (len(X),):
                raise ValueError(
                    f"sample_weight must be ({len(X)},), one for each row of X; got shape {weights.shape}."
                )
            if not weights.any():
                raise ValueError("sample_weight is zero for every row, so there is nothing to fit.")
        if y is None:
            raise ValueError("this TrackedRegressor estimator requires y to be passed, but the target y is None.")
        y = check_array(y, ensure_2d=False, dtype=float, ensure_all_finite="allow-nan", input_name="y")
        y = column_or_1d(y, warn=True)
        if y.shape != (len(X),):
            raise ValueError(f"y must be ({len(X)},), one output for each row of X; got shape {y.shape}.")
        if first and not np.isfinite(y).any():
            raise ValueError("y holds no number: every output is NaN, so there is nothing to fit.")
        before = None if first else self.run_
        tracker = AdaptiveKalman() if self.tracker is None else self.tracker
        self.run_: Track = track(
            self._model(X.shape[1]), tracker, y, X, weights=weights, gate=self.gate, warm_start=before
        )
        lags, m = self.lags, X.shape[1]
        self.coef_path_: Array = self.run_.theta[:, lags : lags + m]
        self.coef_: Array = self.coef_path_[-1].copy()
        self.coef_std_: Array = self.run_.std[-1, lags : lags + m].copy()
        self.lag_coef_: Array = self.run_.theta[-1, :lags].copy()
        self.intercept_ = float(self.run_.theta[-1, -1]) if self.fit_intercept else 0.0
        return self

    def _model(self, m: int) -> Model:
        names = tuple(getattr(self, "feature_names_in_", ()))
        inputs: Any = names if names else m
        if self.lags == 0:
            return Regression(inputs, intercept=self.fit_intercept)
        return ARX(self.lags, 1, nk=0, inputs=inputs, intercept=self.fit_intercept)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Parameters of the estimator; with ``deep`` also the settings of the tracker as ``tracker__NAME``."""
        found: dict[str, Any] = super().get_params(deep=False)
        if deep and isinstance(self.tracker, Tracker):
            found |= {f"tracker__{name}": value for name, value in self.tracker.settings().items()}
        return found

    def set_params(self, **params: Any) -> Self:
        """Set parameters; ``tracker__NAME`` replaces the tracker by one with that setting."""
        settings = {name[9:]: params.pop(name) for name in list(params) if name.startswith("tracker__")}
        super().set_params(**params)
        if settings:
            if not isinstance(self.tracker, Tracker):
                raise ValueError(f"set_params: there is no tracker whose {', '.join(settings)} could be set.")
            unknown = settings.keys() - self.tracker.settings().keys()
            if unknown:
                raise ValueError(f"Invalid parameter {', '.join(sorted(unknown))!r} for {self.tracker!r}.")
            self.tracker = replace(self.tracker, **settings)  # type: ignore[type-var]  # every tracker is a dataclass
        return self

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags

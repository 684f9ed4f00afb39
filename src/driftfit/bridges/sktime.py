"""A tracked ARX model as a sktime forecaster.

    y_t = sum a_i,t y_(t-i) + b_t' x_t + intercept_t + noise,    parameters drift from row to row

`fit` tracks the rows in their order; `predict` and the interval forecasts are those of `Track.forecast`: parameters
keep drifting over the horizon, and bands include the noise, the uncertainty of the parameters and their drift. `update`
continues after the last row; with ``update_params=False`` the new rows enter the lags only. Missing values may be in y
and in X. Rows are one step apart, whatever their index; sktime refuses an index that is not in order, and of rows with
one date the first is used, with a warning.

Needs sktime 1.0 or later (``pip install "driftfit[sktime]"``).
"""

from __future__ import annotations

from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd
from scipy.special import ndtri
from sktime.forecasting.base import BaseForecaster

from driftfit.data.arguments import chronological
from driftfit.engine.kernel import Array
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.results import Track
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.base import Tracker
from driftfit.tracking import track
from driftfit.use.forecast import Forecast


class TrackedForecaster(BaseForecaster):
    """Forecast with an ARX model whose parameters are tracked while they change.

    Parameters
    ----------
    tracker : Tracker or None
        How parameters are tracked; None is ``AdaptiveKalman()``, which needs no settings.
    lags : int
        Number of output lags.
    fit_intercept : bool
        Whether the model has an intercept, which drifts too.
    gate : bool, Gate or None
        Whether readings are judged before they are used, as for `driftfit.track`; ``run_.left_out`` lists what was not.

    Attributes
    ----------
    run_ : Track
        The underlying run: `run_.summary()`, `run_.verdict()`, `run_.plot()`. After `update`, of its rows only.

    Examples
    --------
    >>> from driftfit.bridges.sktime import TrackedForecaster
    >>> from sktime.datasets import load_airline
    >>> forecaster = TrackedForecaster(lags=12).fit(load_airline())
    >>> forecaster.predict(fh=[1, 2, 3]).shape
    (3,)
    """

    _tags: ClassVar[dict[str, Any]] = {
        "python_dependencies": "driftfit",
        "y_inner_mtype": "pd.Series",
        "X_inner_mtype": "pd.DataFrame",
        "scitype:y": "univariate",
        "capability:exogenous": True,
        "capability:missing_values": True,
        "capability:pred_int": True,
        "capability:pred_int:insample": False,
        "capability:insample": False,
        "capability:non_contiguous_X": False,
        "requires-fh-in-fit": False,
        "X-y-must-have-same-index": True,
        "enforce_index_type": None,
    }

    _config: ClassVar[dict[str, Any]] = {"remember_data": False}  # the state contains what the past is needed for

    def __init__(
        self, tracker: Tracker | None = None, lags: int = 2, fit_intercept: bool = True, gate: Any = None
    ) -> None:
        self.tracker = tracker
        self.lags = lags
        self.fit_intercept = fit_intercept
        self.gate = gate
        super().__init__()

    def _fit(self, y: pd.Series, X: pd.DataFrame | None, fh: Any) -> Self:
        self._columns, self._name = [] if X is None else list(X.columns), y.name
        tracker = AdaptiveKalman() if self.tracker is None else self.tracker
        self.run_: Track = track(self._model(), tracker, *self._signals(y, X), gate=self.gate)
        return self

    def _update(self, y: pd.Series, X: pd.DataFrame | None = None, update_params: bool = True) -> Self:
        weights = 1.0 if update_params else 0.0
        before = self.run_
        signals: Any = self._signals(y, X)
        self.run_ = track(before.model, before.tracker, *signals, weights=weights, gate=self.gate, warm_start=before)
        return self

    def _predict(self, fh: Any, X: pd.DataFrame | None) -> pd.Series:
        ahead, rows = self._ahead(fh, X)
        return pd.Series(ahead.y_hat[rows], index=fh.to_absolute_index(self.cutoff), name=self._name)

    def _predict_quantiles(self, fh: Any, X: pd.DataFrame | None, alpha: list[float]) -> pd.DataFrame:
        ahead, rows = self._ahead(fh, X)
        name = self._get_varnames()[0]
        values = ahead.y_hat[rows, None] + ahead.y_std[rows, None] * ndtri(np.asarray(alpha))
        columns = pd.MultiIndex.from_product([[name], alpha])
        return pd.DataFrame(values, index=fh.to_absolute_index(self.cutoff), columns=columns)

    def _ahead(self, fh: Any, X: pd.DataFrame | None) -> tuple[Forecast, Array]:
        """The forecast of all steps up to the last that is asked for, and the rows of those that are."""
        steps = np.asarray(fh.to_relative(self.cutoff).to_pandas(), dtype=int)
        inputs = None if not self._columns else self._signals(None, X)[1]
        return self.run_.forecast(int(steps.max()), None if inputs is None else inputs[: steps.max()]), steps - 1

    def _signals(self, y: pd.Series | None, X: pd.DataFrame | None) -> tuple[Any, Any]:
        """Outputs (T,) and inputs (T, m) as numbers; None where there are none."""
        rows = slice(None) if y is None else chronological(y.index)
        outputs = None if y is None else y.to_numpy(dtype=float)[rows]
        inputs = None if X is None or not self._columns else X[self._columns].to_numpy(dtype=float)[rows]
        return outputs, inputs

    def _model(self) -> Model:
        m = len(self._columns)
        if self.lags == 0:
            return Regression(m, intercept=self.fit_intercept)
        return ARX(self.lags, (1,) * m if m else 0, nk=0, intercept=self.fit_intercept)

    @classmethod
    def get_test_params(cls, parameter_set: str = "default") -> list[dict[str, Any]]:
        """Settings for sktime's own checks."""
        from driftfit.trackers.rls import RLS

        return [{"tracker": RLS(0.98), "lags": 1}, {"tracker": RLS(1.0), "lags": 2, "fit_intercept": False}]

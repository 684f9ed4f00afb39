"""A tracked regression as a river regressor: one dictionary of features at a time.

    y_t = sum over features of x_t[f] coef_t[f] + intercept_t + noise

`learn_one` is one `Live.update`, `predict_one` one `Live.predict`. A feature that is absent from a dictionary counts as
0, as in river's linear models; a feature that is there as NaN or None is missing, and a sample with a missing feature
is not used. Features may appear at any time: as absent means 0, one that is new has been 0 so far, which is
exact as long as the model has a free column. When it has none, the model is made twice as wide and learns the last
`window` samples again.

Needs river 0.21 or later (``pip install "driftfit[river]"``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from river import base

from driftfit.data.storage import parts_of
from driftfit.engine.kernel import Array
from driftfit.models.regression import Regression
from driftfit.streams import Live
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.base import Tracker


class TrackedRegressor(base.Regressor):
    """Linear regression whose coefficients are tracked while they change.

    Parameters
    ----------
    tracker
        How coefficients are tracked; None is ``AdaptiveKalman()``, which needs no settings.
    fit_intercept
        Whether the model has an intercept, which drifts too.
    window
        Number of samples that are kept, to be learned again when the features outgrow the model.
    gate
        Whether readings are judged before they are used, as for `driftfit.Live`.

    Notes
    -----
    Memory is constant while no new feature appears. The output of a sample that cannot be predicted (before the first
    sample, or with a missing feature) is 0, as in river's linear models. While fewer than 5 n outputs have been learned
    (n parameters), predictions are clipped to the range of these outputs: `progressive_val_score` counts from the
    first sample on, where least squares of few samples extrapolates without bounds.

    Examples
    --------
    >>> from driftfit import RLS
    >>> from driftfit.bridges.river import TrackedRegressor
    >>> model = TrackedRegressor(RLS(0.99))
    >>> for t in range(100):
    ...     x = {"pressure": float(t % 7), "current": float(t % 5)}
    ...     model.learn_one(x, 2 * x["pressure"] - x["current"] + 1)
    >>> round(model.predict_one({"pressure": 3.0, "current": 1.0}), 3)
    6.0
    >>> {name: round(value, 3) for name, value in model.coef.items()}
    {'current': -1.0, 'pressure': 2.0}

    """

    def __init__(
        self, tracker: Tracker | None = None, fit_intercept: bool = True, window: int = 200, gate: Any = None
    ) -> None:
        self.tracker = tracker
        self.fit_intercept = fit_intercept
        self.window = window
        self.gate = gate
        self._columns: dict[Any, int] = {}
        self._past: deque[tuple[dict[Any, float], float]] = deque(maxlen=window)
        self._count = 0
        self._range = (np.inf, -np.inf)
        self._hold(None)

    def _hold(self, live: Live | None) -> None:
        """Keep a stream, and its state for river to count.

        river measures a model by walking through all that it refers to, functions excepted. A stream refers to compiled
        code that all models share, so it is behind a function.
        """
        self._stream: Callable[[], Live | None] = lambda: live
        self._state = {} if live is None else live.lane()
        self._width = 0 if live is None else live.model.m
        self._early = 0 if live is None else 5 * live.model.n

    @property
    def _live(self) -> Live | None:
        return self._stream()

    def __getstate__(self) -> dict[str, Any]:
        live = self._live
        return {**self.__dict__, "_stream": None if live is None else live.to_bytes(), "_state": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._hold(None if state["_stream"] is None else Live.from_bytes(state["_stream"], parts_of(self.tracker)))

    def learn_one(self, x: dict[Any, Any], y: Any) -> None:
        """Learn one sample: features by name, and the output; None and NaN are missing.

        ValueError for a feature that is a category.
        """
        output, x = _number(y, "the output"), _numbers(x)
        known, live = len(self._columns), self._live
        if live is None or not x.keys() <= self._columns.keys():
            for name in sorted(x.keys() - self._columns.keys(), key=str):
                self._columns[name] = len(self._columns)
            if live is None or len(self._columns) > self._width:
                live = self._widen(len(self._columns) if known == 0 else 2 * known)
        live.update(output, self._row(x, self._width))
        self._past.append((x, output))
        if self._count < self._early and np.isfinite(output):
            self._count += 1
            self._range = (min(self._range[0], output), max(self._range[1], output))

    def predict_one(self, x: dict[Any, Any]) -> float:
        """The output that is expected for these features."""
        live = self._live
        if live is None:
            return 0.0
        y_hat = live.predict(self._row(_numbers(x), self._width))[0]
        if not np.isfinite(y_hat):
            return 0.0
        return float(np.clip(y_hat, *self._range)) if 0 < self._count < self._early else y_hat

    @property
    def coef(self) -> dict[Any, float]:
        """The present coefficient of every feature that has appeared."""
        return self._by_name([] if self._live is None else self._live.theta)

    @property
    def coef_std(self) -> dict[Any, float]:
        """Its standard deviation; inf while the samples do not determine the coefficient."""
        return self._by_name([] if self._live is None else self._live.std)

    @property
    def intercept(self) -> float:
        """The present intercept; 0 if there is none."""
        return float(self._live.theta[-1]) if self._live is not None and self.fit_intercept else 0.0

    def _widen(self, m: int) -> Live:
        """A stream with m columns, for which the samples that are kept are learned again."""
        tracker = AdaptiveKalman() if self.tracker is None else self.tracker
        live = Live(Regression(max(m, 1), intercept=self.fit_intercept), tracker, gate=self.gate)
        for x, y in self._past:
            live.update(y, self._row(x, live.model.m))
        self._hold(live)
        return live

    def _row(self, x: dict[Any, float], m: int) -> Array:
        """The regressors (m,): an absent feature is 0. Unknown features are left out."""
        row, columns = [0.0] * m, self._columns
        for name, value in x.items():
            if name in columns:
                row[columns[name]] = value
        return np.array(row)

    def _by_name(self, values: Any) -> dict[Any, float]:
        return {name: float(values[column]) for name, column in self._columns.items() if column < len(values)}


def _numbers(x: dict[Any, Any]) -> dict[Any, float]:
    return {name: _number(value, f"the feature {name!r}") for name, value in x.items()}


def _number(value: Any, name: str) -> float:
    """A number, NaN for None; ValueError for a category."""
    try:
        return np.nan if value is None else float(value)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} is {value!r}, which is not a number; encode categories first, as river's "
            "preprocessing.OneHotEncoder() does, or leave them out."
        ) from None

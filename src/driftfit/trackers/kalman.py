"""The Kalman filter of a random walk.

    theta_t = theta_{t-1} + w_t,  w ~ N(0, q);    y_t = phi_t' theta_t + v_t,  v ~ N(0, r)

    predict    P <- P + q dt d,  or q_ij sqrt(d_i d_j) dt if every parameter has its own factor
    forecast   y_hat = phi' theta;  e = y - y_hat;  g = P phi;  h = phi' g;  s = h + r / w
    correct    theta <- theta + g e / s;  P <- P - g g' / s

with w the weight of the sample and d known factors of the drift, 1 unless given.

Use it if the size of the drift is known or can be tuned; `RLS` needs only a memory length, `AugmentedFLS` has no
covariance. Without excitation P grows by exactly q per sample: it is finite, and describes the growing uncertainty.

``volatility`` lets the noise variance move, as a random walk of log r (`driftfit.trackers.forms.volatility`): for
returns, inflation and whatever else is restless for a while. The weights of samples and the bands follow it.

``laws`` say more of single parameters: that they return to a mean, follow a trend or a season, or drift at their own
rate (`driftfit.trackers.laws.law`); all others remain random walks.

form="sqrt" keeps the square root of the information instead (`driftfit.trackers.forms.square_root`). It gives the same
numbers for ordinary data, and positive variances for collinear or badly scaled regressors and extreme ratios of q to r,
at O(n^3).

Source: Kalman (1960); as a parameter tracker Young, Recursive Estimation and Time-Series Analysis (2011), chapter 4.
Departures: only one triangle of P is kept; an exact diffuse start (`driftfit.trackers.forms.diffuse`), whose form also
takes samples after which P would be rounding. Cost per sample: O(n^2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.settings import check_numbers, matrix, one_of, vector
from driftfit.models.base import Model
from driftfit.trackers.base import RandomWalk, Tracker
from driftfit.trackers.forms import square_root
from driftfit.trackers.forms.covariance import correct, forecast, read_drift
from driftfit.trackers.forms.diffuse import SCRATCH, before_any_sample, drifted, started
from driftfit.trackers.forms.information import partly_known, triangular_root
from driftfit.trackers.forms.volatility import FIELDS, known_noise, log_density, smoothed_noise, volatile
from driftfit.trackers.laws import filter as laws_filter
from driftfit.trackers.laws.law import OWNER, Law, laws_of, table_of


@kernel
def drift(s: State, l: int) -> None:
    """P <- P + diag(q) dt d."""
    time = s.dt[l] * s.drift[l]
    for i in range(s.theta.shape[0]):
        s.P[i, i, l] += s.q[i, l] * (s.drift_root[i, l] * s.drift_root[i, l]) * time


@kernel
def drift_matrix(s: State, l: int) -> None:
    """P <- P + q dt d, with a matrix q."""
    time = s.dt[l] * s.drift[l]
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            s.P[i, j, l] += s.q[i, j, l] * (s.drift_root[i, l] * s.drift_root[j, l]) * time


@kernel
def drift_root_form(s: State, l: int) -> None:
    drifted(s, s.dt[l] * s.drift[l], l)


INDEPENDENT = started(TrackerSteps(drift, forecast, correct, read_extra=read_drift), drift_root_form)
TOGETHER = started(TrackerSteps(drift_matrix, forecast, correct, read_extra=read_drift), drift_root_form)


@dataclass(frozen=True)
class Kalman(Tracker):
    """Random-walk Kalman filter.

    Parameters
    ----------
    q : number, (n,), or (n, n)
        Drift covariance per nominal sample, in squared units of theta. 0 keeps a parameter constant; a number is that
        number times the identity.
    r : number
        Noise variance, in squared units of y; positive.
    p0 : number, (n,), (n, n), or None
        Covariance of theta before the first sample. None: the exact diffuse start.
    theta0 : number or (n,)
        Mean of theta before the first sample.
    form : "covariance" or "sqrt"
        "sqrt" for collinear or badly scaled regressors: variances are positive by construction.
    laws : mapping from the name of a parameter to a `Law` or several, or None
        How single parameters move, instead of a random walk. With laws q is a number or (n,), form is "covariance";
        theta0 and p0 are those of the levels, and slopes and seasons start from no knowledge.
    volatility : number or None
        Variance of the change of log r in a nominal sample; positive. r is then the noise variance before the first
        sample. None: r is constant.

    Raises
    ------
    ValueError
        If q or p0 is not a covariance (with form="sqrt" p0 must be positive definite), r or volatility is not
            positive, or laws do not fit.
    """

    q: Any = None
    r: float | None = None
    p0: Any = None
    theta0: Any = 0.0
    form: str = "covariance"
    laws: Any = None
    volatility: float | None = None

    required: ClassVar[tuple[str, ...]] = ("q", "r")
    scratch: ClassVar[tuple[str, ...]] = ("g", "R", *SCRATCH)
    drift_per_parameter: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_numbers(self, ("q", "p0"), ("r", "volatility"), ("theta0",))
        if one_of("Kalman", "form", self.form, ("covariance", "sqrt")) == "sqrt" and self.p0 is not None:
            p0 = np.asarray(self.p0)
            if not (np.linalg.eigvalsh(p0) if p0.ndim == 2 else p0).min() > 0.0:
                raise ValueError(
                    f'Kalman: with form="sqrt" p0 must be positive definite; got {self.p0!r}. Known parameters need '
                    'form="covariance".'
                )
        if self.volatility is not None:
            for name, value in FIELDS.items():
                self._set(name, value)
        self._set("laws", laws_of("Kalman", self.laws))
        if self.laws is not None and (self.form == "sqrt" or np.ndim(self.q) == 2):
            raise ValueError('Kalman: with laws every q is a number or (n,), and form must be "covariance".')

    def settings(self) -> dict[str, Any]:
        plain = super().settings()
        if self.laws is not None:
            plain["laws"] = tuple((name, law.settings()) for name, law in self.laws)
        return plain

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> Self:
        laws = settings.get("laws")
        given = None if laws is None else tuple((name, Law.from_settings(law)) for name, law in laws)
        return super().from_settings({**settings, "laws": given} if given else settings)

    def state_for(self, model: Model) -> Mapping[str, Any]:
        if self.laws is None:
            return self.state(model.n)
        names, n = model.names, model.n
        table = table_of("Kalman", self.laws, names, vector("Kalman", "q", self.q, n))
        p0 = None if self.p0 is None else matrix("Kalman", "p0", self.p0, n)
        means = {names.index(name): law.mean for name, law in self.laws if law.mean is not None}
        start = laws_filter.state(table, vector("Kalman", "theta0", self.theta0, n), p0, means)
        return {**start, "r": self.r, **self._noise()}

    def _noise(self) -> Mapping[str, Any]:
        return {} if self.volatility is None else known_noise(self.volatility)

    def state(self, n: int) -> Mapping[str, Any]:
        together, theta0 = np.ndim(self.q) == 2, vector("Kalman", "theta0", self.theta0, n)
        p0 = None if self.p0 is None else matrix("Kalman", "p0", self.p0, n)
        return {
            "theta": theta0,
            "P": np.zeros((n, n)) if p0 is None else p0,
            "q": matrix("Kalman", "q", self.q, n) if together else vector("Kalman", "q", self.q, n),
            "r": self.r,
            "g": np.zeros(n),
            "drift_root": np.ones(n),
            "G": triangular_root(matrix("Kalman", "q", self.q, n)),
            **before_any_sample(n, self.p0),
            **(square_root.state(theta0, p0) if self.form == "sqrt" else {}),
            **self._noise(),
        }

    def partly_known(self, n: int, N: int) -> Mapping[str, Any] | None:
        return None if self.laws else partly_known(self.state(n), self.state(N))

    @property
    def width(self) -> int:  # type: ignore[override]
        """Square roots and laws are updated by routines that take one lane at a time."""
        return 1 if self.form == "sqrt" or self.laws is not None else super().width

    @property
    def steps(self) -> TrackerSteps:
        together = TOGETHER if np.ndim(self.q) == 2 else INDEPENDENT
        steps = laws_filter.STEPS if self.laws is not None else square_root.STEPS if self.form == "sqrt" else together
        return steps if self.volatility is None else volatile(steps)

    def log_density(self, out: Array) -> Array | None:
        return None if self.volatility is None else log_density(out)

    def problem(self, fields: Mapping[str, Array], phi: Array) -> tuple[Array, Array, Array, Sequence[Sequence[int]]]:
        """The variance of the noise alone is estimated."""
        given: Array = np.empty(0)
        return given, smoothed_noise(fields), given, ()

    @property
    def beyond(self) -> str:
        return "" if self.laws is None else "has laws by which theta moves"

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        super().widen(lane, p)
        if self.laws is not None:
            levels = _levels(lane)
            lane["C"][levels, levels] += p

    def place(self, lane: Mapping[str, Array], which: Sequence[int], values: Array) -> None:
        if self.laws is not None:
            levels = _levels(lane)[list(which)]
            lane["x"][levels] += np.asarray(values) - lane["theta"][list(which)]
        super().place(lane, which, values)

    def random_walk(self, model: Model) -> RandomWalk:
        if self.laws is not None:
            raise ValueError("smoothing needs random walks; this Kalman has laws.")
        n = model.n
        p0 = None if self.p0 is None else matrix("Kalman", "p0", self.p0, n)
        return RandomWalk(matrix("Kalman", "q", self.q, n), self.r, vector("Kalman", "theta0", self.theta0, n), p0)


def _levels(lane: Mapping[str, Array]) -> Array:
    """The place of the level of every parameter among the components."""
    return np.array([int(np.argmax(lane["law"][OWNER] == i)) for i in range(len(lane["theta"]))])

"""A bank of hypotheses: Kalman filters along the histories of what may have happened, weighed by what they predict.

    theta_t = theta_{t-1} + w_t,  w ~ N(0, Q_i) under change i;    y_t = phi_t' theta_t + v_t,  v ~ N(0, r_j) under sensor j
    p(history, event | data) proportional to N(y_t; phi' m, phi' C- phi + r_j) p(event | history) p(history | data)

(a jump Markov linear system). Every history of events is a leaf with its own Gaussian; a reduction keeps their number
bounded (`driftfit.hypotheses.reduction`). What is reported at t, the mixture over all leaves, is computed after the
tree has grown by sample t and before it is reduced.

Use it where parameters stand still and sometimes jump, or where the sensor may fail: jumps are seen by their fit, not by
a compromise between following and averaging. Where parameters drift all the time `Kalman` is better and cheaper. Jumps
show only through the regressors: no excitation, no detection.

`Bank()` alone has no scale: see `driftfit.hypotheses.change`. With unknown noise variance (r of the nominal sensor left
None) q and p0 are in units of it, unless a ``guess`` of it is given.

A sample that is not used moves no weight: leaves widen by what may have happened, and depth counts used samples.
Until the regressors have full rank (and, with unknown noise, four residuals are there) only the first change acts.

Source: fixed-lag decisions and trees of hypotheses after the paper on Bayesian tracking of parameters with alternative
developments; Bar-Shalom, Li and Kirubarajan (2001), chapter 11; Andersson (1985) for the beam. Departures: leaves are
merged at the present, not at the root; log weights; output lags per leaf. Cost per sample: O(n^2) for every leaf update.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.drivers import TrackerSteps
from driftfit.hypotheses import advance as core
from driftfit.hypotheses import change as changes_
from driftfit.hypotheses import plan
from driftfit.hypotheses import reduction as reductions
from driftfit.hypotheses.advance import ARRAYS, bank, begin
from driftfit.hypotheses.change import Change
from driftfit.hypotheses.grow import FLOOR
from driftfit.hypotheses.leaves import FIRST
from driftfit.hypotheses.lookahead import NODES
from driftfit.hypotheses.prior import events
from driftfit.hypotheses.reduction import Beam, Decide, Hybrid, Reduction, Shape
from driftfit.hypotheses.sensor import STUCK, Sensor
from driftfit.kernel import Array, State, kernel, nothing
from driftfit.models.base import Model
from driftfit.settings import covariance, matrix, numbers, vector
from driftfit.trackers.adaptive_kalman import RESIDUALS, learn_start
from driftfit.trackers.base import Tracker
from driftfit.trackers.diffuse import enter, knowing, knowing_nothing, measurement, spanned_variance
from driftfit.trackers.excitation import learn_scales

IN_Y, IN_NOISE, IN_DT, IN_TIME, IN_OK, IN_SEEN, IN_VALID = range(7)
Y_HAT, S2, R, LEAST = core.Y_HAT, core.S2, core.R, core.LEAST
EVIDENCE, WINDOW, KEPT, LAST, CLOCK = core.EVIDENCE, core.WINDOW, core.KEPT, core.LAST, core.CLOCK


@kernel
def only_drift(s: State, l: int) -> None:
    """The first change, for the one filter before the bank starts."""
    time = s.dt[l] * s.drift[l] * s.factors[0, l]
    at = 0
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            s.P[i, j, l] = s.P[i, j, l] * s.maps[0, 0, l] + s.Q[0, at, l] * time
            at += 1
        unit = s.r[l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        s.P[i, i, l] += s.sizes[0, i, l] * unit * time


@kernel
def look(s: State, l: int) -> None:
    """Before the bank starts: no events, one leaf, lags as they come."""
    s.lag_prob[0, 0, l] = 1.0
    s.now[LAST, l] = s.y[l] if s.seen[l] > 0.0 else s.now[LAST, l]
    s.many[CLOCK, l] += 1
    na, first = s.own_lags.shape[0], s.B.shape[0] - s.own_lags.shape[0] + 1
    for i in range(na - 1, 1, -1):
        s.B[first + i - 1, 0, l] = s.B[first + i - 2, 0, l]
    if na > 1:
        known = s.y[l] if s.seen[l] > 0.0 else s.y_hat[l]
        s.B[first, 0, l] = known if abs(known) < np.inf else 0.0


@kernel
def settle(s: State, l: int) -> None:
    """Start the bank from the one filter."""
    if s.unknown[l] == 0 or s.count[l] >= RESIDUALS:
        n, R_, K = s.theta.shape[0], s.B.shape[0], s.B.shape[1]
        begin(
            s.B.reshape((R_, K)), s.T.reshape((s.T.shape[0], K)), s.theta.reshape(n), s.P.reshape((n, n)),
            s.count[l], max(s.squares[l], FLOOR * s.count[l] * s.power[l]), s.many.reshape(s.many.shape[0]),
            s.initial.shape[0],
        )  # fmt: skip
        for i in range(s.root.shape[0]):
            s.root[i, 0, l] = s.B[i, 0, l]
        s.scale[l] = 1.0
        s.settled[l] = 1


@kernel
def step(s: State, l: int) -> None:
    s.now[IN_Y, l], s.now[IN_NOISE, l], s.now[IN_DT, l], s.now[IN_TIME, l] = s.y[l], s.noise[l], s.dt[l], s.dt[l] * s.drift[l]
    s.now[IN_OK, l], s.now[IN_SEEN, l], s.now[IN_VALID, l] = s.ok[l], s.seen[l], s.valid[l]
    s.now[R, l], s.now[LEAST, l] = s.r[l], FLOOR * s.power[l] + 1e-300
    s.table[0, 0, l] = s.A.ctypes.data
    s.table[1, 0, l] = s.B.ctypes.data
    s.table[2, 0, l] = s.T.ctypes.data
    s.table[3, 0, l] = s.T2.ctypes.data
    s.table[4, 0, l] = s.X.ctypes.data
    s.table[5, 0, l] = s.links.ctypes.data
    s.table[6, 0, l] = s.group.ctypes.data
    s.table[7, 0, l] = s.slots.ctypes.data
    s.table[8, 0, l] = s.many.ctypes.data
    s.table[9, 0, l] = s.now.ctypes.data
    s.table[10, 0, l] = s.prior.ctypes.data
    s.table[11, 0, l] = s.phi.ctypes.data
    s.table[12, 0, l] = s.Q.ctypes.data
    s.table[13, 0, l] = s.sizes.ctypes.data
    s.table[14, 0, l] = s.c.ctypes.data
    s.table[15, 0, l] = s.factors.ctypes.data
    s.table[16, 0, l] = s.maps.ctypes.data
    s.table[17, 0, l] = s.theta0.ctypes.data
    s.table[18, 0, l] = s.sensors.ctypes.data
    s.table[19, 0, l] = s.chain.ctypes.data
    s.table[20, 0, l] = s.initial.ctypes.data
    s.table[21, 0, l] = s.given.ctypes.data
    s.table[22, 0, l] = s.loss.ctypes.data
    s.table[23, 0, l] = s.knobs.ctypes.data
    s.table[24, 0, l] = s.bases.ctypes.data
    s.table[25, 0, l] = s.stamps.ctypes.data
    s.table[26, 0, l] = s.decided.ctypes.data
    s.table[27, 0, l] = s.parts.ctypes.data
    s.table[28, 0, l] = s.root.ctypes.data
    s.table[29, 0, l] = s.samples.ctypes.data
    s.table[30, 0, l] = s.Qt.ctypes.data
    s.table[31, 0, l] = s.lag_prob.ctypes.data
    s.table[32, 0, l] = s.theta.ctypes.data
    s.table[33, 0, l] = s.P.ctypes.data
    bank(s.table.ctypes.data)
    for k in range(34):  # addresses are no part of the state
        s.table[k, 0, l] = 0
    s.y_hat[l], s.s[l], s.e[l] = s.now[Y_HAT, l], s.now[S2, l], s.y[l] - s.now[Y_HAT, l]
    s.evidence[l], s.window[l], s.kept[l] = s.now[EVIDENCE, l], s.now[WINDOW, l], s.now[KEPT, l]


@kernel
def correct(s: State, l: int) -> None:
    if s.settled[l] > 0:
        step(s, l)
        learn_scales(s, l)
    else:
        only_drift(s, l)
        measurement(s, l)
        learn_scales(s, l)
        if s.unknown[l] > 0:
            learn_start(s, l)
        look(s, l)
        settle(s, l)


@kernel
def start(s: State, l: int) -> None:
    only_drift(s, l)
    learn_scales(s, l)
    enter(s, l)
    if s.unknown[l] > 0 and s.s[l] < np.inf:
        learn_start(s, l)
    spanned_variance(s, l)
    look(s, l)
    if s.rank[l] == s.theta.shape[0] and s.unknown[l] == 0:
        settle(s, l)


@kernel
def variances(s: State, l: int) -> None:
    for i in range(s.theta.shape[0]):
        s.var[i, l] = s.P[i, i, l] * s.scale[l]


@kernel
def keep(o: State, s: State, l: int) -> None:
    """Store what tells of events."""
    for k in range(s.lag_prob.shape[0]):
        for e in range(s.lag_prob.shape[1]):
            o.lag_prob[k, e, l] = s.lag_prob[k, e, l]
    for k in range(s.decided.shape[0]):
        for e in range(3):
            o.decided[k, e, l] = s.decided[k, e, l]
    o.evidence[l], o.window[l], o.kept[l] = s.evidence[l], s.window[l], s.kept[l]


STEPS = TrackerSteps(nothing, correct, variances, start, keep)


@dataclass(frozen=True)
class Bank(Tracker):
    """Bank of hypotheses: parameters that may jump, sensors that may fail.

    Parameters
    ----------
    changes : list of Change
        What may happen to theta between samples; the first is the ordinary course. None: a small drift, and a rare
        jump of any parameter, free of scale.
    sensors : list of Sensor
        What the sensor may do; the first must be nominal. None: nominal, with unknown noise variance.
    transition : None, (H_d, H_d), (H, H), or a pair
        Markov prior P[from, to]: of the changes, of joint events (change i, sensor j at i H_m + j), or (changes,
        sensors). None: events are independent, with the probabilities that changes and sensors carry.
    reduce : Reduction
        How histories are kept few. None: Beam(9), or Hybrid(9) with more than one sensor.
    theta0, p0
        Mean and covariance of theta before the first sample; p0=None is the exact diffuse start.
    initial : (H,) or None
        Distribution of the first event. None: the prior probabilities, or what the transition leaves as it is.

    Raises
    ------
    ValueError
        If probabilities do not sum to 1, a matrix has the wrong shape or orientation, or the tree is too large.
    """

    changes: Any = None
    sensors: Any = None
    transition: Any = None
    reduce: Any = None
    theta0: Any = 0.0
    p0: Any = None
    initial: Any = None

    width: ClassVar[int] = 1
    outputs: ClassVar[tuple[str, ...]] = ("lag_prob", "window", "evidence", "kept", "decided")

    def __post_init__(self) -> None:
        for name, kind, what in (("changes", Change, "a Change"), ("sensors", Sensor, "a Sensor")):
            given = getattr(self, name)
            if given is not None:
                given = (given,) if isinstance(given, kind) else tuple(given)
                if not given or not all(isinstance(one, kind) for one in given):
                    raise ValueError(f"Bank: {name} must list at least one hypothesis, each {what}; got {given!r}.")
                self._set(name, given)
        if self.reduce is not None and not isinstance(self.reduce, Reduction):
            raise ValueError(f"Bank: reduce must be a reduction such as Beam(9) or Decide(3); got {self.reduce!r}.")
        if self.p0 is not None:
            self._set("p0", covariance("Bank", "p0", self.p0))
        self._set("theta0", numbers("Bank", "theta0", self.theta0))
        for name in ("transition", "initial"):
            value = getattr(self, name)
            self._set(name, None if value is None else _tuples(value))
        self._check()

    def _check(self) -> None:
        nominal, others = self._sensors[0], self._sensors[1:]
        if nominal.kind != "nominal" or any(other.kind == "nominal" for other in others):
            raise ValueError("Bank: the first sensor, and only that, must be Sensor.nominal(...).")
        self._shape, self._events  # noqa: B018  (both refuse what does not fit)
        self._reduction.losses(self._H)
        kinds = {other.kind for other in others}
        reduce = self._reduction
        if isinstance(reduce, Decide) and reduce.deepest == 1 and kinds & {"outlier", "additive"} and not reduce.force:
            raise ValueError(
                "Bank: Decide(1) with outliers always prefers the outlier and never adapts; use Decide(2) or deeper, "
                "Hybrid(9), or Decide(1, force=True)."
            )
        if "frozen" in kinds and self._alike:
            import warnings

            warnings.warn(
                "Bank: a frozen sensor stays frozen for a while, but events are independent here; give transition=.",
                stacklevel=4,
            )

    @property
    def _changes(self) -> tuple[Change, ...]:
        return self.changes or changes_.usual()

    @property
    def _sensors(self) -> tuple[Sensor, ...]:
        return self.sensors or (Sensor.nominal(),)

    @property
    def _reduction(self) -> Reduction:
        return self.reduce or (Beam() if len(self._sensors) == 1 else Hybrid())

    @property
    def _H(self) -> int:
        return len(self._changes) * len(self._sensors)

    @property
    def _shape(self) -> Shape:
        return self._reduction.shape(len(self._changes), len(self._sensors))

    @property
    def _events(self) -> tuple[Array, Array]:
        return events("Bank", self._changes, self._sensors, self.transition, self.initial)

    @property
    def _alike(self) -> bool:
        P = self._events[0]
        return bool((P == P[0]).all())

    @property
    def event_names(self) -> tuple[str, ...]:
        """Names of the joint events, in their order."""
        changes = [one.name or ("none" if i == 0 else f"change {i}") for i, one in enumerate(self._changes)]
        if len(self._sensors) == 1:
            return tuple(changes)
        return tuple(f"{change}, {sensor.name}" for change in changes for sensor in self._sensors)

    def settings(self) -> dict[str, Any]:
        plain = super().settings()
        for name in ("changes", "sensors"):
            plain[name] = None if plain[name] is None else tuple(one.settings() for one in plain[name])
        if self.reduce is not None:
            plain["reduce"] = {"kind": type(self.reduce).__name__, **self.reduce.settings()}
        return plain

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> Self:
        given = dict(settings)
        for name, kind in (("changes", Change), ("sensors", Sensor)):
            if given.get(name) is not None:
                given[name] = tuple(kind.from_settings(one) for one in given[name])  # type: ignore[attr-defined]
        if given.get("reduce") is not None:
            reduce = dict(given["reduce"])
            given["reduce"] = getattr(reductions, reduce.pop("kind")).from_settings(reduce)
        return cls(**given)

    def _sensor_table(self) -> Array:
        rows = []
        for one in self._sensors:
            width = -STUCK if one.resolution is None else one.resolution**2 / (2.0 * np.pi)
            rows.append([one.factor, one.value, float(one.kind == "frozen"), width, float(one.kind in ("additive", "frozen"))])
        return np.array(rows)

    def state(self, n: int) -> Mapping[str, Any]:
        return self._state(n, 0)

    def state_for(self, model: Model) -> Mapping[str, Any]:
        cleans = any(one.cleans for one in self._sensors)
        return self._state(model.n, getattr(model, "output_lags", 0) if cleans else 0)

    def _state(self, n: int, na: int) -> Mapping[str, Any]:
        nominal, shape = self._sensors[0], self._shape
        Hd, Hm, H, tri = len(self._changes), len(self._sensors), self._H, n * (n + 1) // 2
        chain, initial = self._events
        rows, K, W = FIRST + n + tri + na, shape.children, shape.floors
        lower = np.tril_indices(n)
        steps = [one.increments(n) for one in self._changes]
        unit = 1.0 if nominal.r is not None or nominal.guess is None else 1.0 / nominal.guess
        P0 = np.zeros((n, n)) if self.p0 is None else matrix("Bank", "p0", self.p0, n) * unit
        guessed = nominal.r is None and nominal.guess is not None
        now = np.zeros(core.SIZE)
        now[LAST], now[core.FADE], now[R] = np.nan, 1.0 if nominal.memory is None else 1.0 - 1.0 / nominal.memory, 1.0
        depth = shape.knobs[plan.DEPTH] if shape.knobs[0] == plan.REFILTER else 1
        theta0 = vector("Bank", "theta0", self.theta0, n)
        maps = [[0.0 if one.reset else 1.0 / one.forget, float(one.reset)] for one in self._changes]
        open_ended = shape.knobs[plan.WAIT] > 0.0
        fields = {
            "theta": theta0, "P": P0, "g": np.zeros(n), "c": np.zeros(n), "active": np.zeros(n), "power": 0.0,
            "seen_samples": 0.0, "r": 1.0 if nominal.r is None else nominal.r, "unknown": int(nominal.r is None),
            "scale": np.nan if nominal.r is None else 1.0,
            "count": nominal.nu if guessed else 0.0, "squares": nominal.nu * nominal.guess if guessed else 0.0,
            **(knowing_nothing(n) if self.p0 is None else knowing(n)),
            "settled": 0, "alike": int(self._alike), "evidence": 0.0, "window": 0.0, "kept": 1.0,
            "A": np.zeros((rows, shape.parents)), "B": np.zeros((rows, K)), "root": np.zeros((rows, 1)),
            "T": np.zeros((W * (H + 1), K)), "T2": np.zeros((W * (H + 1), K)),
            "X": np.zeros((tri + 3 * n + 8 + max(H, Hm), K)),
            "links": np.zeros((4, K + 1), int), "group": np.zeros(K, int),
            "slots": np.zeros(max(2 * K, int(shape.bases[0])) + 1, int), "many": np.zeros(core.COUNT, int),
            "now": now, "prior": np.zeros((H, K)), "Q": np.array([Q[lower] * unit for Q, _ in steps]),
            "Qt": np.zeros((Hd, tri)), "sizes": np.array([sizes for _, sizes in steps]), "factors": np.ones(Hd),
            "maps": np.array(maps), "theta0": theta0, "sensors": self._sensor_table(), "chain": chain,
            "initial": initial, "given": np.full(H, np.nan), "loss": self._reduction.losses(H),
            "knobs": shape.knobs, "bases": shape.bases, "stamps": np.zeros(shape.held),
            "decided": np.full((shape.held, 3), -1.0), "samples": np.zeros((int(depth) + 1, 3 + n)),
            "own_lags": np.zeros(na + 1), "lag_prob": np.zeros((W, H)),
            "phi": np.zeros(n), "parts": np.zeros((4 + NODES, K * H if open_ended else 1)),
        }  # fmt: skip
        table = np.zeros((35, 3), int)
        for k, name in enumerate(ARRAYS):
            table[k, 1:] = (1, *np.shape(fields[name]))[-2:]
        table[34] = na, fields["unknown"], fields["alike"]
        return {**fields, "table": table}

    @property
    def steps(self) -> TrackerSteps:
        bank.load()
        return STEPS


def _tuples(value: Any) -> Any:
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(_tuples(one) for one in value)
    return None if value is None else float(value)

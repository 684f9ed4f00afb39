"""A bank of hypotheses: Kalman filters along a tree of possible events, weighted by how well they predict.

    theta_t = theta_{t-1} + w_t,  w ~ N(0, Q_i) under change i;  y_t = phi_t' theta_t + v_t,  v ~ N(0, r_j), sensor j
    p(history, event | data) proportional to N(y_t; phi' m, phi' C- phi + r_j) p(event | history) p(history | data)

(a jump Markov linear system). Every history of events is a leaf of the tree with its own Gaussian; a reduction bounds
their number (`driftfit.bank.reduction`). The result at t, the mixture over all leaves, is computed after the
tree has grown by sample t and before it is reduced.

Use it if parameters are constant between occasional jumps, or if the sensor may fail: a jump is detected by its fit,
without a compromise between tracking and averaging. If parameters drift all the time, `Kalman` is better and cheaper.
Jumps are visible only through the regressors: without excitation there is no detection.

`Bank()` alone depends on no scale: see `driftfit.bank.change`. If the noise variance is unknown (r of the
nominal sensor is None), q and p0 are in units of it, unless a ``guess`` of it is given.

A sample that is not used changes no weight: the leaves are widened by the changes that may have happened, and depth
counts used samples. Until there are four residuals (with known noise: full rank, or four samples without a new
direction) only the first change acts. The tree then grows in the directions that the regressors span, and a later
direction enters as the exact limit of a wide prior. Until then changes that reset or return to a prior act only on what
has been determined.

Source: fixed-lag decisions and trees of hypotheses after the paper on Bayesian tracking of parameters with alternative
developments; Bar-Shalom, Li and Kirubarajan (2001), chapter 11; Andersson (1985) for the beam. Departures: leaves are
merged at the present, not at the root; log weights; output lags per leaf. Cost per sample: O(n^2) per leaf update.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.bank import change as changes_
from driftfit.bank import reduction as reductions
from driftfit.bank.change import Change
from driftfit.bank.layout import COUNTER, HEAD, MOST_REPORTED, ROW, SAMPLE, WHOLE
from driftfit.bank.leaves import forget
from driftfit.bank.leaves.leaf_matrix import FIRST, NU, S
from driftfit.bank.machine.advance import begin, limit_forgetting
from driftfit.bank.machine.steps import steps_of
from driftfit.bank.memory import SINGLE, arrays_of, outside, packed
from driftfit.bank.prior import chains, events, open_prior, per_sample
from driftfit.bank.reduction import Beam, Decide, Hybrid, Reduction, Resample, Shape
from driftfit.bank.sensor import Sensor
from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers, check_numbers, factor, matrix, vector, warn
from driftfit.models.base import Model
from driftfit.readings.repeats import unresolved
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.diffuse import ALMOST_ANY, WORST, knowing, knowing_nothing, take_root
from driftfit.trackers.forms.excitation import window
from driftfit.trackers.forms.information import triangular_root


@dataclass(frozen=True)
class Bank(Tracker):
    """Bank of hypotheses: parameters that may jump, sensors that may fail.

    Parameters
    ----------
    changes : list of Change
        Changes of theta between samples; the first is the normal course. If none has a prob, their probabilities are
        learned. None: a small drift, and a rare
        jump of any parameter, both scale-free.
    sensors : list of Sensor
        How the sensor may behave; the first must be nominal. None: nominal, with unknown noise variance. A spike is
        then one jump, and its end another: for readings with spikes give [Sensor.nominal(), Sensor.outlier()].
    transition : None, (H_d, H_d), (H, H), or a pair
        Markov prior P[from, to]: of the changes, of joint events (change i, sensor j at i H_m + j), or (changes,
        sensors). None: events are independent, with the probabilities of the changes and sensors.
    reduce : Reduction
        How the number of leaves is limited. None: Beam(9), Resample(9) if probabilities are learned, or Hybrid(9) with
        more than one sensor.
    theta0, p0
        Mean and covariance of theta before the first sample; p0=None is the exact diffuse start.
    initial : (H,) or None
        Distribution of the first event. None: the prior probabilities, or the stationary distribution of the chain.
    lag_variance : bool
        Whether leaves with their own output lags (additive outliers, a frozen sensor) carry their uncertainty
        (`driftfit.bank.leaves.lags`).

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
    lag_variance: bool = True

    width: ClassVar[int] = 1
    outputs: ClassVar[tuple[str, ...]] = ("report",)
    density: ClassVar[str] = "report"
    weighs: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, kind in PARTS.items():
            given = getattr(self, name)
            if given is not None:
                given = tuple(given) if isinstance(given, list | tuple) else (given,)
                if not given or not all(isinstance(one, kind) for one in given):
                    raise ValueError(
                        f"Bank: {name} must list at least one hypothesis, each a {kind.__name__}; got {given!r}."
                    )
                self._set(name, given)
        if self.reduce is not None and not isinstance(self.reduce, Reduction):
            raise ValueError(f"Bank: reduce must be a reduction such as Beam(9) or Decide(3); got {self.reduce!r}.")
        check_numbers(self, ("p0",), (), ("theta0",))
        self._set("transition", _tuples(self.transition))
        self._set("initial", _tuples(self.initial))
        self._check()

    def _check(self) -> None:
        nominal, others = self.all_sensors[0], self.all_sensors[1:]
        if nominal.kind != "nominal" or any(other.kind == "nominal" for other in others):
            raise ValueError("Bank: the first sensor, and only that, must be Sensor.nominal(...).")
        self._shape, self.event_probabilities  # noqa: B018  (both refuse what does not fit)
        if self.all_changes[0].reset:
            raise ValueError("Bank: the first change is the normal course of events and cannot be a reset.")
        if isinstance(self.reduction, reductions.FirstFloor) and any(one.forgets for one in self.all_changes):
            raise ValueError("Bank: FirstFloor supports random walks only; changes that forget need another reduction.")
        self.reduction.losses(self._count)
        kinds, reduce = {other.kind for other in others}, self.reduction
        if isinstance(reduce, Decide) and reduce.deepest == 1 and kinds & {"outlier", "additive"} and not reduce.force:
            raise ValueError(
                "Bank: Decide(1) with outliers always prefers the outlier and never adapts; use Decide(2) or deeper, "
                "Hybrid(9), or Decide(1, force=True)."
            )
        if "frozen" in kinds and self.independent:
            warn(
                "Bank: a frozen sensor stays frozen for a while, but events are independent here; give transition=.",
                UserWarning,
            )

    @property
    def all_changes(self) -> tuple[Change, ...]:
        """The changes, including those that `Bank()` supplies."""
        return self.changes or changes_.usual()

    @property
    def gated(self) -> bool:  # type: ignore[override]
        """A bank that is given changes or sensors has hypotheses about its readings."""
        return not self.changes and not self.sensors

    @property
    def all_sensors(self) -> tuple[Sensor, ...]:
        """The sensors, including those that `Bank()` supplies."""
        return self.sensors or (Sensor.nominal(),)

    @property
    def reduction(self) -> Reduction:
        """How the number of leaves is limited, including the default."""
        one = Resample(9) if self.learns else Beam()
        return self.reduce or (one if len(self.all_sensors) == 1 else Hybrid())

    @property
    def _count(self) -> int:
        return len(self.all_changes) * len(self.all_sensors)

    @property
    def _shape(self) -> Shape:
        return self.reduction.shape(len(self.all_changes), len(self.all_sensors))

    @property
    def event_probabilities(self) -> tuple[Array, Array]:
        return events("Bank", self.all_changes, self.all_sensors, self.transition, self.initial)

    @property
    def learns(self) -> bool:
        """Whether the probabilities of the changes are learned."""
        return open_prior(self.all_changes, self.transition, len(self.all_sensors))

    @property
    def independent(self) -> bool:
        """Whether every event is independent of earlier ones."""
        P = self.event_probabilities[0]
        return bool((P[0] == P).all())

    @property
    def _apart(self) -> bool:
        """Whether changes are independent of earlier ones, so that a gap is one level of the tree."""
        Hd, Hm = len(self.all_changes), len(self.all_sensors)
        if Hd == 1 or isinstance(self.reduction, reductions.FirstFloor):
            return False
        P = self.event_probabilities[0].reshape(-1, Hd, Hm)
        product = P.sum(axis=2)[0, :, None] * P.sum(axis=1)[:, None, :]
        return self.independent or bool(np.allclose(P, product, rtol=1e-12, atol=1e-15))

    @property
    def chained(self) -> bool:
        """Whether a gap is a chain of changes, all of them walks, of which leaves distinguish two courses."""
        merging = isinstance(self.reduction, reductions.IMM | reductions.FirstFloor)
        walks = not any(one.forgets for one in self.all_changes)
        return len(self.all_changes) > 1 and not self._apart and not merging and walks

    @property
    def change_names(self) -> tuple[str, ...]:
        """Names of the changes."""
        return tuple(one.name or (f"change {i}" if i else "none") for i, one in enumerate(self.all_changes))

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensor hypotheses."""
        return tuple(sensor.name for sensor in self.all_sensors)

    @property
    def event_names(self) -> tuple[str, ...]:
        """Names of the joint events, in order."""
        if len(self.all_sensors) == 1:
            return self.change_names
        return tuple(f"{change}, {sensor.name}" for change in self.change_names for sensor in self.all_sensors)

    def settings(self) -> dict[str, Any]:
        plain = super().settings()
        for name in PARTS:
            plain[name] = None if plain[name] is None else tuple(one.settings() for one in plain[name])
        if self.reduce is not None:
            plain["reduce"] = {"kind": type(self.reduce).__name__, **self.reduce.settings()}
        return plain

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> Self:
        given = dict(settings)
        for name, kind in PARTS.items():
            if given.get(name) is not None:
                given[name] = tuple(kind.from_settings(one) for one in given[name])
        if given.get("reduce") is not None:
            reduce = dict(given["reduce"])
            given["reduce"] = getattr(reductions, reduce.pop("kind")).from_settings(reduce)
        return cls(**given)

    def state(self, n: int) -> Mapping[str, Any]:
        return self._state(n, 0)

    def state_for(self, model: Model) -> Mapping[str, Any]:
        cleans = any(one.cleans for one in self.all_sensors)
        state = self._state(model.n, (model.output_lags or 0) if cleans else 0)
        if len(model.outputs) == 1 or model.shared:
            return state
        sizes = [np.size(state[name]) for name in ("memory", "report", "sample", "counters", "table")]
        sizes += [rows * columns for rows, columns in outside(model.n).values()]
        return {**state, "flat": np.zeros(sum(sizes))}

    def _state(self, n: int, na: int) -> Mapping[str, Any]:
        nominal = self.all_sensors[0]
        guessed = nominal.r is None and nominal.guess is not None
        unit = 1.0 if nominal.r is not None or nominal.guess is None else 1.0 / nominal.guess
        P0 = np.zeros((n, n)) if self.p0 is None else matrix("Bank", "p0", self.p0, n) * unit
        theta0 = vector("Bank", "theta0", self.theta0, n)
        count = nominal.nu if guessed else 0.0
        squares = count * (nominal.guess or 0.0)
        arrays = arrays_of(self, n, na, unit, theta0)
        scale = 1.0 if nominal.r is not None else np.nan
        sample = dict.fromkeys(SAMPLE._fields, 0.0) | {"reading": np.nan, "r": 1.0}
        sample["fade"] = 1.0 if nominal.memory is None else 1.0 - 1.0 / nominal.memory
        leaf = SimpleNamespace(**arrays, n=n, theta=theta0, cov=P0, **sample, **dict.fromkeys(COUNTER._fields, 0))
        again = isinstance(self.reduction, reductions.FirstFloor)  # which keeps samples in theta
        if self.p0 is not None and (nominal.r is not None or guessed):
            limit_forgetting.py_func(leaf)
            begin.py_func(leaf, count, squares)
            arrays["root"][:, 0], scale = arrays["leaves"][:, 0], 1.0
        start: dict[str, Any] = (
            dict(knowing_nothing(n, ALMOST_ANY if again else WORST)) if self.p0 is None else dict(knowing(n))
        )
        if self.p0 is not None and not leaf.settled:
            start |= {"S": np.zeros((n, n)), "R": np.zeros((n, n)), "root": 1}
            take_root.py_func(P0, start["R"], start["S"])
            start["d"] = start["S"] @ theta0
        Q0 = np.zeros((n, n))
        numbers = {
            "n": n, "output_lags": na, "unknown": nominal.r is None, "independent": self.independent,
            "apart": self._apart, "plain": na == 0,
        }  # fmt: skip
        Q0[np.tril_indices(n)] = arrays["walks"][0, : n * (n + 1) // 2]
        return {  # memory first, where a cache line begins
            **packed(arrays, numbers),
            "theta": theta0, "P": P0, "g": np.zeros(n), "c": np.zeros(n), "active": np.zeros(n), "power": 0.0,
            "power_samples": 0.0, "r": 1.0 if nominal.r is None else nominal.r, "unknown": int(nominal.r is None),
            "scale": scale, "count": count, "squares": squares,
            "sample": np.array([getattr(leaf, name) for name in SAMPLE._fields]),
            "counters": np.array([getattr(leaf, name) for name in COUNTER._fields]), **unresolved(),
            **start,
            "can_frame": int(not again), "within": 0.0, "x": np.zeros(n),
            "column": -1,
            "W": np.zeros((n, n)), "Pz": np.zeros((n, n)),
            "G": triangular_root(Q0 + np.tril(Q0, -1).T), "size0": self.all_changes[0].increments(n)[1],
            "keep0": 1.0 if self.all_changes[0].kind == "directional" else arrays["maps"][0, forget.KEEP],
        }  # fmt: skip

    def extra_columns(self, model: Model, T: int, prob: Any, drift: Any) -> Array:
        """Priors of the joint events (T, H) and chains of the changes (T, H_d H_d), NaN where none are given; then
        factors of the changes (T, H_d).
        """
        Hd, H = len(self.all_changes), self._count
        columns = np.hstack([np.full((T, H + Hd * Hd), np.nan), np.ones((T, Hd))])
        if prob is not None:
            given = as_numbers("prob", prob)
            if given.ndim == 3:
                columns[:, H : H + Hd * Hd] = chains("Bank", given, T, Hd)
            else:
                given = np.broadcast_to(given, (T, given.shape[-1]))
                columns[:, :H] = per_sample("Bank", given, self.event_probabilities[1], Hd)
        if drift is not None:
            factors = np.asarray(factor("drift", as_numbers("drift", drift).ravel(), np.size(drift)))
            if factors.size not in (Hd, T * Hd):
                raise ValueError(f"Bank: drift must have {Hd} columns, one per change; got shape {np.shape(drift)}.")
            columns[:, H + Hd * Hd :] = factors.reshape(-1, Hd)
        return columns

    def set_extra(self, lane: Mapping[str, Array], model: Model, prob: Any, drift: Any) -> None:
        prob = np.asarray(prob)[None] if np.ndim(prob) == 2 else prob
        columns, Hd = self.extra_columns(model, 1, prob, drift)[0], len(self.all_changes)
        given = np.split(columns, (self._count, len(columns) - Hd))
        for name, values in zip(("given", "given_chain", "drift"), given, strict=True):
            start = lane["table"][ROW[name], 0] // 8
            lane["memory"][start : start + len(values)] = values

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        n, framed = len(p), bool(lane["counters"][COUNTER.framed])
        add = np.diag(p)
        if framed:
            np.einsum("ii->i", lane["P"])[:] += p
            lane["var"][:] += p
            add = (lane["S"] * p) @ lane["S"].T
            lane["Pz"][:] += np.tril(add)
        else:
            super().widen(lane, p)
        B = self._leaves(lane)
        factor = B[S] / (B[NU] - 2.0) if lane["unknown"] else np.ones(B.shape[1])
        each, C = 1.0 / np.where(factor > 0.0, factor, 1.0), B[FIRST + n : FIRST + n + n * (n + 1) // 2]
        C += add[np.tril_indices(n)][:, None] * each

    def place(self, lane: Mapping[str, Array], which: Sequence[int], values: Array) -> None:
        """All leaves are moved by the same amount, so that the mixture is at the given value."""
        name = "d" if lane["counters"][COUNTER.framed] else "theta"
        before = lane[name].copy()
        super().place(lane, which, values)
        B = self._leaves(lane)
        B[FIRST : FIRST + len(before)] += (lane[name] - before)[:, None]

    def _leaves(self, lane: Mapping[str, Array]) -> Array:
        """The leaves of a lane, as a view; before the tree starts, the single filter."""
        return self.array(None, lane, "leaves")[:, : max(int(lane["counters"][COUNTER.many_leaves]), 1)]

    def reported(self, report: Array, name: str) -> Array:
        """A quantity of reports (.., size): lag_prob (.., levels, H), decided (.., held, 3), or a number."""
        if name in SINGLE:
            return report[..., SINGLE.index(name)]
        start, rows, columns = HEAD, len(self.reported_levels), self._count
        if name == "decided":
            start, rows, columns = start + rows * columns, self._shape.held, 3
        return report[..., start : start + rows * columns].reshape(*report.shape[:-1], rows, columns)

    @property
    def reported_levels(self) -> tuple[int, ...]:
        """The levels of the tree that a report contains, counted back from the present: the newest, and the oldest."""
        W = self._shape.levels
        return (*range(min(W, MOST_REPORTED) - 1), W - 1)

    def array(self, model: Any, lane: Mapping[str, Array], name: str) -> Array:
        """One of the packed arrays of a lane, as a view."""
        table = lane["table"] if "table" in lane else self.state_for(model)["table"]
        start, rows, columns = table[ROW[name]]
        part: Array = lane["memory"][start // 8 : start // 8 + rows * columns].reshape(rows, columns)
        return part.view(np.int64) if name in WHOLE else part

    def remarks(self, run: Any) -> tuple[tuple[str, str], ...]:
        hypotheses = run.hypotheses
        kinds = [event.kind for event in hypotheses.found()]
        moved, wrong = kinds.count("change"), kinds.count("sensor")
        text = f"{moved} change{'' if moved == 1 else 's'}"
        if len(self.all_sensors) > 1:
            text += f", {wrong} fault{'' if wrong == 1 else 's'} of the sensor"
        facts = [("Events", f"{text}; see run.hypotheses.events()")]
        if (count := hypotheses.impossible) > 0:
            facts.append(("Impossible", f"{count} samples that every hypothesis ruled out, left unused"))
        return tuple(facts)

    def learning(self, lane: Mapping[str, Array]) -> Array:
        """Which entries of theta the regressors have distinguished so far, (n,) bool."""
        return np.isfinite(lane["var"])

    def unlearned(self, lane: Mapping[str, Array]) -> Array:
        never = np.isinf(lane["var"])
        begun = lane["counters"][COUNTER.settled] > 0
        return never & bool(begun and lane["power_samples"] >= window(len(never)))

    @property
    def steps(self) -> TrackerSteps:
        return steps_of(tuple(sensor.likelihood for sensor in self.all_sensors if sensor.kind == "own"))


PARTS: dict[str, Any] = {"changes": Change, "sensors": Sensor}
"""Settings that list hypotheses."""


def _tuples(value: Any) -> Any:
    if isinstance(value, list | tuple | np.ndarray):
        return tuple(_tuples(one) for one in value)
    return None if value is None else float(value)

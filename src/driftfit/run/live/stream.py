"""What a stream stores in addition to its tile: time, limits, late inputs, windows and alarms; and its files.

It also holds what an operator may do to a stream, and takes inputs that come after the output of their sample, as in a
control loop: the model then stores the same as if both had come in one row of a record (`ModelSteps.apply`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Self

import numpy as np

from driftfit.data import storage
from driftfit.data.arguments import by_name, noise_of, order_of
from driftfit.data.clock import Clock, Pace
from driftfit.data.instants import instant
from driftfit.data.limits import Limits
from driftfit.engine.drivers import INPUTS
from driftfit.engine.kernel import Array, Driver, Step
from driftfit.engine.settings import as_numbers, factor, near, numbers, vector, whole
from driftfit.engine.tiles import as_compiled, tile_type
from driftfit.models.base import Model
from driftfit.readings.gate import SIGNAL
from driftfit.readings.left_out import KEPT, SAID, Decision, table
from driftfit.run.columns import attribute
from driftfit.run.lanes import by_output
from driftfit.run.live.alarm import LiveAlarm, check_rule
from driftfit.run.live.fixed_lag import Window
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import programs_of, state_of, tile_of
from driftfit.run.result import Plain, burn_in
from driftfit.run.warm_start import KINDS, End, Run, carried, ended, gate_from, read, restore, written
from driftfit.trackers.base import Tracker

KNOWN = ("interval", "noise", "drift")
ORDINARY, HELD = (1.0, 1.0, 1.0), (0.0, np.inf, 1.0)
"""The known factors of a sample: the default, and those while the stream is held."""


Factors = tuple[float, Any, float]
"""Interval, factor of the noise variance (one, or one per output), factor of the drift."""


class _Later:
    """Represents an input that was left out, as opposed to None, which is a missing input."""

    def __repr__(self) -> str:
        return "LATER"


LATER: Any = _Later()

NOTHING, INPUT, IGNORED = 0, 1, 2
"""The input that `Live.apply` is expected to receive: nothing, the input of the last sample, or that of an ignored
sample.
"""


def applier(model: Model, tracker: Tracker, tile: Array) -> Any:
    """``apply(as_compiled(tile), u)`` for this type of tile; ValueError if outputs need the input of their sample."""
    step = tracker.apply_for(model)
    if step is None:
        raise ValueError(
            f"Live.update: no input was given, but {model!r} needs the input of a sample to predict its output "
            "(a regression, or nk = 0): update(y, u), with u=None if it is not known. In a control loop, where u is "
            "chosen after y has been read, use a model with nk of at least 1, and call update(y), then apply(u)."
        )
    return _compiled(step).entry(tile_type(tile), INPUTS)


@lru_cache(maxsize=256)
def _compiled(step: Step) -> Driver:
    @Driver
    def apply(tile: Array, u: Array) -> None:
        s = tile[0]
        for l in range(s.theta.shape[1]):
            for j in range(u.shape[0]):
                s.u[j, l] = u[j]
            step(s, l)

    return apply


class Tally:
    """What the gate of a stream left out: ``counts`` of samples by reason, as summaries call it, and the ``last`` 16
    decisions, the newest at the end."""

    def __init__(self, counted: Mapping[str, int] | None = None, last: Iterable[Sequence[Any]] = ()) -> None:
        """Nothing, or what `plain` wrote."""
        self.counts: dict[str, int] = dict(counted or {})
        self.last: tuple[Decision, ...] = tuple(Decision(*one) for one in last)

    def add(self, sample: Any, reason: int, value: float, names: Sequence[str], decided: Any = None) -> None:
        """Count a sample that was not used, with the names of the output and the inputs; it was decided at once, or at
        a later sample."""
        signal, code = divmod(int(reason), SIGNAL)
        name, said = SAID[code]
        self.counts[name] = self.counts.get(name, 0) + 1
        when = sample if decided is None else decided
        self.last = (*self.last, Decision(sample, names[signal], value, said, when))[-KEPT:]

    def __repr__(self) -> str:
        said = ", ".join(f"{name}: {count}" for name, count in self.counts.items())
        return f"{said}\n{table(self.last)}" if said else "nothing left out"

    def plain(self) -> list[Any]:
        """The state as plain data."""
        return [self.counts, [list(one) for one in self.last]] if self.counts else []


def check_applied(expected: int) -> None:
    """Raise an error if a sample arrives while the input of the previous one is still outstanding."""
    if expected != NOTHING:
        raise ValueError(
            "Live.update: the input of the last sample has not been given yet: apply(u) after update(y), or "
            "apply(None) where it is not known."
        )


class Stream(Plain, storage.Kept):
    """A stream: a tile with a lane for each program, which every sample changes.

    `driftfit.run.live.live.Live` defines how a sample is processed, and what is reported of it.
    """

    samples: int = attribute(
        "_samples", "Number of samples so far, without those that were ignored; the first after a warm start is 0."
    )
    ignored: int = attribute("_ignored", "Number of samples whose time was not after the last.")

    def _begin(
        self, model: Model, tracker: Any, dt: Any, lag: int, warm_start: Run | None, limits: Mapping[Any, Any] | None,
        gate: Any,
    ) -> None:  # fmt: skip
        """Set everything before the step is compiled."""
        self.programs = programs_of(model, tracker, model.m, gate)
        self.model = self.programs[0].whole
        self._rows = self.programs[0].model
        self._clock = Clock.of(dt)
        self.dt = self._clock.plain
        self._pace = Pace(self._clock, self.model.reach)
        self._limits = Limits(limits, self.model.outputs, self._rows.input_names, self._rows.m) if limits else None
        self.lag = whole("Live", "lag", lag, 0)
        if lag and warm_start is not None:
            raise ValueError("Live: lag= and warm_start= cannot be combined; give one of them.")
        before = None if warm_start is None else ended(warm_start, self.programs)
        self._last: Any = None if before is None else before.last
        self._awaits = NOTHING if before is None else before.awaits
        self._cold = before is None
        self._ignored = self._samples = 0
        self.left_out, self._warned = Tally(), False
        self._place: Any = None
        self._windows: list[Window] = []
        self._watching: list[tuple[int, LiveAlarm]] = []
        self._tile = tile_of(self.programs, carried(before, self.programs))
        self._single, self._m = len(self.model.outputs) == 1, self._rows.m
        self._shape = (len(self.model.outputs), self._m) if self.model.shared else (self._m,)
        self._unknown: Array = np.full(self._shape, np.nan)

    @property
    def _rows_per_instant(self) -> int:
        return len(self.model.outputs) if self.model.shared else 1

    def lane(self, lane: int = 0) -> dict[str, Array]:
        """The fields of the record, or of that of one of several outputs, as views."""
        return state_of(self._tile, lane)

    def _set_extra(self, prob: Any, drift: Any) -> None:
        """Set the known factors of the next sample that only some trackers have; None is the default."""
        for lane, tracker in enumerate(self.trackers):
            tracker.set_extra(self.lane(lane), self._rows, prob, drift)

    def __repr__(self) -> str:
        settings = ", ".join(dict.fromkeys(map(repr, self.trackers)))
        last = "" if self._last is None else f" at {self._last}"
        return f"{type(self).__name__}{last}: {self.model!r}, {settings}"

    @property
    def trackers(self) -> tuple[Tracker, ...]:
        """The tracker of each output, or of the theta that they share."""
        return tuple(one.tracker for one in self.programs)

    @abstractmethod
    def _step(self, y: Any, u: Array, known: Any, time: Any) -> Any:
        """Process a sample within its limits: y and u as `_checked` returns them, ``known`` as `_factors` does."""

    @classmethod
    def _kinds(cls) -> Mapping[str, type[storage.Kept]]:
        return dict.fromkeys(KINDS, cls)

    def _factors(self, interval: float, weight: Any, drift: Any) -> Factors:
        noise: Any = 1.0
        if not self._single:
            noise = noise_of(weight, len(self.model.outputs))
        elif weight != 1.0:
            noise = float(noise_of(weight))
        return interval, noise, 1.0 if drift == 1.0 else float(factor("drift", drift))

    def _checked(self, y: Any, u: Any) -> tuple[Array, Array]:
        outputs, inputs = self._outputs(y), self.inputs_of(u)
        return (outputs, inputs) if self._limits is None else self._limits.sample(outputs, inputs)

    def _outputs(self, y: Any) -> Array:
        """y as floats (ny,)."""
        outputs = self.model.outputs
        if hasattr(y, "keys"):
            order_of("Live.update: the model", outputs, list(y.keys()), "outputs")
            y = [y[name] for name in outputs]
        given = as_numbers("y", y)
        if given.shape != (len(outputs),) and not (self._single and given.size == 1):
            wanted = "one number" if self._single else f"({len(outputs)},)"
            raise ValueError(f"Live.update: y must be {wanted}; got shape {given.shape}.")
        return given.reshape(-1)

    def inputs_of(self, u: Any) -> Array:
        """u as floats (m,), or (ny, m) where outputs share one theta."""
        if u is None or u is LATER:
            return self._unknown
        given = as_numbers("u", u if self.model.shared else by_name(self.model, u))
        if given.shape != self._shape:
            if given.size != self._unknown.size:
                wanted = f"shape {self._shape}" if self.model.shared else f"{self._m} inputs"
                raise ValueError(f"Live.update: the model has {wanted}, but u has shape {given.shape}.")
            given = given.reshape(self._shape)
        return given

    def _nothing(self) -> Any:
        nan = np.full(len(self.model.outputs), np.nan)
        return (
            (np.nan, np.nan, np.nan, False)
            if self._single
            else (nan, nan.copy(), nan.copy(), np.zeros(nan.shape, bool))
        )

    def _sample(self, y: Any, u: Any, time: Any, weight: Any, drift: Any) -> Any:
        """Process a sample with a time, known factors, limits, or a late input."""
        check_applied(self._awaits)
        later = u is LATER and self._rows.m > 0
        if later:
            self._placing()
        if time is not None:
            self._clock, time = self._clock.at(time), instant(time)
        interval = 1.0 if time is None else self._clock.since(self._last, time)
        if not interval >= 0.0:
            self._ignored += 1
            self._expect(IGNORED if later else NOTHING)
            return self._nothing()
        known = self._factors(float(interval), weight, drift)
        y, u = self._checked(y, u)
        if time is not None:
            self._last = time
            self._pace.see(interval)
        self._samples += 1
        step = self._step(y, u, known, time)
        self._expect(INPUT if later else NOTHING)
        return step

    def _placing(self) -> Any:
        """The routine that stores an input; ValueError for a model that needs it at once."""
        if self._place is None:
            self._place = applier(self._rows, self.trackers[0], self._tile)
        return self._place

    def _expect(self, what: int) -> None:
        """Record whether an input is outstanding."""
        self._awaits = what

    def apply(self, u: Any) -> None:
        """Give the input of the last sample, once it has been chosen: ``update(y)`` without u, then ``apply(u)``.

        Together they leave the state that ``update(y, u)`` leaves. In between, `predict` and `forecast` show the effect
        of an input; saving and copying keep the outstanding input. For models whose inputs act after one sample or
        more (nk of at least 1).

        Parameters
        ----------
        u : number, sequence of m, or None
            None: missing. After a sample that was ignored for its time the input is ignored too.

        Raises
        ------
        ValueError
            If no sample is waiting for its input, or u does not have m numbers.
        """
        if self._awaits == NOTHING:
            raise ValueError(
                "Live.apply: no sample is waiting for its input. The order is update(y) without u, then apply(u), once "
                "per sample."
            )
        inputs = self.inputs_of(u)
        if self._limits is not None and self._awaits == INPUT:
            inputs = self._limits.sample(np.full(len(self.model.outputs), np.nan), inputs)[1]
        self._put(self._tile, inputs)
        self._expect(NOTHING)

    def _put(self, tile: Array, inputs: Array) -> None:
        """Store the outstanding input in a tile."""
        if self._awaits == INPUT:
            self._placing()(as_compiled(tile), inputs)

    @property
    def awaits(self) -> bool:
        """Whether the input of the last sample is outstanding; it comes with `apply`."""
        return self._awaits != NOTHING

    @property
    def outside(self) -> dict[str, int]:
        """How many numbers of each signal were outside its limits."""
        return {} if self._limits is None else self._limits.counts

    def _watch(self, lane: int, rule: AlarmRule, wait: int | None) -> LiveAlarm:
        """An alarm that watches a lane from the next sample on."""
        start = burn_in(self._rows.n) if self._cold else 0
        wait = start if wait is None else whole("Live.detect", "wait", wait, 0)
        rows = self._samples * self._rows_per_instant
        alarm = LiveAlarm(check_rule(rule), self.trackers[lane], self.programs[lane].names, wait, rows)
        self._watching.append((lane, alarm))
        return alarm

    def end(self) -> End:
        """The present state of the stream, from which another run can continue (`warm_start`)."""
        lanes = (state_of(self._tile, lane) for lane in range(len(self.programs)))
        states = tuple({name: np.array(value) for name, value in lane.items()} for lane in lanes)
        return End(tuple(self.programs), states, self._last, self._awaits, self.dt, self._clock.zone)

    def _written(self) -> tuple[dict[str, Any], dict[str, Array]]:
        extra = {
            "dt": self.dt, "zone": self._clock.zone, "limits": None if self._limits is None else self._limits.plain(),
            "last": self._last, "samples": self._samples, "ignored": self._ignored, "lag": self.lag,
            "awaits": self._awaits, "cold": self._cold, "windows": tuple(window.plain() for window in self._windows),
            "alarms": tuple([lane, alarm.plain()] for lane, alarm in self._watching),
            "left_out": self.left_out.plain(),
        }  # fmt: skip
        tile = self._tile
        return written(self.programs, [one.pack(tile, lane) for lane, one in enumerate(self.programs)], extra)

    def __reduce__(self) -> Any:
        return type(self).from_bytes, (self.to_bytes(), tuple(storage.parts_of((self.model, *self.trackers))))

    @classmethod
    def _read(cls, source: str, header: Mapping[str, Any], arrays: Mapping[str, Array], classes: Iterable[Any]) -> Self:
        model, trackers, extra = read(source, header, arrays, classes)
        limits, outside = extra["limits"] or ([], [])
        make: Any = cls
        clock = Clock.of(extra["dt"], extra["zone"])
        gate = gate_from(header) or False
        live: Self = make(model, by_output(model, trackers), clock, extra["lag"], limits=dict(limits), gate=gate)
        if live._limits is not None:
            live._limits.restore(outside)
        live._last, live._cold = extra["last"], extra["cold"]
        live._samples, live._ignored = extra["samples"], extra["ignored"]
        live.left_out = Tally(*extra["left_out"])
        for window, state in zip(live._windows, extra["windows"], strict=True):
            window.restore(state)
        live._watching = [
            (lane, LiveAlarm.of(state, trackers[lane], live.programs[lane].names)) for lane, state in extra["alarms"]
        ]
        restore(source, live.programs, arrays, live._tile)
        live._expect(extra["awaits"])
        return live

    def hold(self, on: bool = True) -> None:
        """Stop learning, or with ``hold(False)`` resume: for work on the plant, a test, or while a sensor is cleaned.

        While held, samples enter the lags and are predicted, but are not used (``ok`` is False), and no time passes
        for the parameters and their covariance. Being held is part of the state that `save` writes.
        """
        self._rest(HELD if on else ORDINARY)

    @property
    def held(self) -> bool:
        """Whether `hold` is on."""
        return bool(self._tile["noise"][0, 0] == np.inf)

    @property
    def resting(self) -> tuple[float, float, float]:
        """Interval, noise and drift of a sample that gives none."""
        return HELD if self.held else ORDINARY

    def reset(self, which: str | int | Sequence[str | int] | None = None, p: Any = None, theta: Any = None) -> None:
        """Pass an operator's knowledge to the tracker: these parameters may have changed, or have new values.

        Parameters
        ----------
        which : name, index, several of them, or None
            The parameters; None is all. Indices count the parameters of all outputs, one output after the other.
        p : number or one per parameter
            Variance of the change, in squared units of theta; it is added to the present variance. After maintenance
            a large value lets the next samples decide.
        theta : number or one per parameter
            Their new values, if they are known.

        Raises
        ------
        ValueError
            For an unknown parameter, a negative or infinite p, or a tracker without a covariance to widen.
        """
        chosen = self._chosen(which)
        if p is None and theta is None:
            raise ValueError("Live.reset: give p= (the variance of their possible change), theta=, or both.")
        if self._windows:
            raise ValueError(
                "Live.reset: smoothing with lag= does not support resets; use a second stream without lag=."
            )
        count = len(chosen)
        if p is not None:
            moved = vector("Live.reset", "p", numbers("Live.reset", "p", p, low=0.0), count)
        if theta is not None:
            values = vector("Live.reset", "theta", numbers("Live.reset", "theta", theta), count)
        for number, program in enumerate(self.programs):
            places = [k for k, (lane, _) in enumerate(chosen) if lane == number]
            own = [chosen[k][1] for k in places]
            if own and p is not None:
                added = np.zeros(len(program.names))
                added[own] = moved[places]
                program.tracker.widen(self.lane(number), added)
            if own and theta is not None:
                program.tracker.place(self.lane(number), own, values[places])

    def _chosen(self, which: Any) -> list[tuple[int, int]]:
        """(output, index) of parameters."""
        named = [(lane, i, name) for lane, one in enumerate(self.programs) for i, name in enumerate(one.names)]
        if which is None:
            return [(lane, i) for lane, i, _ in named]
        chosen = []
        for one in [which] if isinstance(which, str | int) else which:
            found = [(lane, i) for k, (lane, i, name) in enumerate(named) if one in (name, k)]
            if not found:
                raise ValueError(f"Live.reset: no parameter {one!r}; {near(str(one), [name for *_, name in named])}")
            chosen.append(found[0])
        return chosen

    def _rest(self, known: tuple[float, float, float]) -> None:
        """Set the known factors of every sample that gives none."""
        for name, value in zip(KNOWN, known, strict=True):
            self._tile[name] = value

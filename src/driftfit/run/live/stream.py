"""What a stream stores in addition to its tile: time, limits, late inputs, windows and alarms; and its files."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Self

import numpy as np

from driftfit.data import storage
from driftfit.data.clock import Clock
from driftfit.data.limits import StreamLimits
from driftfit.data.times.gaps import Pace
from driftfit.data.times.instants import instant
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.engine.tiles import as_compiled
from driftfit.models.base import Model
from driftfit.readings.left_out import Tally
from driftfit.run.live.alarm import LiveAlarm, check_rule
from driftfit.run.live.batch import Batched
from driftfit.run.live.fixed_lag import Window
from driftfit.run.live.late_input import IGNORED, INPUT, LATER, NOTHING, applier, check_applied, check_expected
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import programs_of, state_of, tile_of
from driftfit.run.public_class import Plain
from driftfit.run.result import burn_in
from driftfit.run.warm_start import (
    ABSENT,
    KINDS,
    End,
    Run,
    by_output,
    carried,
    ended,
    gate_from,
    read,
    restore,
    written,
)
from driftfit.trackers.base import Tracker


class Stream(Batched, Plain, storage.Kept):
    """A stream: a tile with a lane for each program, which every sample changes.

    `driftfit.run.live.live.Live` defines how a sample is processed, and what is reported of it.
    """

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
        self._limits = (
            StreamLimits(limits, self.model.outputs, self._rows.input_names, self._rows.m) if limits else None
        )
        self.lag = whole("Live", "lag", lag, 0)
        if lag and warm_start is not None:
            raise ValueError("Live: lag= and warm_start= cannot be combined; give one of them.")
        before = None if warm_start is None else ended(warm_start, self.programs)
        self._last: Any = None if before is None else before.last
        self._awaits = NOTHING if before is None else before.awaits
        self._cold = before is None
        self._ignored = self._samples = 0
        self.left_out = Tally()
        self._place: Any = None
        self._windows: list[Window] = []
        self._watching: list[tuple[int, LiveAlarm]] = []
        self._tile = tile_of(self.programs, carried(before, self.programs))

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

    @abstractmethod
    def _factors(self, interval: float, weight: Any, drift: Any) -> Any:
        """The known numbers of a sample."""

    @abstractmethod
    def _checked(self, y: Any, u: Any) -> tuple[Any, Array]:
        """The signals of a sample as numbers, NaN where they are outside their limits."""

    @abstractmethod
    def _nothing(self) -> Any:
        """The result of a sample that is ignored."""

    @abstractmethod
    def _inputs(self, u: Any) -> Array:
        """u as floats, NaN where it is not known."""

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
            self._place = applier(self._rows, self.trackers[0], self._state_tile())
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
        check_expected(self._awaits)
        self._put(self._state_tile(), self._within(self._inputs(u)))
        self._expect(NOTHING)

    def _put(self, tile: Array, inputs: Array) -> None:
        """Store the outstanding input in a tile."""
        if self._awaits == INPUT:
            self._placing()(as_compiled(tile), inputs)

    def _within(self, inputs: Array) -> Array:
        """Inputs with NaN outside their limits, which are counted."""
        if self._limits is None or self._awaits != INPUT:
            return inputs
        return self._limits.sample(np.full(len(self.model.outputs), np.nan), inputs)[1]

    @property
    def awaits(self) -> bool:
        """Whether the input of the last sample is outstanding; it comes with `apply`."""
        return self._awaits != NOTHING

    @property
    def samples(self) -> int:
        """Number of samples so far, without those that were ignored; the first after a warm start is number 0."""
        return self._samples

    @property
    def ignored(self) -> int:
        """Number of samples whose time was not after the last."""
        return self._ignored

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
        lanes = (state_of(self._state_tile(), lane) for lane in range(len(self.programs)))
        states = tuple({name: np.array(value) for name, value in lane.items()} for lane in lanes)
        return End(tuple(self.programs), states, self._last, self._awaits, self.dt, self._clock.zone)

    def _windowed(self) -> Iterator[tuple[int, Window]]:
        """The lanes and their windows; ValueError if no samples are kept."""
        if not self._windows:
            raise ValueError("Live.smooth: no samples are kept; give their number, as in Live(model, tracker, lag=20).")
        yield from enumerate(self._windows)

    def _written(self) -> tuple[dict[str, Any], dict[str, Array]]:
        extra = {
            "dt": self.dt, "zone": self._clock.zone, "limits": None if self._limits is None else self._limits.plain(),
            "last": self._last, "samples": self._samples, "ignored": self._ignored, "lag": self.lag,
            "awaits": self._awaits, "cold": self._cold, "windows": tuple(window.plain() for window in self._windows),
            "alarms": tuple([lane, alarm.plain()] for lane, alarm in self._watching),
            "left_out": self.left_out.plain(),
        }  # fmt: skip
        tile = self._state_tile()
        return written(self.programs, [one.pack(tile, lane) for lane, one in enumerate(self.programs)], extra)

    @classmethod
    def _read(cls, source: str, header: Mapping[str, Any], arrays: Mapping[str, Array], classes: Iterable[Any]) -> Self:
        model, trackers, extra = read(source, header, arrays, classes)
        return cls._again(source, (model, trackers), {**header, "extra": extra}, arrays)

    def __reduce__(self) -> Any:
        header, arrays = self._written()
        header["extra"] = {**ABSENT, **header["extra"]}
        return type(self)._again, ("the copy", (self.model, self.trackers), header, arrays)

    @classmethod
    def _again(
        cls, source: str, settings: tuple[Model, tuple[Tracker, ...]], header: Mapping[str, Any],
        arrays: Mapping[str, Array],
    ) -> Self:  # fmt: skip
        """The stream that continues from a stored state."""
        (model, trackers), extra = settings, header["extra"]
        limits, outside = extra["limits"] or ([], [])
        make: Any = cls
        clock = Clock.of(extra["dt"], extra["zone"])
        gate = gate_from(header) or False
        live: Self = make(model, by_output(model, trackers), clock, extra["lag"], limits=dict(limits), gate=gate)
        if live._limits is not None:
            live._limits.restore(outside)
        live._last, live._cold = extra["last"], extra["cold"]
        live._samples, live._ignored = extra["samples"], extra["ignored"]
        live.left_out.restore(extra["left_out"])
        for window, state in zip(live._windows, extra["windows"], strict=True):
            window.restore(state)
        live._watching = [
            (lane, LiveAlarm.of(state, trackers[lane], live.programs[lane].names)) for lane, state in extra["alarms"]
        ]
        restore(source, live.programs, header, arrays, live._state_tile())
        live._expect(extra["awaits"])
        return live

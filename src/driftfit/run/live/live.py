"""Live: one sample at a time, with the same compiled step as a record, bit for bit.

In a control loop the input u_t is chosen after y_t has been read. With nk of at least 1 it is not needed before that:

    step = live.update(y_t)      u_t = control law(live.theta, live.cov, ...)      live.apply(u_t)

gives the same bits as the record with u_t and y_t in one row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.data.arguments import check_roles
from driftfit.data.clock import Clock, Pace, instant
from driftfit.data.labels import by_name
from driftfit.data.limits import Gate
from driftfit.data.signals import check_ready, noise_of
from driftfit.data.storage import Kept, describe, rebuild, restore
from driftfit.engine.arrays import as_numbers, factor
from driftfit.engine.drivers import one_or_all
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.models.base import Model
from driftfit.run.live.alarm import LiveAlarm, check_rule
from driftfit.run.live.fixed_lag import FixedLag, Window
from driftfit.run.live.interventions import HELD, ORDINARY, Operated
from driftfit.run.live.late_input import IGNORED, INPUT, LATER, NOTHING, applier, check_applied, check_expected
from driftfit.run.live.outputs import LiveOutputs
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import Program, state_of
from driftfit.run.public_class import Plain
from driftfit.run.result import burn_in
from driftfit.run.warm_start import End, Run, carried
from driftfit.trackers.base import Tracker

Step = tuple[float, float, float, bool]
"""(y_hat, e, s, ok): one-step prediction, innovation, its variance, and whether the sample was used."""

_FLOAT = np.dtype(np.float64)


class Live(Operated, Plain, Kept):
    """Track a stream.

    A stream can be copied, pickled and sent to another process, as well as saved: it continues as if never stopped.

    Parameters
    ----------
    model, tracker : Model, Tracker
        As for `track`. A model with several inputs must declare them: ``ARX(2, [1, 1])``, ``inputs=["pressure",
        "flow"]``.
    dt : number, duration, step of the calendar or "label"
        Nominal interval between samples, as for `track`; with datetimes it is required.
    lag : int
        Keep the last ``lag`` samples for `smooth`; 0 keeps none.
    warm_start : Track, Live or None
        Continue where that run ended.
    limits : mapping from signals to (low, high)
        Valid ranges as for `track`: a number outside its range is missing, and counted in ``outside``.

    Memory is constant. One update costs a call of a compiled function: well below a microsecond for a few parameters.
    """

    _kind: ClassVar[str] = "state"

    @classmethod
    def _kinds(cls) -> Mapping[str, type[Kept]]:
        """A file of a stream with several outputs gives that."""
        return {cls._kind: cls, LiveOutputs.public()._kind: LiveOutputs.public()}

    def __new__(cls, model: Model, *args: Any, **kwargs: Any) -> Any:
        """A stream with several outputs is a `LiveOutputs`."""
        tracker = args[0] if args else kwargs.get("tracker")
        check_roles("Live", model, tracker, several=isinstance(model, Model) and len(model.outputs) > 1)
        if len(model.outputs) == 1:
            return super().__new__(cls)
        return LiveOutputs(model, *args, **kwargs)

    def __init__(
        self, model: Model, tracker: Tracker, dt: Any = None, lag: int = 0, warm_start: Run | None = None,
        limits: Mapping[Any, Any] | None = None,
    ) -> None:  # fmt: skip
        self.model = model.bind(model.m)
        self.tracker = check_ready(tracker)
        self._clock = Clock.of(dt)
        self.dt = self._clock.plain
        self._pace = Pace(self._clock, self.model.reach)
        self._gate = Gate(limits, self.model.outputs, self.model.input_names, self.model.m) if limits else None
        before = None if warm_start is None else warm_start.end()
        self._last: Any = None if before is None else before.last
        self._awaits = NOTHING if before is None else before.awaits
        self._cold = before is None
        self._ignored = 0
        self._place: Any = None
        self._alarms: tuple[LiveAlarm, ...] = ()
        self.lag = whole("Live", "lag", lag, 0)
        if lag and warm_start is not None:
            raise ValueError("Live: lag= and warm_start= cannot be combined; give one of them.")
        self._window = Window(self.model, tracker, lag) if lag else None
        self.program = Program(self.model, self.tracker)
        self._open(self.program.tile(*carried(warm_start, [self.program])))

    def _open(self, tile: Array) -> None:
        """Set a state and compile the step for it."""
        self._tile = tile
        self._scratch = tile.copy()
        self._bytes, self._scratch_bytes = tile.view(np.uint8), self._scratch.view(np.uint8)
        self._m = self.model.m
        self._unknown = np.full(self._m, np.nan)
        self._shape = (self._m,)
        self._update = self.program.drivers().updater(tile, self._m)
        self._be_careful()

    def _be_careful(self) -> None:
        """Whether a sample needs more than a call of the compiled step."""
        more = self._window, self._gate
        self._careful = more != (None, None) or bool(self._alarms) or self._awaits != NOTHING

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.program.names

    def update(
        self,
        y: float | None,
        u: Any = LATER,
        time: Any = None,
        weight: float = 1.0,
        drift: Any = 1.0,
        prob: Any = None,
    ) -> Step:
        """Process one sample and return (y_hat, e, s, ok).

        ``y`` is a number; None, NaN or inf if it is missing. ``u`` is a number for one input, a sequence of m
        otherwise, or a mapping from the names of the inputs; None if it is missing. If ``u`` is left out, it comes with
        `apply`, before the next sample; ValueError for a model that has inputs and needs them at once. With ``time``,
        the interval since the last sample scales the drift; a time that is not after the last is counted in ``ignored``
        and leaves the state unchanged. ``weight`` divides the noise variance of this sample (0: do not use it),
        ``drift`` multiplies the drift before it: one number, or one for each parameter (random-walk trackers) or change
        (`Bank`). A `Bank` also takes ``prob``, prior probabilities of its changes or joint events at this sample.
        """
        if prob is not None or type(drift) is not float:
            return self._update_told(y, u, time, weight, drift, prob)
        if time is not None or weight != 1.0 or drift != 1.0 or self._careful:
            return self._update_known(y, u, time, weight, drift)
        if not isinstance(y, float):
            y = float(as_numbers("y", y))
        if type(u) is float and self._m == 1:
            return self._update(self._tile, y, u)  # type: ignore[no-any-return]
        if u is LATER and self._m:
            return self._update_later(y)
        # the compiled step reads m floats from any address, so they must exist
        if not (type(u) is np.ndarray and u.dtype is _FLOAT and u.shape == self._shape):
            u = self._inputs(u)
        # as `one_or_all`, whose call would take 30 ns
        return self._update(self._tile, y, u.item() if self._m == 1 else u)  # type: ignore[no-any-return]

    def _update_told(self, y: Any, u: Any, time: Any, weight: float, drift: Any, prob: Any) -> Step:
        """A sample with more known factors than interval, noise and drift."""
        each = np.ndim(drift) == 1
        if each or prob is not None:
            self.tracker.tell(self.lane(), self.model, prob, drift if each else None)
        try:
            return self._update_known(y, u, time, weight, 1.0 if each else float(drift))
        finally:
            if each or prob is not None:
                self.tracker.tell(self.lane(), self.model, None, None)

    def _update_known(self, y: float | None, u: Any, time: Any, weight: float, drift: float) -> Step:
        check_applied(self._awaits)
        later = u is LATER and self._m > 0
        if later:
            self._placing()
        if time is not None:
            self._clock, time = self._clock.at(time), instant(time)
        interval = 1.0 if time is None else self._clock.since(self._last, time)
        if not interval >= 0.0:
            self._ignored += 1
            self._expect(IGNORED if later else NOTHING)
            return (np.nan, np.nan, np.nan, False)
        known = (float(interval), float(noise_of(weight)), float(factor("drift", drift)))
        y, u = float(as_numbers("y", y)), self._inputs(u)
        if self._gate is not None:
            (y,), u = self._gate.sample(np.array([y]), u)
        if time is not None:
            self._last = time
            self._pace.see(interval)
        known = HELD if self.held else known
        self._rest(known)
        step: Step = self._update(self._tile, float(y), one_or_all(u))
        for alarm in self._alarms:
            alarm.take(self._tile, 0, step[1], step[2], time)
        if known is not HELD:
            self._rest(ORDINARY)
        if self._window is not None:
            self._window.push(self._tile, known)
        self._expect(INPUT if later else NOTHING)
        return step

    def _update_later(self, y: float) -> Step:
        """A sample without known factors, whose input comes with `apply`."""
        self._placing()
        step: Step = self._update(self._tile, y, one_or_all(self._unknown))
        self._expect(INPUT)
        return step

    def _placing(self) -> Any:
        """The routine that stores an input; ValueError for a model that needs it at once."""
        if self._place is None:
            self._place = applier(self.model, self.tracker, self._tile)
        return self._place

    def _expect(self, what: int) -> None:
        self._awaits = what
        self._be_careful()

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
        given = self._inputs(u)
        if self._awaits == INPUT:
            if self._gate is not None:
                _, given = self._gate.sample(np.array([np.nan]), given)
            self._placing()(self._tile, given)
        self._expect(NOTHING)

    @property
    def awaits(self) -> bool:
        """Whether the input of the last sample is outstanding; it comes with `apply`."""
        return self._awaits != NOTHING

    def predict(self, u: Any = None) -> tuple[float, float]:
        """(y_hat, s): the prediction of the next output if its input is ``u``; the state stays unchanged.

        While `apply` is outstanding ``u`` is the input that it would receive, so that candidates can be compared.
        """
        self._scratch_bytes[:] = self._bytes  # copying a record field by field takes ten times as long
        inputs = self._inputs(u) if self._gate is None else self._gate.inputs(self._inputs(u))
        if self._awaits == INPUT:
            self._placing()(self._scratch, inputs)
        y_hat, _, s, _ = self._update(self._scratch, np.nan, one_or_all(inputs))
        return y_hat, s

    def smooth(self) -> FixedLag:
        """The last ``lag`` + 1 samples, oldest first, each estimated from all samples so far: theta, std (lag + 1, n).

        Row 0 is what `Track.smooth` would give for that sample of a record that ends now.
        """
        if self._window is None:
            raise ValueError("Live.smooth: no samples are kept; give their number, as in Live(model, tracker, lag=20).")
        return self._window.smooth(self._tile)

    def detect(self, rule: AlarmRule, wait: int | None = None) -> LiveAlarm:
        """Watch the stream from the next sample on by the rule of a reference run, ``run.detect(...).rule``.

        After every update the alarm shows whether it is on, whether it has just begun, and its cause (`LiveAlarm`). It
        is saved with the state; `alarms` returns all of them. Over the same samples it gives the alarms of
        ``Track.detect(rule, start=...)`` on the record, bit for bit.

        Parameters
        ----------
        rule : AlarmRule
            Limits and settings. The tracker should be that of the reference run.
        wait : int or None
            Number of samples that are not judged. None: those of the start, max(50, 5 n); 0 after a warm start.

        Raises
        ------
        ValueError
            If the tracker or model does not support the rule.
        """
        start = burn_in(self.model.n) if self._cold else 0
        wait = start if wait is None else whole("Live.detect", "wait", wait, 0)
        alarm = LiveAlarm(check_rule(rule), self.tracker, self.names, wait)
        self._alarms = (*self._alarms, alarm)
        self._be_careful()
        return alarm

    @property
    def alarms(self) -> tuple[LiveAlarm, ...]:
        """The alarms that watch this stream, in the order in which `detect` made them."""
        return self._alarms

    def lane(self) -> dict[str, Array]:
        """The fields of the record, as views."""
        return state_of(self._tile)

    def end(self) -> End:
        """The present state of the stream, from which another run can continue (`warm_start`)."""
        state = {name: np.array(value) for name, value in self.lane().items()}
        return End((self.program,), (state,), self._last, self._awaits)

    def before(self, steps: float) -> Any:
        """The time so many nominal intervals before the last sample; None where samples have no times."""
        time = None if self._last is None else self._clock.moved(self._last, np.array([-steps]))
        return None if time is None else time[0]

    def driven_on(self, inputs: Array) -> tuple[Array, Array]:
        """(a copy of the state to be driven on, inputs (h, m) then): what `apply` is to bring is the first of them."""
        tile = self.program.resting(self.lane())
        if self._awaits == INPUT:
            self._placing()(tile, inputs[0])
            inputs = np.vstack([inputs[1:], np.full((1, self._m), np.nan)])
        return tile, inputs

    def _inputs(self, u: Any) -> Array:
        """u as floats (m,)."""
        if u is None or u is LATER:
            return self._unknown
        given: Array = np.asarray(by_name(self.model, u), dtype=np.float64)
        if given.shape != self._shape:
            if given.size != self._m:
                raise ValueError(f"Live.update: the model has {self._m} inputs, but u has shape {given.shape}.")
            given = given.reshape(self._shape)
        return given

    @property
    def theta(self) -> Array:
        """Parameters now, (n,)."""
        theta: Array = self._tile["theta"][0, :, 0].copy()
        return theta

    @property
    def std(self) -> Array:
        """Their standard deviations, (n,): inf for parameters that are not determined yet, NaN without a covariance."""
        std: Array = np.sqrt(np.diag(self.cov))
        return std

    @property
    def cov(self) -> Array:
        """Covariance of theta, (n, n)."""
        return self.tracker.cov(self.lane())

    @property
    def learning(self) -> Array:
        """Which parameters are being learned now, (n,) bool: False if recent inputs had too little excitation."""
        return self.tracker.learning(self.lane())

    @property
    def ignored(self) -> int:
        """Number of samples whose time was not after the last."""
        return self._ignored

    @property
    def outside(self) -> dict[str, int]:
        """How many numbers of each signal were outside its limits."""
        return {} if self._gate is None else self._gate.counts

    def _plain(self) -> dict[str, Any]:
        """The state besides the fields of the record, as plain data."""
        return {
            "dt": self.dt, "zone": self._clock.zone, "limits": None if self._gate is None else self._gate.plain(),
            "last": self._last, "ignored": self._ignored, "lag": self.lag, "awaits": self._awaits,
            "cold": self._cold, "window": None if self._window is None else self._window.plain(),
            "alarms": [alarm.plain() for alarm in self._alarms],
        }  # fmt: skip

    def _written(self) -> tuple[dict[str, Any], dict[str, Array]]:
        header = {"kind": self._kind, "model": describe(self.model), "tracker": describe(self.tracker)}
        return header | {"extra": self._plain()}, {f"state_{name}": value for name, value in self.lane().items()}

    @classmethod
    def _read(cls, source: str, header: Mapping[str, Any], arrays: Mapping[str, Array]) -> Self:
        model, tracker = rebuild(header["model"], Model), rebuild(header["tracker"], Tracker)
        return cls._again(source, model, tracker, header["extra"], arrays)

    def __reduce__(self) -> Any:
        header, arrays = self._written()
        return type(self)._again, ("the copy", self.model, self.tracker, header["extra"], arrays)

    @classmethod
    def _again(
        cls, source: str, model: Model, tracker: Tracker, extra: Mapping[str, Any], arrays: Mapping[str, Array]
    ) -> Self:
        """The stream from its state."""
        limits, outside = extra["limits"] or ([], [])
        live = cls(model, tracker, dt=Clock.of(extra["dt"], extra["zone"]), lag=extra["lag"], limits=dict(limits))
        if live._gate is not None:
            live._gate.restore(outside)
        if live._window is not None:
            live._window.restore(extra["window"])
        live._last, live._ignored, live._cold = extra["last"], extra["ignored"], extra.get("cold", True)
        live._awaits = extra.get("awaits", NOTHING)
        live._alarms = tuple(LiveAlarm.of(state, tracker, live.names) for state in extra.get("alarms", ()))
        restore(source, tracker, arrays, "state_", live.lane())
        live._be_careful()
        return live

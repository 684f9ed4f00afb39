"""Live: one sample at a time, with the same compiled step as a record, bit for bit.

In a control loop the input u_t is chosen after y_t has been read. With nk of at least 1 it is not needed before that:

    step = live.update(y_t)      u_t = control law(live.theta, live.cov, ...)      live.apply(u_t)

gives the same bits as the record with u_t and y_t in one row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from driftfit.data.arguments import check_roles
from driftfit.data.clock import instant
from driftfit.data.labels import by_name
from driftfit.data.signals import noise_of
from driftfit.data.storage import Kept
from driftfit.engine.arrays import as_numbers, factor
from driftfit.engine.drivers import as_compiled, one_or_all
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.fixed_lag import FixedLag, Window
from driftfit.run.live.interventions import HELD, ORDINARY, Operated
from driftfit.run.live.late_input import INPUT, LATER, NOTHING
from driftfit.run.live.outputs import LiveOutputs
from driftfit.run.live.rule import AlarmRule
from driftfit.run.live.stream import Stream
from driftfit.run.program import state_of
from driftfit.run.warm_start import Run
from driftfit.trackers.base import Tracker

Step = tuple[float, float, float, bool]
"""(y_hat, e, s, ok): one-step prediction, innovation, its variance, and whether the sample was used."""

_FLOAT, _ARRAY = np.dtype(np.float64), np.ndarray


class Live(Operated, Stream):
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
        self._begin(model, tracker, dt, lag, warm_start, limits)
        (self.program,), (self.tracker,) = self.programs, self.trackers
        self._windows = [Window(self.model, self.tracker, lag)] if lag else []
        self._open()

    def _open(self) -> None:
        """Compile the step."""
        tile = self._tile
        self._scratch = tile.copy()
        self._bytes, self._scratch_bytes = tile.view(np.uint8), self._scratch.view(np.uint8)
        self._m = self.model.m
        self._unknown = np.full(self._m, np.nan)
        self._shape = (self._m,)
        self._interval = tile["interval"][0]
        self._unit = self._clock.count if self._clock.kind in ("number", "unset") else 0.0
        self._update = self.program.drivers().updater(tile, self._m)
        self._seen, self._scratch_seen = as_compiled(tile), as_compiled(self._scratch)  # views
        self._expect(self._awaits)

    def _expect(self, what: int) -> None:
        super()._expect(what)
        # whether a sample needs more than a call of the compiled step
        self._careful = self._gate is not None or bool(self._windows or self._watching) or what != NOTHING

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
            return self._update_with_extra(y, u, time, weight, drift, prob)
        if weight != 1.0 or drift != 1.0 or self._careful:
            return self._sample(y, u, time, weight, drift)  # type: ignore[no-any-return]
        if not isinstance(y, float):
            y = float(as_numbers("y", y))
        if type(u) is not float or self._m != 1:
            if u is LATER and self._m:
                return self._update_later(y) if time is None else self._sample(y, u, time, weight, drift)
            if type(u) is _ARRAY and self._m == 1 and u.size == 1:
                u = u.item()
            if type(u) is not float or self._m != 1:
                u = self._floats(u)
        if time is None:
            return self._update(self._seen, y, u)  # type: ignore[no-any-return]
        return self._update_at(y, u, time)

    def _floats(self, u: Any) -> Any:
        """The inputs as the compiled step takes them; it reads m floats from any address, so they must exist."""
        if type(u) is _ARRAY and u.dtype is _FLOAT and u.shape == self._shape and self._m != 1:
            return u
        return one_or_all(self._inputs(u))

    def _update_at(self, y: float, u: Any, time: Any) -> Step:
        """A sample whose only known factor is its time: the interval is written for this step alone."""
        last = self._last
        if type(time) is float and type(last) is float and self._unit:  # `Clock.since` for the commonest case
            interval = (time - last) / self._unit if last < time < np.inf else np.nan
        else:
            clock, time = self._clock.at(time), instant(time)
            interval = clock.since(last, time)
            self._clock = clock
        if not interval >= 0.0:
            self._ignored += 1
            return self._nothing()
        self._last = time
        self._pace.see(interval)
        resting = self._interval[0]
        if resting:  # 0 while the stream is held: no time passes
            self._interval[0] = interval
        step: Step = self._update(self._seen, y, u)
        self._interval[0] = resting
        return step

    def _update_with_extra(self, y: Any, u: Any, time: Any, weight: float, drift: Any, prob: Any) -> Step:
        """A sample with more known factors than interval, noise and drift."""
        each = np.ndim(drift) == 1
        if each or prob is not None:
            self.tracker.set_extra(self.lane(), self.model, prob, drift if each else None)
        try:
            return self._sample(y, u, time, weight, 1.0 if each else float(drift))  # type: ignore[no-any-return]
        finally:
            if each or prob is not None:
                self.tracker.set_extra(self.lane(), self.model, None, None)

    def _factors(self, interval: float, weight: Any, drift: Any) -> tuple[float, float, float]:
        noise = 1.0 if weight == 1.0 else float(noise_of(weight))
        return interval, noise, 1.0 if drift == 1.0 else float(factor("drift", drift))

    def _checked(self, y: Any, u: Any) -> tuple[float, Array]:
        given, inputs = float(as_numbers("y", y)), self._inputs(u)
        if self._gate is not None:
            (given,), inputs = self._gate.sample(np.array([given]), inputs)
        return float(given), inputs

    def _nothing(self) -> Step:
        return (np.nan, np.nan, np.nan, False)

    def _step(self, y: float, u: Array, known: tuple[float, float, float], time: Any) -> Step:
        known = HELD if self.held else known
        self._rest(known)
        step: Step = self._update(self._seen, y, one_or_all(u))
        for _, alarm in self._watching:
            alarm.take(self._tile, 0, step[1], step[2], time)
        if known is not HELD:
            self._rest(ORDINARY)
        for window in self._windows:
            window.push(self._tile, known)
        return step

    def _settle(self, held: bool, told: bool) -> None:
        self._rest(HELD if held else ORDINARY)
        if told:
            self.tracker.set_extra(self.lane(), self.model, None, None)

    def _update_later(self, y: float) -> Step:
        """A sample without known factors, whose input comes with `apply`."""
        self._placing()
        step: Step = self._update(self._seen, y, one_or_all(self._unknown))
        self._expect(INPUT)
        return step

    def predict(self, u: Any = None) -> tuple[float, float]:
        """(y_hat, s): the prediction of the next output if its input is ``u``; the state stays unchanged.

        While `apply` is outstanding ``u`` is the input that it would receive, so that candidates can be compared.
        """
        self._scratch_bytes[:] = self._bytes  # copying a record field by field takes ten times as long
        inputs = self._inputs(u) if self._gate is None else self._gate.inputs(self._inputs(u))
        self._put(self._scratch, inputs)
        y_hat, _, s, _ = self._update(self._scratch_seen, np.nan, one_or_all(inputs))
        return y_hat, s

    def smooth(self) -> FixedLag:
        """The last ``lag`` + 1 samples, oldest first, each estimated from all samples so far: theta, std (lag + 1, n).

        Row 0 equals the result of `Track.smooth` at that sample for a record that ends now.
        """
        ((_, window),) = self._windowed()
        return window.smooth(self._tile)

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
        alarm = self._watch(0, rule, wait)
        self._expect(self._awaits)
        return alarm

    @property
    def alarms(self) -> tuple[LiveAlarm, ...]:
        """The alarms that watch this stream, in the order in which `detect` made them."""
        return tuple(alarm for _, alarm in self._watching)

    def lane(self) -> dict[str, Array]:
        """The fields of the record, as views."""
        return state_of(self._tile)

    def _fields(self) -> Mapping[str, Array]:
        return self.lane()

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
        var: Array = self._tile["var"][0, :, 0]
        return np.sqrt(var) if self.tracker.covariance else np.full(len(var), np.nan)

    @property
    def cov(self) -> Array:
        """Covariance of theta, (n, n)."""
        return self.tracker.cov(self.lane())

    @property
    def learning(self) -> Array:
        """Which parameters are being learned now, (n,) bool: False if recent inputs had too little excitation."""
        return self.tracker.learning(self.lane())

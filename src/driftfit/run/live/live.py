"""Live: one sample at a time, with the same compiled step as a record, bit for bit.

In a control loop the input u_t is chosen after y_t has been read. With nk of at least 1 it is not needed before that:

    step = live.update(y_t)      u_t = control law(live.theta, live.cov, ...)      live.apply(u_t)

gives the same bits as the record with u_t and y_t in one row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, overload

import numpy as np

from driftfit.data.arguments import check_roles
from driftfit.data.instants import instant
from driftfit.engine.drivers import one_or_all
from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers
from driftfit.engine.tiles import as_compiled
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.batch import Batch, Batched, LiveOutput
from driftfit.run.live.fixed_lag import FixedLag, Window
from driftfit.run.live.rule import AlarmRule
from driftfit.run.live.stream import HELD, INPUT, LATER, NOTHING, ORDINARY, Factors
from driftfit.run.program import Program
from driftfit.run.warm_start import Run
from driftfit.trackers.base import Tracker

Step = tuple[float, float, float, bool]
"""(y_hat, e, s, ok): one-step prediction, innovation, its variance, and whether the sample was used."""

Steps = tuple[Array, Array, Array, Array]
"""The same for several outputs, each (ny,)."""

ROWS = "rows"
"""The name of the alarm of outputs that share one theta."""

_, ONE, _ = ORDINARY
"""The factors of a sample that gives none, compared by identity: comparing numbers takes longer."""
_FLOAT, _ARRAY = np.dtype(np.float64), np.ndarray


class Live(Batched):
    """Track a stream.

    With several outputs y and all that `update` returns are (ny,); ``theta`` and ``std`` are (ny, n), or (n,) where the
    outputs share one theta. A stream can be copied, pickled and sent to another process, as well as saved: it continues
    as if never stopped. ``live["level"]`` shows one of several outputs, whose estimates are (n,).

    Parameters
    ----------
    model, tracker : Model, Tracker
        As for `track`. A model with several inputs must declare them: ``ARX(2, [1, 1])``, ``inputs=["pressure",
        "flow"]``. With several outputs ``tracker`` may map the name of each output to its tracker.
    dt : number, duration, step of the calendar or "label"
        Nominal interval between samples, as for `track`; with datetimes it is required.
    lag : int
        Keep the last ``lag`` samples for `smooth`; 0 keeps none.
    warm_start : Track, Outputs, Live or None
        Continue where that run ended; it has the same outputs.
    limits : mapping from signals to (low, high)
        Valid ranges as for `track`: a number outside its range is missing, and counted in ``outside``.
    gate : bool, Gate or None
        Whether readings are judged before they are used, as for `track`; ``left_out`` counts what was refused.

    Memory is constant. One update costs a call of a compiled function: well below a microsecond for a few parameters.
    """

    def __init__(
        self, model: Model, tracker: Any = None, dt: Any = None, lag: int = 0, warm_start: Run | None = None,
        limits: Mapping[Any, Any] | None = None, gate: Any = None,
    ) -> None:  # fmt: skip
        check_roles("Live", model, tracker, several=isinstance(model, Model) and len(model.outputs) > 1)
        self._begin(model, tracker, dt, lag, warm_start, limits, gate)
        if lag:
            regression = self._rows if self._single else Regression(self._rows.n)
            rows = (lag + 1) * len(self.model.outputs) - 1 if self.model.shared else lag
            self._windows = [Window(regression, one, rows) for one in self.trackers]
        self._open()

    def _open(self) -> None:
        """Compile the step."""
        tile = self._tile
        self._scratch = tile.copy()
        self._bytes, self._scratch_bytes = tile.view(np.uint8), self._scratch.view(np.uint8)
        self._interval = tile["interval"][0]
        self._unit = self._clock.count if self._clock.kind in ("number", "unset") else 0.0
        gated = self._single and self.programs[0].gate is not None
        self._undecided = gated and bool(tile["gate_decided"][0, 0] < 1)
        if self._single:
            self._look = self.program.drivers().updater(tile, self._m)
            self._update = self._noting(self._look) if gated else self._look
            self._compiled, self._compiled_scratch = as_compiled(tile), as_compiled(self._scratch)  # views
        self._expect(self._awaits)

    def _expect(self, what: int) -> None:
        super()._expect(what)
        # whether a sample needs more than a call of the compiled step of one output
        self._careful = (
            not self._single
            or self._limits is not None
            or bool(self._windows or self._watching or self._undecided)
            or what != NOTHING
        )

    @property
    def program(self) -> Program:
        """The program of the one theta; ValueError if each output has its own."""
        if len(self.programs) > 1:
            raise ValueError(f"this needs a stream of one output; this one has {', '.join(self.model.outputs)}.")
        return self.programs[0]

    @property
    def tracker(self) -> Tracker:
        """The tracker of the one theta; ValueError if each output has its own."""
        return self.program.tracker

    @property
    def names(self) -> tuple[Any, ...]:
        """Names of the parameters; one tuple for each output where they have one theta each."""
        found = tuple(one.names for one in self.programs)
        return found[0] if len(found) == 1 else found

    def __getitem__(self, output: str | int) -> LiveOutput:
        """One of several outputs that each have their own theta, by name or index; KeyError for any other."""
        outputs = self.model.outputs if len(self.programs) > 1 else ()
        if output not in outputs and output not in range(len(outputs)):
            there = f"there are {', '.join(outputs)}" if outputs else "this stream has one theta, live.theta"
            raise KeyError(f"there is no output {output!r}; {there}.")
        return LiveOutput(self, output if isinstance(output, int) else outputs.index(output))

    __iter__ = None
    """A stream is no sequence: `update` processes its samples."""

    @overload
    def update(
        self, y: float | None, u: Any = LATER, time: Any = None, weight: float = 1.0, drift: Any = 1.0, prob: Any = None
    ) -> Step: ...

    @overload
    def update(
        self, y: Array | Sequence[Any] | Mapping[str, Any], u: Any = LATER, time: Any = None, weight: Any = 1.0,
        drift: Any = 1.0, prob: Any = None,
    ) -> Steps: ...  # fmt: skip

    def update(
        self, y: Any, u: Any = LATER, time: Any = None, weight: Any = ONE, drift: Any = ONE, prob: Any = None
    ) -> Any:
        """Process one sample and return (y_hat, e, s, ok), numbers, or arrays (ny,) for several outputs.

        ``y`` is a number, or for several outputs an array (ny,) or a mapping from their names; None, NaN or inf if it
        is missing. ``u`` is a number for one input, a sequence of m otherwise ((ny, m) where outputs share one theta),
        or a mapping from the names of the inputs; None if it is missing. If ``u`` is left out, it comes with `apply`,
        before the next sample; ValueError for a model that has inputs and needs them at once. With ``time``, the
        interval since the last sample scales the drift; a time that is not after the last is counted in ``ignored`` and
        leaves the state unchanged. ``weight`` divides the noise variance of this sample (0: do not use it); it is one
        number, or one for each output, ``drift`` multiplies the drift before the sample: one number, or one for each
        parameter (random-walk trackers) or change (`Bank`). A `Bank` also takes ``prob``, prior probabilities of its
        changes or joint events at this sample.
        """
        if self._careful or weight is not ONE or drift is not ONE or prob is not None:
            return self._update_known(y, u, time, weight, drift, prob)
        if not isinstance(y, float):
            y = float(as_numbers("y", y))
        if type(u) is not float or self._m != 1:
            if u is LATER and self._m:
                return self._update_later(y) if time is None else self._sample(y, u, time, weight, drift)
            if self._m == 1 and (type(u) is np.float64 or (type(u) is _ARRAY and u.size == 1)):
                u = u.item()
            if type(u) is not float or self._m != 1:
                u = self._floats(u)
        if time is None:
            self._samples += 1
            return self._update(self._compiled, y, u)
        return self._update_at(y, u, time)

    def _floats(self, u: Any) -> Any:
        """The inputs as the compiled step takes them; it reads m floats from any address, so they must exist."""
        if type(u) is _ARRAY and u.dtype is _FLOAT and u.shape == self._shape and self._m != 1:
            return u
        return one_or_all(self.inputs_of(u))

    def _update_at(self, y: float, u: Any, time: Any) -> Any:
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
        self._samples += 1
        self._pace.see(interval)
        resting = self._interval[0]
        if resting:  # 0 while the stream is held: no time passes
            self._interval[0] = interval
        step: Step = self._update(self._compiled, y, u)
        self._interval[0] = resting
        return step

    def _update_known(self, y: Any, u: Any, time: Any, weight: Any, drift: Any, prob: Any) -> Any:
        """A sample with known factors, or of a stream that needs more than a call of the compiled step."""
        each = type(drift) is not float and np.ndim(drift) == 1
        if not (self._careful or each) and prob is None and weight == drift == 1.0:
            return self.update(y, u, time)
        if each or prob is not None:
            self._set_extra(prob, drift if each else None)
        try:
            return self._sample(y, u, time, weight, 1.0 if each else float(drift))
        finally:
            if each or prob is not None:
                self._set_extra(None, None)

    def _step(self, y: Array, u: Array, known: Any, time: Any) -> Any:
        resting = self.resting
        known = HELD if resting == HELD else known
        if self._single:
            self._rest(known)
            step = self._update(self._compiled, float(y[0]), one_or_all(u))
            if self._undecided:
                self._decide()
            if self._watching or self._windows:
                self._keep(y, np.reshape(known, (3, 1)), time)
        else:
            out = np.empty(len(y) if self.model.shared else 1, self._row_type)
            self._drive(*self._row(y, u, known), out, None if time is None else [time] * len(out))
            step = self._reported(out)
        self._rest(resting)
        return step

    def _decide(self) -> None:
        """See whether the gate has judged the first samples, and take the codes that it found out of the state."""
        tile = self._tile
        if tile["gate_replay"][0, 0] > 0:
            self._note_start(self._samples - 1, self._last, self.program.replay(tile))
        self._undecided = bool(tile["gate_decided"][0, 0] < 1)
        self._expect(self._awaits)

    def _row(self, y: Array, u: Array, known: Factors) -> tuple[Array, Array, Array]:
        """(y, u, known) of a sample of several outputs, as drivers take them."""
        ny, shared = len(y), self.model.shared
        columns = np.empty((ny, 3) if shared else (3, ny))
        interval, noise, drift = columns.T if shared else columns
        interval[:], noise[:], drift[:] = known
        if not shared:
            return y[None], np.repeat(u.reshape(1, self._m, 1), ny, axis=2), columns[None]
        interval[1:] = 0.0  # the rows of an instant are successive samples between which no time passes
        return y[:, None], u[:, :, None], columns[:, :, None]

    def _reported(self, out: Array) -> Steps:
        """What `update` returns of the rows of a sample."""
        batch = Batch(out, self._rows_per_instant)
        return batch.prediction[0], batch.innovation[0], batch.innovation_var[0], batch.ok[0]

    def _update_later(self, y: float) -> Step:
        """A sample without known factors, whose input comes with `apply`."""
        self._placing()
        self._samples += 1
        step: Step = self._update(self._compiled, y, one_or_all(self._unknown))
        self._expect(INPUT)
        return step

    def predict(self, u: Any = None) -> tuple[Any, Any]:
        """(y_hat, s): the prediction of the next output if its input is ``u``; the state stays unchanged.

        Both are numbers, or (ny,) for several outputs. While `apply` is outstanding ``u`` is the input that it would
        receive, so that candidates can be compared.
        """
        self._scratch_bytes[:] = self._bytes  # copying a record field by field takes ten times as long
        inputs = self.inputs_of(u) if self._limits is None else self._limits.inputs(self.inputs_of(u))
        self._put(self._scratch, inputs)
        if self._single:
            y_hat, _, s, _ = self._look(self._compiled_scratch, np.nan, one_or_all(inputs))
        else:
            missing = np.full(len(self.model.outputs), np.nan)
            y_hat, _, s, _ = self._passed(self._scratch, missing, inputs, self.resting)
        return y_hat, s

    def pass_by(self, y: Array, u: Any) -> None:
        """Let one nominal sample of several outputs pass: y goes to the lags and is not used."""
        resting = self.resting
        self._passed(self._tile, y, self.inputs_of(u), (1.0, np.inf, 1.0))
        self._rest(resting)

    def _passed(self, tile: Array, y: Array, u: Array, known: Factors) -> Steps:
        """Drive a tile of several outputs over a sample that neither alarms nor windows see."""
        signals = self._row(y, u, known)
        out = np.empty(len(signals[0]), self._row_type)
        self._loop(tile, *signals, out)
        return self._reported(out)

    def smooth(self) -> FixedLag:
        """The last ``lag`` + 1 samples, oldest first, each estimated from all samples so far: theta, std (lag + 1, n).

        They are (lag + 1, ny, n) for outputs that each have their own theta. Row 0 equals the result of `Track.smooth`
        at that sample for a record that ends now.
        """
        if not self._windows:
            raise ValueError("Live.smooth: no samples are kept; give their number, as in Live(model, tracker, lag=20).")
        found = [window.smooth(self._tile, lane) for lane, window in enumerate(self._windows)]
        if len(found) > 1:
            return FixedLag(*(np.stack(part, axis=1) for part in zip(*found, strict=True)))
        ny = self._rows_per_instant
        return FixedLag(*(part[ny - 1 :: ny] for part in found[0]))

    @overload
    def detect(self, rule: AlarmRule, wait: int | None = None) -> LiveAlarm: ...

    @overload
    def detect(self, rule: Mapping[str, AlarmRule], wait: int | None = None) -> dict[str, LiveAlarm]: ...

    def detect(self, rule: Any, wait: int | None = None) -> Any:
        """Watch the stream from the next sample on by the rule of a reference run, ``run.detect(...).rule``.

        After every update the alarm shows whether it is on, whether it has just begun, and its cause (`LiveAlarm`). It
        is saved with the state; `alarms` returns all of them. Over the same samples it gives the alarms of
        ``Track.detect(rule, start=...)`` on the record, bit for bit.

        Parameters
        ----------
        rule : AlarmRule, or mapping from the names of outputs to rules
            Limits and settings. The tracker should be that of the reference run. Where each of several outputs has its
            own theta, give the rules by output, ``{"flow": run["flow"].detect(...).rule}``; a later rule replaces an
            earlier one. Outputs that share one theta have one rule, and the alarm counts their rows.
        wait : int or None
            Number of samples that are not judged. None: those of the start, max(50, 5 n); 0 after a warm start.

        Returns
        -------
        The alarm, or for several outputs the alarms by output.

        Raises
        ------
        ValueError
            If the tracker or model does not support the rule, or for an unknown output.
        """
        if self._single:
            alarm = self._watch(0, rule, wait)
            self._expect(self._awaits)
            return alarm
        rules = {ROWS: rule} if isinstance(rule, AlarmRule) else rule
        lanes = {ROWS: 0} if self.model.shared else {name: lane for lane, name in enumerate(self.model.outputs)}
        if any(name not in lanes for name in rules):
            raise ValueError(
                f"Live.detect: give rules by the name of their output; got {list(rules)!r}, and the outputs are "
                f"{', '.join(self.model.outputs)}."
            )
        replaced = {lanes[name] for name in rules}
        self._watching = [(lane, alarm) for lane, alarm in self._watching if lane not in replaced]
        for name, one in rules.items():
            self._watch(lanes[name], one, wait)
        return self.alarms

    @property
    def alarms(self) -> Any:
        """The alarms that watch this stream, in the order in which `detect` made them; of several outputs by name."""
        if self._single:
            return tuple(alarm for _, alarm in self._watching)
        return {ROWS if self.model.shared else self.model.outputs[lane]: alarm for lane, alarm in self._watching}

    def before(self, steps: float) -> Any:
        """The time so many nominal intervals before the last sample; None where samples have no times."""
        time = None if self._last is None else self._clock.moved(self._last, np.array([-steps]))
        return None if time is None else time[0]

    def driven_on(self, inputs: Array) -> tuple[list[tuple[Program, Array]], Array]:
        """(each program with a copy of its state that a forecast may advance, the inputs (h, m) for it).

        While `apply` is outstanding, its input is the first of the inputs. Outputs that are regressors of each other
        are left out.
        """
        apart = [(one if self._single else one.alone, lane) for lane, one in enumerate(self.programs)]
        copies = [(one, one.resting(self.lane(lane))) for one, lane in apart if one is not None]
        if self._awaits == INPUT and copies:
            for _, tile in copies:
                self._placing()(as_compiled(tile), inputs[0])
            inputs = np.vstack([inputs[1:], np.full((1, self._m), np.nan)])
        return copies, inputs

    @property
    def theta(self) -> Array:
        """Parameters now, (n,), or (ny, n) where each output has its own."""
        return self._of_lanes("theta")

    @property
    def std(self) -> Array:
        """Their standard deviations: inf for parameters that are not determined yet, NaN without a covariance."""
        var = self._of_lanes("var")
        return np.sqrt(var) if self.programs[0].tracker.covariance else np.full(var.shape, np.nan)

    @property
    def cov(self) -> Array:
        """Covariance of theta, (n, n), or (ny, n, n)."""
        return self._by_lane(lambda tracker, lane: tracker.cov(lane))

    @property
    def learning(self) -> Array:
        """Which parameters are being learned now, bool in the shape of theta: False if recent inputs had too little
        excitation.
        """
        return self._by_lane(lambda tracker, lane: tracker.learning(lane))

    @property
    def regressors(self) -> Array:
        """The regressors of the last sample, (n,)."""
        return np.asarray(self._tile["phi"][0, :, 0].copy())

    def _of_lanes(self, name: str) -> Array:
        """A field (n,) of the one theta, or (ny, n)."""
        values: Array = self._tile[name][0].T.copy()
        return values[0] if len(values) == 1 else values

    def _by_lane(self, found: Callable[[Tracker, dict[str, Array]], Array]) -> Array:
        """The results of a function of each tracker and its lane, stacked; a single result if there is one theta."""
        parts = [found(tracker, self.lane(lane)) for lane, tracker in enumerate(self.trackers)]
        return parts[0] if len(parts) == 1 else np.array(parts)

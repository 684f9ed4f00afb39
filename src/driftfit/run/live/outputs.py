"""Streams with several outputs: the same steps as `driftfit.run.outputs`, one sample at a time, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.data import storage
from driftfit.data.clock import Clock, Pace, instant
from driftfit.data.labels import by_name, order_of
from driftfit.data.limits import Gate
from driftfit.data.signals import noise_of
from driftfit.engine.arrays import as_numbers, factor
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.live.alarm import LiveAlarm, check_rule
from driftfit.run.live.fixed_lag import FixedLag, Window
from driftfit.run.live.late_input import IGNORED, INPUT, LATER, NOTHING, applier, check_applied, check_expected
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import Program, programs_of, state_of, tile_of
from driftfit.run.public_class import Plain
from driftfit.run.result import burn_in
from driftfit.run.warm_start import End, Run, carried
from driftfit.trackers.base import Tracker

Steps = tuple[Array, Array, Array, Array]
"""(y_hat, e, s, ok), each (ny,)."""


class LiveOutputs(Plain, storage.Kept):
    """Track a stream with several outputs; what `Live` gives for a model with ``ny`` above 1.

    ``theta`` and ``std`` are (ny, n), or (n,) where the outputs share one theta. ``tracker`` is one for all, or a
    mapping from the name of each output to its tracker. Times and drifts are those of `Live`; so are weights, or there
    is one for each output. ``warm_start`` is a record or a stream of the same outputs.
    """

    _kind: ClassVar[str] = "outputs"

    def __init__(
        self, model: Model, tracker: Any, dt: Any = None, lag: int = 0, warm_start: Run | None = None,
        limits: Mapping[Any, Any] | None = None,
    ) -> None:  # fmt: skip
        self.model = model if model.shared else model.bind(model.m)
        self.programs = programs_of(self.model, tracker, self.model.m)
        self._clock = Clock.of(dt)
        self.dt = self._clock.plain
        self._pace = Pace(self._clock, model.reach)
        self.lag = whole("Live", "lag", lag, 0)
        if lag and warm_start is not None:
            raise ValueError("Live: lag= and warm_start= cannot be combined; give one of them.")
        before = None if warm_start is None else warm_start.end()
        self._last: Any = None if before is None else before.last
        self._awaits = NOTHING if before is None else before.awaits
        self._cold = before is None
        self._ignored = 0
        self._alarms: dict[str, LiveAlarm] = {}
        self._place: Any = None
        self._rows = self.programs[0].model
        self._gate = Gate(limits, model.outputs, self._rows.input_names, self._rows.m) if limits else None
        self._tile = tile_of(self.programs, carried(warm_start, self.programs))
        self._out = self.programs[0].written(self._tile, 1)
        self._run = self.programs[0].drivers().run
        rows = (lag + 1) * len(self.model.outputs) - 1 if self.model.shared else lag
        self._windows = [Window(Regression(self._rows.n), one, rows) for one in self.trackers] if lag else []

    @property
    def trackers(self) -> tuple[Tracker, ...]:
        """The tracker of each output, or of the theta that they share."""
        return tuple(one.tracker for one in self.programs)

    def update(self, y: Any, u: Any = LATER, time: Any = None, weight: Any = 1.0, drift: Any = 1.0) -> Steps:
        """Process one sample: y (ny,), u (m,), or (ny, m) where the outputs share one theta.

        u is None if it is not known; if it is left out, it comes with `apply`, as in `Live.update`. y may map the names
        of the outputs to numbers, and u those of the inputs if the model has names for them.
        """
        ny = len(self.model.outputs)
        check_applied(self._awaits)
        later = u is LATER and self._rows.m > 0
        if later:
            self._placing()
        if time is not None:
            self._clock, time = self._clock.at(time), instant(time)
        interval = 1.0 if time is None else self._clock.since(self._last, time)
        if not interval >= 0.0:
            self._ignored += 1
            self._awaits = IGNORED if later else NOTHING
            nothing = np.full(ny, np.nan)
            return nothing, nothing, nothing, np.zeros(ny, bool)
        known = self._known(interval, weight, drift)
        output, inputs = self._outputs(y), self._inputs(None if u is LATER else u)
        if self._gate is not None:
            output, inputs = self._gate.sample(output, inputs)
        step = self._step(self._tile, output, inputs, known, self._windows)
        if time is not None:
            self._last = time
            self._pace.see(interval)
        for name, alarm in self._alarms.items():
            lane = self.model.outputs.index(name)
            alarm.take(self._tile, lane, step[1][lane], step[2][lane], time)
        self._awaits = INPUT if later else NOTHING
        return step

    def _outputs(self, y: Any) -> Array:
        """y as floats (ny,)."""
        outputs = self.model.outputs
        if hasattr(y, "keys"):
            order_of("Live.update: the model", outputs, list(y.keys()), "outputs")
            y = [y[name] for name in outputs]
        given = as_numbers("y", y)
        if given.shape != (len(outputs),):
            raise ValueError(f"Live.update: y must be ({len(outputs)},); got shape {given.shape}.")
        return given

    def _inputs(self, u: Any) -> Array:
        """u as floats (m,), or (ny, m) where the outputs share one theta."""
        shape = (len(self.model.outputs), self._rows.m) if self.model.shared else (self._rows.m,)
        if u is None:
            return np.full(shape, np.nan)
        given = as_numbers("u", u if self.model.shared else by_name(self.model, u))
        if given.size != np.prod(shape):
            raise ValueError(f"Live.update: u must have shape {shape}; got shape {given.shape}.")
        return given.reshape(shape)

    def apply(self, u: Any) -> None:
        """Give the inputs (m,) of the last sample once they have been chosen; see `Live.apply`."""
        check_expected(self._awaits)
        inputs = self._inputs(u)
        if self._gate is not None and self._awaits == INPUT:
            _, inputs = self._gate.sample(np.full(len(self.model.outputs), np.nan), inputs)
        self._apply(self._tile, inputs)
        self._awaits = NOTHING

    def _apply(self, tile: Array, inputs: Array) -> None:
        """Write the inputs that were outstanding into a tile."""
        if self._awaits == INPUT:
            self._placing()(tile, inputs)

    def _placing(self) -> Any:
        """The routine that writes late inputs into the state; ValueError for a model that needs them at once."""
        if self._place is None:
            self._place = applier(self.model, self.trackers[0], self._tile)
        return self._place

    @property
    def awaits(self) -> bool:
        """Whether the inputs of the last sample are outstanding: they come with `apply`."""
        return self._awaits != NOTHING

    def _known(self, interval: float = 1.0, weight: Any = 1.0, drift: Any = 1.0) -> Array:
        """What the driver knows of one sample, (k, ny)."""
        ny = len(self.model.outputs)
        each = np.ndim(drift) == 1
        known = np.ones((3, ny))
        known[0], known[1] = interval, noise_of(weight, ny)
        known[2] = 1.0 if each else factor("drift", drift)
        if not each:
            return known
        columns = self.trackers[0].beside(self._rows, 1, None, np.asarray(drift)[None])
        return np.vstack([known, np.repeat(columns.T, ny, axis=1)])

    def predict(self, u: Any = None) -> tuple[Array, Array]:
        """(y_hat, s), each (ny,): what the next outputs are expected to be; the state stays as it is.

        While `apply` is outstanding u stands for what it would bring.
        """
        missing, tile = np.full(len(self.model.outputs), np.nan), self._tile.copy()
        inputs = self._inputs(u) if self._gate is None else self._gate.inputs(self._inputs(u))
        if self.awaits:
            self._apply(tile, inputs)
        y_hat, _, s, _ = self._step(tile, missing, inputs, self._known(), [])
        return y_hat, s

    def detect(self, rules: Mapping[str, AlarmRule], wait: int | None = None) -> dict[str, LiveAlarm]:
        """Watch outputs by the rules of reference runs, by name: ``{"flow": run["flow"].detect(...).rule}``.

        One rule per output; ``wait`` and the alarms are those of `Live.detect`. ValueError where the outputs share one
        theta, or for an unknown name.
        """
        start = burn_in(self._rows.n) if self._cold else 0
        wait = start if wait is None else whole("Live.detect", "wait", wait, 0)
        absent = [name for name in rules if name not in self.model.outputs]
        if self.model.shared or absent:
            raise ValueError(
                f"Live.detect: rules are for outputs with separate theta; got {list(rules)}, and the outputs are "
                f"{', '.join(self.model.outputs)}."
            )
        for name, rule in rules.items():
            lane = self.model.outputs.index(name)
            self._alarms[name] = LiveAlarm(check_rule(rule), self.trackers[lane], self.names[lane], wait)
        return self.alarms

    @property
    def alarms(self) -> dict[str, LiveAlarm]:
        """The alarms that watch outputs, by name."""
        return dict(self._alarms)

    def pass_by(self, y: Array, u: Any) -> None:
        """Let one nominal sample pass whose outputs go to the lags and are not used."""
        self._step(self._tile, y, self._inputs(u), self._known(weight=0.0), [])

    def _step(self, tile: Array, y: Array, u: Array, known: Array, windows: list[Window]) -> Steps:
        """One call of the driver, or one for each row of the instant."""
        ny, m = len(self.model.outputs), self._rows.m
        said = []
        if self.model.shared:
            for j, row in enumerate(u):
                same = known[None, :, j : j + 1].copy()
                same[0, 0] *= j == 0
                self._run(tile, y[None, j : j + 1], row[None, :, None], same, self._out)
                said.append(self._said())
                self._push(tile, same[0], windows)
        else:
            self._run(tile, y[None], np.repeat(u.reshape(1, m, 1), ny, axis=2), known[None], self._out)
            said.append(self._said())
            self._push(tile, known, windows)
        self._rest(tile)
        y_hat, e, s, ok = (np.concatenate(values) for values in zip(*said, strict=True))
        return y_hat, e, s, ok

    def _push(self, tile: Array, known: Array, windows: list[Window]) -> None:
        for lane, window in enumerate(windows):
            window.push(tile, (known[0, lane], known[1, lane], known[2, lane]), lane)

    def _rest(self, tile: Array) -> None:
        """Reset what was known of one sample, because it does not hold for the next."""
        if "each" in storage.fields(tile):
            tile["each"] = 1.0

    def _said(self) -> Steps:
        """What the driver wrote, one number per lane."""
        out = self._out[0]
        return out["y_hat"].copy(), out["e"].copy(), out["s"].copy(), out["ok"] > 0.0

    def alone(self) -> list[tuple[Program, Array]]:
        """Each output with its state as a tile of its own; none where outputs are regressors of each other."""
        found = [(one.alone, lane) for lane, one in enumerate(self.programs)]
        return [(one, one.resting(state_of(self._tile, lane))) for one, lane in found if one is not None]

    def inputs_of(self, u: Any) -> Array:
        """u as floats (m,), NaN where it is not known."""
        return self._inputs(u)

    def smooth(self) -> FixedLag:
        """The last ``lag`` + 1 samples, oldest first, each from all samples so far: theta and std.

        Each is (lag + 1, ny, n), or (lag + 1, n) where the outputs share one theta.
        """
        if not self._windows:
            raise ValueError("Live.smooth: no samples are kept; give their number, as in Live(model, tracker, lag=20).")
        found = [window.smooth(self._tile, lane) for lane, window in enumerate(self._windows)]
        if self.model.shared:
            ny = len(self.model.outputs)
            return FixedLag(found[0].theta[ny - 1 :: ny], found[0].std[ny - 1 :: ny])
        return FixedLag(np.stack([one.theta for one in found], axis=1), np.stack([one.std for one in found], axis=1))

    @property
    def theta(self) -> Array:
        """Parameters now."""
        theta: Array = self._tile["theta"][0].T.copy()
        return theta[0] if self.model.shared else theta

    @property
    def regressors(self) -> Array:
        """Those of the last sample, (n,)."""
        phi: Array = self._tile["phi"][0, :, 0].copy()
        return phi

    @property
    def cov(self) -> Array:
        """Covariance of theta, (ny, n, n), or (n, n) where the outputs share one theta."""
        lanes = range(self._tile["theta"].shape[-1])
        cov = np.array([self.trackers[l].cov(state_of(self._tile, l)) for l in lanes])
        return cov[0] if self.model.shared else cov

    @property
    def std(self) -> Array:
        """Their standard deviations."""
        std: Array = np.sqrt(np.einsum("...ii->...i", self.cov))
        return std

    @property
    def names(self) -> tuple[Any, ...]:
        """Names of the parameters, of each output where they have one theta each."""
        return self._rows.names if self.model.shared else tuple(one.names for one in self.programs)

    @property
    def ignored(self) -> int:
        """Number of samples whose time was not after the last."""
        return self._ignored

    @property
    def outside(self) -> dict[str, int]:
        """How many numbers of each signal were outside its limits."""
        return {} if self._gate is None else self._gate.counts

    def end(self) -> End:
        """The present state of the stream, from which another run can continue (`warm_start`)."""
        lanes = range(len(self.programs))
        states = tuple({n: value.copy() for n, value in state_of(self._tile, lane).items()} for lane in lanes)
        return End(self.programs, states, self._last, self._awaits)

    def _written(self) -> tuple[dict[str, Any], dict[str, Array]]:
        extra = {
            "dt": self.dt, "zone": self._clock.zone, "limits": None if self._gate is None else self._gate.plain(),
            "last": self._last, "ignored": self._ignored, "lag": self.lag, "awaits": self._awaits,
            "cold": self._cold, "windows": [window.plain() for window in self._windows],
            "alarms": {name: alarm.plain() for name, alarm in self._alarms.items()},
        }  # fmt: skip
        described = {"model": storage.describe(self.model), "trackers": [storage.describe(t) for t in self.trackers]}
        states = {f"state_{name}": self._tile[name][0] for name in storage.fields(self._tile)}
        return {"kind": self._kind, **described, "extra": extra}, states

    @classmethod
    def _read(cls, source: str, header: Mapping[str, Any], arrays: Mapping[str, Array]) -> Self:
        trackers = tuple(storage.rebuild(one, Tracker) for one in header["trackers"])
        return cls._again(source, storage.rebuild(header["model"], Model), trackers, header["extra"], arrays)

    def __reduce__(self) -> Any:
        header, arrays = self._written()
        return type(self)._again, ("the copy", self.model, self.trackers, header["extra"], arrays)

    @classmethod
    def _again(
        cls, source: str, model: Model, trackers: tuple[Tracker, ...], extra: Mapping[str, Any],
        arrays: Mapping[str, Array],
    ) -> Self:  # fmt: skip
        """The stream from its state."""
        tracker = trackers[0] if model.shared else dict(zip(model.outputs, trackers, strict=True))
        limits, outside = extra["limits"] or ([], [])
        live = cls(model, tracker, Clock.of(extra["dt"], extra["zone"]), extra["lag"], limits=dict(limits))
        if live._gate is not None:
            live._gate.restore(outside)
        live._last, live._ignored, live._cold = extra["last"], extra["ignored"], extra.get("cold", True)
        live._awaits = extra.get("awaits", NOTHING)
        for window, state in zip(live._windows, extra["windows"], strict=True):
            window.restore(state)
        for name, state in extra.get("alarms", {}).items():
            lane = model.outputs.index(name)
            live._alarms[name] = LiveAlarm.of(state, trackers[lane], live.names[lane])
        into = {name: live._tile[name][0] for name in storage.fields(live._tile)}
        storage.restore(source, trackers[0], arrays, "state_", into)
        return live

"""Streams with several outputs: the same steps as `driftfit.run.outputs`, one sample at a time, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from driftfit.data import storage
from driftfit.data.labels import by_name, order_of
from driftfit.data.signals import noise_of
from driftfit.engine.arrays import as_numbers, factor
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.fixed_lag import FixedLag, Window
from driftfit.run.live.late_input import LATER
from driftfit.run.live.rule import AlarmRule
from driftfit.run.live.stream import Stream
from driftfit.run.program import Program, state_of
from driftfit.run.warm_start import Run

ROWS = "rows"
"""The name of the alarm of outputs that share one theta."""

Steps = tuple[Array, Array, Array, Array]
"""(y_hat, e, s, ok), each (ny,)."""


class LiveOutputs(Stream):
    """Track a stream with several outputs; `Live` returns it for a model with ``ny`` above 1.

    ``theta`` and ``std`` are (ny, n), or (n,) where the outputs share one theta. ``tracker`` is one for all, or a
    mapping from the name of each output to its tracker. Times and drifts are those of `Live`; so are weights, or there
    is one for each output. ``warm_start`` is a record or a stream of the same outputs.
    """

    _kind: ClassVar[str] = "outputs"

    def __init__(
        self, model: Model, tracker: Any, dt: Any = None, lag: int = 0, warm_start: Run | None = None,
        limits: Mapping[Any, Any] | None = None,
    ) -> None:  # fmt: skip
        self._begin(model, tracker, dt, lag, warm_start, limits)
        self._out = self.programs[0].written(self._tile, 1)
        rows = (lag + 1) * len(self.model.outputs) - 1 if self.model.shared else lag
        self._windows = [Window(Regression(self._rows.n), one, rows) for one in self.trackers] if lag else []

    def update(self, y: Any, u: Any = LATER, time: Any = None, weight: Any = 1.0, drift: Any = 1.0) -> Steps:
        """Process one sample: y (ny,), u (m,), or (ny, m) where the outputs share one theta.

        u is None if it is not known; if it is left out, it comes with `apply`, as in `Live.update`. y may map the names
        of the outputs to numbers, and u those of the inputs if the model has names for them.
        """
        step: Steps = self._sample(y, u, time, weight, drift)
        return step

    def _checked(self, y: Any, u: Any) -> tuple[Array, Array]:
        outputs, inputs = self._outputs(y), self._inputs(u)
        return (outputs, inputs) if self._gate is None else self._gate.sample(outputs, inputs)

    def _nothing(self) -> Steps:
        ny = len(self.model.outputs)
        return np.full(ny, np.nan), np.full(ny, np.nan), np.full(ny, np.nan), np.zeros(ny, bool)

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
        if u is None or u is LATER:
            return np.full(shape, np.nan)
        given = as_numbers("u", u if self.model.shared else by_name(self.model, u))
        if given.size != np.prod(shape):
            raise ValueError(f"Live.update: u must have shape {shape}; got shape {given.shape}.")
        return given.reshape(shape)

    def _factors(self, interval: float = 1.0, weight: Any = 1.0, drift: Any = 1.0) -> Array:
        """The known numbers of one sample, (k, ny)."""
        ny = len(self.model.outputs)
        each = np.ndim(drift) == 1
        known = np.ones((3, ny))
        known[0], known[1] = interval, noise_of(weight, ny)
        known[2] = 1.0 if each else factor("drift", drift)
        if not each:
            return known
        columns = self.trackers[0].extra_columns(self._rows, 1, None, np.asarray(drift)[None])
        return np.vstack([known, np.repeat(columns.T, ny, axis=1)])

    def predict(self, u: Any = None) -> tuple[Array, Array]:
        """(y_hat, s), each (ny,): the forecast of the next outputs; the state does not change.

        While `apply` is outstanding, u is the input that it would receive.
        """
        missing, tile = np.full(len(self.model.outputs), np.nan), self._tile.copy()
        inputs = self._inputs(u) if self._gate is None else self._gate.inputs(self._inputs(u))
        self._put(tile, inputs)
        y_hat, _, s, _ = self._driven(tile, missing, inputs, self._factors())
        return y_hat, s

    def detect(self, rules: Mapping[str, AlarmRule] | AlarmRule, wait: int | None = None) -> dict[str, LiveAlarm]:
        """Watch outputs by the rules of reference runs, by name: ``{"flow": run["flow"].detect(...).rule}``.

        One rule per output; a later rule replaces an earlier one; ``wait`` and the alarms are those of `Live.detect`.
        Outputs that share one theta have one rule, of ``run.detect(...)``, and ``wait`` counts their rows. ValueError
        for an unknown name.
        """
        if isinstance(rules, AlarmRule):
            rules = {ROWS: rules}
        lanes = {ROWS: 0} if self.model.shared else {name: lane for lane, name in enumerate(self.model.outputs)}
        if any(name not in lanes for name in rules):
            raise ValueError(
                f"Live.detect: give rules by the name of their output; got {list(rules)!r}, and the outputs are "
                f"{', '.join(self.model.outputs)}."
            )
        self._watching = [
            (lane, alarm) for lane, alarm in self._watching if lane not in {lanes[name] for name in rules}
        ]
        for name, rule in rules.items():
            self._watch(lanes[name], rule, wait)
        return self.alarms

    @property
    def alarms(self) -> dict[str, LiveAlarm]:
        """The alarms that watch outputs, by name; of outputs that share one theta the one of their "rows"."""
        return {ROWS if self.model.shared else self.model.outputs[lane]: alarm for lane, alarm in self._watching}

    def pass_by(self, y: Array, u: Any) -> None:
        """Let one nominal sample pass whose outputs go to the lags and are not used."""
        self._driven(self._tile, y, self._inputs(u), self._factors(weight=0.0))

    def _step(self, y: Array, u: Array, known: Array, time: Any) -> Steps:
        return self._driven(self._tile, y, u, known, lambda known: self._keep(self._out[0], known, time))

    def _driven(
        self, tile: Array, y: Array, u: Array, known: Array, after: Callable[[Array], None] | None = None
    ) -> Steps:
        """One call of the driver, or one for each row of the instant; ``after`` follows each of them."""
        ny, m = len(self.model.outputs), self._rows.m
        results = []
        if self.model.shared:
            for j, row in enumerate(u):
                same = known[None, :, j : j + 1].copy()
                same[0, 0] *= j == 0
                self._loop(tile, y[None, j : j + 1], row[None, :, None], same, self._out)
                results.append(self._result())
                if after is not None:
                    after(same[0])
        else:
            self._loop(tile, y[None], np.repeat(u.reshape(1, m, 1), ny, axis=2), known[None], self._out)
            results.append(self._result())
            if after is not None:
                after(known)
        self._rest(tile)
        y_hat, e, s, ok = (np.concatenate(values) for values in zip(*results, strict=True))
        return y_hat, e, s, ok

    def _rest(self, tile: Array) -> None:
        """Reset the drift factors of one sample, which do not apply to the next."""
        if "drift_root" in storage.fields(tile):
            tile["drift_root"] = 1.0

    def _settle(self, held: bool, told: bool) -> None:
        self._rest(self._tile)

    def _result(self) -> Steps:
        """The results of the driver, one number per lane."""
        out = self._out[0]
        return out["y_hat"].copy(), out["e"].copy(), out["s"].copy(), out["ok"] > 0.0

    def alone(self) -> list[tuple[Program, Array]]:
        """Each output with its state in a separate tile; none where outputs are regressors of each other."""
        found = [(one.alone, lane) for lane, one in enumerate(self.programs)]
        return [(one, one.resting(state_of(self._tile, lane))) for one, lane in found if one is not None]

    def inputs_of(self, u: Any) -> Array:
        """u as floats (m,), NaN where it is not known."""
        return self._inputs(u)

    def smooth(self) -> FixedLag:
        """The last ``lag`` + 1 samples, oldest first, each from all samples so far: theta and std.

        Each is (lag + 1, ny, n), or (lag + 1, n) where the outputs share one theta.
        """
        found = [window.smooth(self._tile, lane) for lane, window in self._windowed()]
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
        var: Array = self._tile["var"][0].T
        std = np.sqrt(var) if self.trackers[0].covariance else np.full(var.shape, np.nan)
        return std[0] if self.model.shared else std

    @property
    def names(self) -> tuple[Any, ...]:
        """Names of the parameters, of each output where they have one theta each."""
        return self._rows.names if self.model.shared else tuple(one.names for one in self.programs)

    def _fields(self) -> Mapping[str, Array]:
        return {name: self._tile[name][0] for name in storage.fields(self._tile)}

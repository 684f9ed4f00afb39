"""Live: one sample at a time, the same compiled step as a record, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numba import types

from driftfit.clock import Clock, Pace, instant
from driftfit.drivers import INPUTS, drivers, tile_type
from driftfit.frames import by_name
from driftfit.kernel import Array
from driftfit.models.base import Model
from driftfit.restrict import Gate
from driftfit.settings import near, numbers, vector, whole
from driftfit.signals import as_numbers, check_ready, factor, noise_of
from driftfit.smoothers.fixed_lag import FixedLag, Window
from driftfit.storage import fields, load_state, save_state
from driftfit.trackers.base import Tracker
from driftfit.warm import End, Run, carried, fresh_tile

if TYPE_CHECKING:
    from driftfit.blocks.paths import Groups
    from driftfit.hypotheses.live_results import LiveHypotheses

Step = tuple[float, float, float, bool]
"""(y_hat, e, s, ok): one-step prediction, innovation, its variance, and whether the sample was used."""

_FLOAT = np.dtype(np.float64)
_KNOWN = ("interval", "noise", "drift")
_ORDINARY, _HELD = (1.0, 1.0, 1.0), (0.0, np.inf, 1.0)


class Live:
    """Track a stream.

    Parameters
    ----------
    model, tracker : Model, Tracker
        As for `track`. A model with several inputs must say so: ``ARX(2, [1, 1])``, ``inputs=["pressure", "flow"]``.
    dt : number, duration, step of the calendar or "label"
        Nominal interval between samples, as for `track`; with datetimes it must be given.
    lag : int
        Keep the last ``lag`` samples for `smooth`; 0 keeps none.
    warm_start : Track, Live or None
        Begin where that run ended.
    limits : mapping from signals to (low, high)
        Valid ranges as for `track`: a number outside is missing, and counted in ``outside``.

    Memory is constant. One update costs a call of a compiled function: well below a microsecond for a few parameters.
    """

    def __new__(cls, model: Model, *args: Any, **kwargs: Any) -> Any:
        """A stream with several outputs is a `LiveOutputs`."""
        if len(model.outputs) == 1:
            return super().__new__(cls)
        from driftfit.live_outputs import LiveOutputs

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
        self._last: Any = None if warm_start is None else warm_start.end().last
        self._ignored = 0
        self._separator: Any = None
        self.lag = whole("Live", "lag", lag, 0)
        if lag and warm_start is not None:
            raise ValueError("Live: what a warm start knows cannot be smoothed yet; give lag= or warm_start=.")
        self._window = Window(self.model, tracker, lag) if lag else None
        start = None if warm_start is None else carried(warm_start, self.model, tracker)
        self._open(fresh_tile(self.model, tracker, start))

    def _open(self, tile: Array) -> None:
        """Take a state and compile the step for it."""
        self._tile = tile
        self._scratch = tile.copy()
        self._m = self.model.m
        self._shape = (self._m,)
        compiled = drivers(self.model.steps, self.tracker.steps_for(self.model))
        kind = tile_type(tile)
        f8 = types.float64
        self._update = compiled.update.entry(kind, f8, INPUTS)
        self._update_one = compiled.update_one.entry(kind, f8, f8) if self._m == 1 else None

    def update(
        self,
        y: float | None,
        u: Any = None,
        time: Any = None,
        weight: float = 1.0,
        drift: Any = 1.0,
        prob: Any = None,
    ) -> Step:
        """Take one sample in and return (y_hat, e, s, ok).

        ``y`` is a number; None, NaN or inf when it is missing. ``u`` is a number for one input, a sequence of m
        otherwise, or a mapping from the names of the inputs. With ``time``, the interval since the last sample scales
        the drift; a time that is not after the last is counted in ``ignored`` and leaves the state alone. ``weight``
        divides the noise variance of this sample (0: do not use it), ``drift`` multiplies the drift before it: one
        number, or one for each parameter (random-walk trackers) or change (`Bank`). A `Bank` also takes ``prob``,
        prior probabilities of its changes or joint events at this sample.
        """
        if self._gate is not None:
            y, u = self._passed(y, u)
        if prob is not None or type(drift) is not float:
            return self._update_told(y, u, time, weight, drift, prob)
        if time is not None or weight != 1.0 or drift != 1.0 or self._window is not None:
            return self._update_known(y, u, time, weight, drift)
        if not isinstance(y, float):
            y = float(as_numbers("y", y))
        if self._update_one is not None and type(u) is float:
            return self._update_one(self._tile, y, u)  # type: ignore[no-any-return]
        # the compiled step reads m floats wherever it is pointed, so they must be there
        if not (type(u) is np.ndarray and u.dtype is _FLOAT and u.shape == self._shape):
            u = self._inputs(u)
        return self._update(self._tile, y, u)  # type: ignore[no-any-return]

    def _update_told(self, y: Any, u: Any, time: Any, weight: float, drift: Any, prob: Any) -> Step:
        """One sample of which more is known than interval, noise and drift."""
        each = np.ndim(drift) == 1
        if each or prob is not None:
            self.tracker.tell(self.lane(), self.model, prob, drift if each else None)
        try:
            return self._update_known(y, u, time, weight, 1.0 if each else float(drift))
        finally:
            if each or prob is not None:
                self.tracker.tell(self.lane(), self.model, None, None)

    def _update_known(self, y: float | None, u: Any, time: Any, weight: float, drift: float) -> Step:
        if time is not None:
            self._clock, time = self._clock.at(time), instant(time)
        interval = 1.0 if time is None else self._clock.since(self._last, time)
        if not interval >= 0.0:
            self._ignored += 1
            return (np.nan, np.nan, np.nan, False)
        known = (float(interval), float(noise_of(weight)), float(factor("drift", drift)))
        u = self._inputs(u)
        if time is not None:
            self._last = time
            self._pace.see(interval)
        known = _HELD if self.held else known
        self._rest(known)
        step: Step = self._update(self._tile, np.nan if y is None else y, u)
        if known is not _HELD:
            self._rest(_ORDINARY)
        if self._window is not None:
            self._window.push(self._tile, known)
        return step

    def _passed(self, y: Any, u: Any) -> tuple[float, Array]:
        """One sample with NaN for what is outside its limits."""
        assert self._gate is not None
        output, inputs = self._gate.sample(as_numbers("y", y).reshape(1), self._inputs(u))
        return float(output[0]), inputs

    def _rest(self, known: tuple[float, float, float]) -> None:
        """Set what holds for every sample that says nothing else."""
        for name, value in zip(_KNOWN, known, strict=True):
            self._tile[name] = value

    def predict(self, u: Any = None) -> tuple[float, float]:
        """(y_hat, s): what the next output is expected to be if its input is ``u``; the state stays as it is."""
        self._scratch[...] = self._tile
        inputs = self._inputs(u) if self._gate is None else self._gate.inputs(self._inputs(u))
        y_hat, _, s, _ = self._update(self._scratch, np.nan, inputs)
        return y_hat, s

    def smooth(self) -> FixedLag:
        """The last ``lag`` + 1 samples, oldest first, each from all samples so far: theta and std, (lag + 1, n).

        Row 0 is what `Track.smooth` would say of that sample of a record that ends now.
        """
        if self._window is None:
            raise ValueError("Live.smooth: no samples are kept; say how many, as in Live(model, tracker, lag=20).")
        return self._window.smooth(self._tile)

    def hold(self, on: bool = True) -> None:
        """Stop learning, or (``hold(False)``) take it up again: for work on the plant, a test, a sensor being cleaned.

        While held, samples move the lags and are predicted, but are not used (``ok`` is False), and no time passes
        for the parameters and their covariance. Being held is part of the state that `save` writes.
        """
        self._rest(_HELD if on else _ORDINARY)

    @property
    def held(self) -> bool:
        """Whether `hold` is on."""
        return bool(self._tile["noise"][0, 0] == np.inf)

    def reset(self, which: str | int | Sequence[str | int] | None = None, p: Any = None, theta: Any = None) -> None:
        """Tell the tracker what an operator knows: these parameters may have moved, or stand at other values now.

        Parameters
        ----------
        which : name, index, several of them, or None
            The parameters; None is all.
        p : number or one per parameter
            Variance of the move, in squared units of theta; it is added to what is uncertain already. After maintenance
            a large value lets the next samples decide.
        theta : number or one per parameter
            Where they stand now, if that is known.

        Raises
        ------
        ValueError
            A parameter that is not there, a negative or infinite p, a tracker without a covariance to widen.
        """
        chosen = self._chosen(which)
        if p is None and theta is None:
            raise ValueError("Live.reset: say p= (how far they may have moved, as a variance), theta=, or both.")
        if self._window is not None:
            raise ValueError(
                "Live.reset: smoothing with lag= does not know of resets; keep a second stream without it."
            )
        count = len(chosen)
        if p is not None:
            moved = np.zeros(len(self.names))
            moved[chosen] = vector("Live.reset", "p", numbers("Live.reset", "p", p, low=0.0), count)
            self.tracker.widen(self.lane(), moved)
        if theta is not None:
            values = vector("Live.reset", "theta", numbers("Live.reset", "theta", theta), count)
            self.tracker.place(self.lane(), chosen, values)

    def _chosen(self, which: Any) -> list[int]:
        """Indices of parameters."""
        if which is None:
            return list(range(len(self.names)))
        chosen = []
        for one in [which] if isinstance(which, str | int) else which:
            if one not in self.names and not (isinstance(one, int) and 0 <= one < len(self.names)):
                raise ValueError(f"Live.reset: no parameter {one!r}; {near(str(one), self.names)}")
            chosen.append(one if isinstance(one, int) else self.names.index(one))
        return chosen

    def lane(self) -> dict[str, Array]:
        """The fields of the record, as views."""
        return {name: self._tile[name][0, ..., :1][..., 0] for name in fields(self._tile)}

    def end(self) -> End:
        """Where the stream stands, for a run to begin (`warm_start`)."""
        state = {name: np.array(value) for name, value in self.lane().items()}
        return End(self.model, self.tracker, state, self._last)

    def _inputs(self, u: Any) -> Array:
        """u as floats (m,)."""
        u = by_name(self.model, u)
        if u is None:
            u = () if self._m == 0 else np.full(self._m, np.nan)
        given: Array = np.asarray(u, dtype=np.float64)
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
        """Their standard deviations, (n,): inf for what has not been seen yet, NaN without a covariance."""
        std: Array = np.sqrt(np.diag(self.cov))
        return std

    @property
    def cov(self) -> Array:
        """Covariance of theta, (n, n)."""
        return self.tracker.cov(self.lane())

    @property
    def hypotheses(self) -> LiveHypotheses:
        """What a `Bank` says of events now: probabilities, events as they are decided, the mixture for control."""
        if not self.tracker.weighs:
            raise ValueError(f"hypotheses: {type(self.tracker).__name__} weighs none; track with a Bank.")
        from driftfit.hypotheses.live_results import LiveHypotheses

        return LiveHypotheses(self)

    def blocks(self, method: str = "svd-joint") -> Groups:
        """a, b, c, d of a `HammersteinWiener` model now; ``method`` as in `Track.blocks`, but for "gls"."""
        if self._separator is None:
            from driftfit.blocks.paths import Separator

            self._separator = Separator(self.model)
        groups: Groups = self._separator(self._tile["theta"][0, :, 0], method)
        return groups

    @property
    def learning(self) -> Array:
        """Which parameters are being learned now, (n,) bool: False where the recent inputs were too dull to tell."""
        return self.tracker.learning(self.lane())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.tracker.names_for(self.model)

    @property
    def ignored(self) -> int:
        """Samples that came with a time not after the last."""
        return self._ignored

    @property
    def outside(self) -> dict[str, int]:
        """How many numbers of each signal were outside its limits."""
        return {} if self._gate is None else self._gate.counts

    def save(self, path: str | PathLike[str]) -> None:
        """Write model, settings and state to one file, without pickle; complete or not at all."""
        save_state(
            path,
            self.model,
            self.tracker,
            self._tile,
            {
                "dt": self.dt,
                "zone": self._clock.zone,
                "limits": None if self._gate is None else self._gate.plain(),
                "last": self._last,
                "ignored": self._ignored,
                "lag": self.lag,
                "window": None if self._window is None else self._window.plain(),
            },
        )

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Continue from a file as if never stopped."""
        model, tracker, tile, extra = load_state(path)
        limits, outside = extra["limits"] or ([], [])
        live = cls(model, tracker, dt=Clock.of(extra["dt"], extra["zone"]), lag=extra["lag"], limits=dict(limits))
        if live._gate is not None:
            live._gate.restore(outside)
        if live._window is not None:
            live._window.restore(extra["window"])
        live._last, live._ignored = extra["last"], extra["ignored"]
        live._open(tile)
        return live

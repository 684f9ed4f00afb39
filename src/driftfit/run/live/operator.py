"""What an operator can tell a stream, and what can be asked of it; `driftfit.run.live.live.Live` inherits both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import near, numbers, vector, whole
from driftfit.run.live.late_input import INPUT

if TYPE_CHECKING:
    from driftfit.judge.alarms.rule import AlarmRule
    from driftfit.models.base import Model
    from driftfit.models.hammerstein_wiener.separation.paths import Groups, Separator
    from driftfit.run.live.alarm import LiveAlarm
    from driftfit.run.live.live import Live
    from driftfit.run.live.system import LiveSystem
    from driftfit.smooth.fixed_lag import Window
    from driftfit.trackers.bank.results.live_results import LiveHypotheses
    from driftfit.trackers.base import Tracker
    from driftfit.use.forecast import Forecast

KNOWN = ("interval", "noise", "drift")
ORDINARY, HELD = (1.0, 1.0, 1.0), (0.0, np.inf, 1.0)
"""What is known of a sample of which nothing is said, and of one while the stream is held."""


class _OfStream:
    """What a stream has."""

    model: Model
    tracker: Tracker
    _tile: Array
    _window: Window | None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.tracker.names_for(self.model)


class Operated(_OfStream):
    """The operator's hand: a hold, resets."""

    def hold(self, on: bool = True) -> None:
        """Stop learning, or (``hold(False)``) take it up again: for work on the plant, a test, a sensor being cleaned.

        While held, samples move the lags and are predicted, but are not used (``ok`` is False), and no time passes
        for the parameters and their covariance. Being held is part of the state that `save` writes.
        """
        self._rest(HELD if on else ORDINARY)

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
            raise ValueError("Live.reset: give p= (the variance of their possible change), theta=, or both.")
        if self._window is not None:
            raise ValueError(
                "Live.reset: smoothing with lag= does not support resets; keep a second stream without lag=."
            )
        count = len(chosen)
        if p is not None:
            moved = np.zeros(len(self.names))
            moved[chosen] = vector("Live.reset", "p", numbers("Live.reset", "p", p, low=0.0), count)
            self.tracker.widen(cast("Live", self).lane(), moved)
        if theta is not None:
            values = vector("Live.reset", "theta", numbers("Live.reset", "theta", theta), count)
            self.tracker.place(cast("Live", self).lane(), chosen, values)

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

    def _rest(self, known: tuple[float, float, float]) -> None:
        """Set what holds for every sample that says nothing else."""
        for name, value in zip(KNOWN, known, strict=True):
            self._tile[name] = value


class Asked(_OfStream):
    """Questions to a stream; each is a module of its own, imported when it is asked."""

    _awaits: int
    _cold: bool
    _separator: Separator | None
    _alarms: tuple[LiveAlarm, ...]

    @property
    def hypotheses(self) -> LiveHypotheses:
        """What a `Bank` says of events now: probabilities, events as they are decided, the mixture for control."""
        if not self.tracker.weighs:
            raise ValueError(f"hypotheses: {type(self.tracker).__name__} has no hypotheses; track with a Bank.")
        from driftfit.trackers.bank.results.live_results import LiveHypotheses

        return LiveHypotheses(cast("Live", self))

    def blocks(self, method: str = "svd-joint") -> Groups:
        """a, b, c, d of a `HammersteinWiener` model now; ``method`` as in `Track.blocks`, but for "gls"."""
        if self._separator is None:
            from driftfit.models.hammerstein_wiener.separation.paths import Separator

            self._separator = Separator(self.model)
        groups: Groups = self._separator(self._tile["theta"][0, :, 0], method)
        return groups

    def forecast(self, h: int, u: Any = None) -> Forecast:
        """theta and y at the next h nominal samples, as `Track.forecast`; u (h,) or (h, m) are the inputs then.

        While `apply` is outstanding the first row of u is what it would bring.
        """
        from driftfit.use.forecast import forecast_from, future, resting

        inputs, tile = future(self.model, h, u), resting(self.model, self.tracker, self._tile)
        if self._awaits == INPUT:
            cast("Live", self)._placing()(tile, inputs[0])
            inputs = np.vstack([inputs[1:], np.full((1, self.model.m), np.nan)])
        return forecast_from(self.model, self.tracker, tile, inputs)

    @property
    def system(self) -> LiveSystem:
        """The `ARX` system as it stands now: poles, gains, responses with bands; see `driftfit.run.live.system`."""
        from driftfit.run.live.system import LiveSystem

        return LiveSystem(cast("Live", self))

    def detect(self, rule: AlarmRule, wait: int | None = None) -> LiveAlarm:
        """Watch the stream from the next sample on by the rule of a reference run, ``run.detect(...).rule``.

        The alarm says after every update whether it is on, has just begun, and for what cause (`LiveAlarm`). It is
        saved with the state; `alarms` gives all of them. Over the same samples it says what ``Track.detect(rule,
        start=...)`` says of the record, bit for bit.

        Parameters
        ----------
        rule : AlarmRule
            Limits and settings. The tracker should be that of the reference run.
        wait : int or None
            Samples that are not judged. None: those of a start from nothing, max(50, 5 n); 0 after a warm start.

        Raises
        ------
        ValueError
            For a tracker or model that has not what the rule compares.
        """
        from driftfit.run.live.alarm import LiveAlarm, check_rule

        start = max(50, 5 * self.model.n) if self._cold else 0
        wait = start if wait is None else whole("Live.detect", "wait", wait, 0)
        alarm = LiveAlarm(check_rule(rule), self.tracker, self.names, wait)
        self._alarms = (*self._alarms, alarm)
        cast("Live", self)._be_careful()
        return alarm

    @property
    def alarms(self) -> tuple[LiveAlarm, ...]:
        """The alarms that watch this stream, in the order in which `detect` made them."""
        return self._alarms

"""What every tracker offers: settings, a state, and two compiled steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, Step
from driftfit.engine.settings import Settings
from driftfit.models.base import Model
from driftfit.trackers.parts.information import widen
from driftfit.trackers.parts.varying_drift import roots


class RandomWalk(NamedTuple):
    """What a tracker takes theta to be: theta_t = theta_{t-1} + w_t, w_t ~ N(0, q), seen in noise of variance r."""

    q: Array
    """(n, n), drift covariance per nominal sample."""
    r: float | None
    """Noise variance; None where it is estimated, and q and p0 are in units of it."""
    theta0: Array
    """(n,)"""
    p0: Array | None
    """(n, n), or None where nothing is known before the first sample."""
    at_first_sample: bool = False
    """Whether the prior holds at the first sample, with no drift before it."""
    slopes: bool = False
    """Whether it is the slope of theta that walks, so that theta_t = theta_{t-1} + dt slope_t."""


class Tracker(Settings, ABC):
    """How theta is followed. A subclass is a frozen dataclass whose fields are the settings.

    ``covariance`` says whether the tracker carries one; without it, standard deviations are NaN. ``required`` names
    settings that have no default: they may be left None only for `tune` to fill. ``width`` is how many series share a
    tile in a fleet; a tracker that vectorises over something of its own wants 1. ``outputs`` names fields of the record
    that are stored for every sample beside the common ones, by ``steps.store``.

    Most trackers need only the number of parameters. One that works on the inside of a model (an extended Kalman filter
    on its minimal parameters, a bank that cleans lags) overrides `state_for`, `steps_for` and, where its theta is not
    the model's, `names_for`.
    """

    covariance: ClassVar[bool] = True
    required: ClassVar[tuple[str, ...]] = ()
    width: ClassVar[int] = 32
    outputs: ClassVar[tuple[str, ...]] = ()
    weighs: ClassVar[bool] = False
    """Whether it weighs hypotheses, and so has ``run.hypotheses``."""
    noted: ClassVar[tuple[str, ...]] = ()
    """Fields of the record that `varying` needs of every sample; ``steps.note`` stores them when a run is replayed."""
    drift_each: ClassVar[bool] = False
    """Whether every parameter may have a drift of its own at every sample (`driftfit.trackers.parts.varying_drift`)."""
    adapts: ClassVar[bool] = False
    """Whether it finds drift and noise as it goes, so that its innovations are normal again soon after a fault."""
    density: ClassVar[str] = ""
    """Which of ``outputs`` has the log density of every sample, given those before it, as its first entry; none: that
    is the Gaussian one of the forecast.
    """
    output_error: ClassVar[bool] = False
    """Whether the innovation is that of y itself, also for a model that is fitted to something else."""

    @classmethod
    def own_model(cls, na: int, nb: int, nk: int) -> Model | None:
        """The model for a linear record of these lags, where the tracker does not work on all: for general tests.

        Its theta begins with -a_1 .. -a_na, b_1 .. b_nb of the `ARX` for that record.
        """
        return None

    @abstractmethod
    def state(self, n: int) -> Mapping[str, Any]:
        """Fields of the record, with their values before the first sample, for n parameters; at least ``theta``."""

    @property
    @abstractmethod
    def steps(self) -> TrackerSteps:
        """The compiled steps."""

    def state_for(self, model: Model) -> Mapping[str, Any]:
        """The state for a bound model."""
        return self.state(model.n)

    def steps_for(self, model: Model) -> TrackerSteps:
        """The steps for a bound model."""
        return self.steps

    def apply_for(self, model: Model) -> Step | None:
        """The step that takes in an input after its sample (`Model.apply`), for a bound model."""
        return model.apply

    def names_for(self, model: Model) -> tuple[str, ...]:
        """Names of the entries of theta."""
        return model.names

    def log_density(self, out: Array) -> Array | None:
        """The log densities (T, L) of the samples in what a driver wrote, from a tracker that has its own."""
        if not self.density:
            return None
        field: Array = out[self.density]
        return field[:, 0] if field.ndim == 3 else field

    def random_walk(self, model: Model) -> RandomWalk:
        """The random walk in Gaussian noise behind this tracker, which smoothers solve exactly."""
        raise ValueError(
            f"{type(self).__name__} does not describe a random walk in Gaussian noise, so there is nothing to smooth; "
            "track with FLS or Kalman."
        )

    def varying(self, model: Model, noted: Mapping[str, Array], e: Array, time: Array) -> tuple[Array, Array]:
        """Variances of the drift before each sample (T, n), and of its noise (T,), for a tracker that finds its own.

        ``noted`` (T, ..) are the fields that ``noted`` names, e (T,) the innovations, time (T,) the intervals of drift.
        """
        raise NotImplementedError

    def beside(self, model: Model, T: int, prob: Any, drift: Any) -> Array:
        """Further columns (T, k) of what is known of every sample, for ``steps.told``."""
        if prob is None and drift is not None and self.drift_each:
            return roots(type(self).__name__, self.names_for(model), T, drift)
        given = "prob" if prob is not None else f"drift of shape {np.shape(drift)}"
        raise ValueError(
            f"{type(self).__name__} has one hypothesis and takes drift of shape (T,), but got {given}; prob= and a "
            "drift for each change are for a Bank, a drift for each parameter is for FLS and Kalman."
        )

    def tell(self, lane: Mapping[str, Array], model: Model, prob: Any, drift: Any) -> None:
        """What is known of the next sample of a stream; None is what holds otherwise."""
        if prob is None and drift is None:
            lane["each"][:] = 1.0
        else:
            lane["each"][:] = self.beside(model, 1, prob, np.asarray(drift)[None])[0]

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        """Add variances p (n,), in squared units of theta, to the covariance in the fields of one lane.

        Raises
        ------
        ValueError
            If the tracker carries no covariance that could be widened.
        """
        P, n = lane.get("P"), len(p)
        if not self.covariance or P is None or P.shape != (n, n):
            raise ValueError(
                f"{type(self).__name__} carries no covariance that can be widened; "
                "give the new values of the parameters with theta=."
            )
        scale = float(lane["scale"])
        np.einsum("ii->i", P)[:] += p / scale if scale > 0.0 else p
        lane["var"][:] += p
        if "root" in lane:
            widen(lane["S"], lane["d"], p / scale if scale > 0.0 else p)

    def place(self, lane: Mapping[str, Array], which: Sequence[int], values: Array) -> None:
        """Set entries of theta in the fields of one lane."""
        lane["theta"][list(which)] = values
        if "root" in lane:
            lane["d"][:] = lane["S"] @ lane["theta"]

    def cov(self, lane: Mapping[str, Array]) -> Array:
        """Covariance (n, n) of theta from the fields of one lane; inf on the diagonal where nothing is known."""
        n = len(lane["theta"])
        if not self.covariance:
            return np.full((n, n), np.nan)
        lower = np.tril(lane["P"]) * lane["scale"]
        full: Array = lower + np.tril(lower, -1).T
        np.fill_diagonal(full, lane["var"])
        return full

    def remarks(self, run: Any) -> tuple[tuple[str, str], ...]:
        """What the summary of a run should say beside its numbers: a name and a sentence each."""
        return ()

    def unlearned(self, lane: Mapping[str, Array]) -> Array:
        """Which entries of theta a record should have told by now and has not, (n,) bool: `track` warns of them."""
        return np.zeros(len(lane["theta"]), bool)

    def learning(self, lane: Mapping[str, Array]) -> Array:
        """Which entries of theta recent regressors tell apart, (n,) bool; see `AdaptiveKalman.learning`."""
        raise ValueError(f"learning: {type(self).__name__} keeps no windowed information; AdaptiveKalman does.")

"""The interface of every tracker: settings, a state, and compiled steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, Step
from driftfit.engine.settings import Settings, as_numbers, factor
from driftfit.models.base import Model
from driftfit.trackers.forms.information import widen


class RandomWalk(NamedTuple):
    """The model of theta that a tracker assumes: theta_t = theta_{t-1} + w_t, w_t ~ N(0, q), in noise of variance r."""

    q: Array
    """(n, n), drift covariance per nominal sample."""
    r: float | None
    """Noise variance; None if it is estimated, and q and p0 are in units of it."""
    theta0: Array
    """(n,)"""
    p0: Array | None
    """(n, n), or None for a diffuse start."""
    at_first_sample: bool = False
    """Whether the prior refers to the first sample, with no drift before it."""
    slopes: bool = False
    """Whether the slope of theta is the random walk, so that theta_t = theta_{t-1} + dt slope_t."""


class Tracker(Settings, ABC):
    """An algorithm that estimates theta. A subclass is a frozen dataclass whose fields are the settings.

    ``covariance`` says whether the tracker has one; without it, standard deviations are NaN. ``required`` names
    settings that have no default: they may be None only for `tune` to estimate. ``width`` is the number of series that
    share a tile in a fleet; a tracker that is vectorised internally declares 1. ``outputs`` names further fields of the
    record that ``steps.store`` stores for every sample.

    Most trackers need only the number of parameters. One that depends on the model (an extended Kalman filter on its
    minimal parameters, a bank that corrects lags) overrides `state_for`, `steps_for` and, if its theta is not the
    model's, `names_for`.
    """

    covariance: ClassVar[bool] = True
    required: ClassVar[tuple[str, ...]] = ()
    width: ClassVar[int] = 32
    outputs: ClassVar[tuple[str, ...]] = ()
    gated: ClassVar[bool] = False
    """Whether a gate (`driftfit.readings.gate`) stands before it unless the user says otherwise: for trackers that are
    given no numbers.
    """
    replaces: ClassVar[tuple[str, ...]] = ("shift",)
    """Fields of the model's memory whose start the tracker gives; all its other names must differ from the model's.
    ``shift`` is common to all: what the model subtracted from y, for trackers that judge readings
    (`driftfit.readings.repeats`).
    """
    weighs: ClassVar[bool] = False
    """Whether it weighs hypotheses, and so has ``run.hypotheses``."""
    smoother_fields: ClassVar[tuple[str, ...]] = ()
    """Fields that `problem` needs from every sample; ``steps.store_for_smoother`` stores them."""
    drift_per_parameter: ClassVar[bool] = False
    """Whether every parameter may have its own drift at every sample (`driftfit.trackers.forms.covariance`)."""
    adapts: ClassVar[bool] = False
    """Whether it estimates drift and noise on-line, so that its innovations are normal again soon after a fault."""
    density: ClassVar[str] = ""
    """The field of ``outputs`` whose first entry is the log density of a sample given earlier ones; none: the density
    of the forecast, Gaussian or Student's.
    """
    learns_noise: ClassVar[bool] = False
    """Whether the variance of its innovation has an estimated factor, the mean of e^2 / s over the samples before.
    Their number, ``count`` in the state, is the degrees of freedom of the density (`driftfit.trackers.student`).
    """
    follows_states: ClassVar[bool] = False
    """Whether it moves the hidden states of a model (`Model.hidden`) between samples; it then needs such a model."""
    scratch: ClassVar[tuple[str, ...]] = ()
    """Fields that carry nothing from one sample to the next; packed states leave them out."""
    output_error: ClassVar[bool] = False
    """Whether the innovation is that of y itself, even for a model that is fitted to another quantity."""

    @property
    def beyond(self) -> str:
        """Why theta is not a random walk, or y not phi' theta and noise; empty if they are, as most verbs assume."""
        return ""

    @property
    def slopes(self) -> bool:
        """Whether theta follows a slope, and the slope drifts, so that theta is expected to move on."""
        return False

    @classmethod
    def own_model(cls, na: int, nb: int, nk: int) -> Model | None:
        """The model for a linear record with these lags, if the tracker does not work with all models; used by tests.

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

    def partly_known(self, n: int, N: int) -> Mapping[str, Any] | None:
        """The state for N parameters of which those after the first n are known to be 0, so that structures of several
        sizes are lanes of one driver; None if the tracker weighs parameters together, or N has no room for the n.
        """
        return None

    def state_for(self, model: Model) -> Mapping[str, Any]:
        """The state for a bound model."""
        return self.state(model.n)

    def steps_for(self, model: Model) -> TrackerSteps:
        """The steps for a bound model."""
        return self.steps

    def apply_for(self, model: Model) -> Step | None:
        """The step that stores an input after its sample (`ModelSteps.apply`), for a bound model."""
        return model.steps.apply

    def names_for(self, model: Model) -> tuple[str, ...]:
        """Names of the entries of theta."""
        return model.names

    def log_density(self, out: Array) -> Array | None:
        """The log densities (T, L) of the samples, from the output of a driver, if the tracker computes its own."""
        if not self.density:
            return None
        field: Array = out[self.density]
        return field[:, 0] if field.ndim == 3 else field

    def random_walk(self, model: Model) -> RandomWalk:
        """The random walk in Gaussian noise that this tracker assumes, which smoothers solve exactly."""
        raise ValueError(
            f"{type(self).__name__} does not describe a random walk in Gaussian noise, so there is nothing to smooth; "
            "track with FLS or Kalman."
        )

    def regression(self, fields: Mapping[str, Array], phi: Array, y: Array) -> tuple[Array, Array]:
        """phi (T, n) and y (T,) as the tracker used them; ``fields`` as in `problem`."""
        return phi, y

    def problem(self, fields: Mapping[str, Array], phi: Array) -> tuple[Array, Array, Array, Sequence[Sequence[int]]]:
        """What a smoother needs if it is estimated: B (n, n), what drifts being B^-1 theta, the variances of noise and
        drift (T,), and groups of parameters that may move while the others rest.

        ``fields`` (T, ..) are those that ``smoother_fields`` names, phi (N, n) the regressors of the used samples.
        """
        raise NotImplementedError

    def extra_columns(self, model: Model, T: int, prob: Any, drift: Any) -> Array:
        """Known factors of every sample after interval, noise and drift, (T, k), which ``steps.read_extra`` reads."""
        if prob is None and drift is not None and self.drift_per_parameter:
            return roots(type(self).__name__, self.names_for(model), T, drift)
        given = "prob" if prob is not None else f"drift of shape {np.shape(drift)}"
        raise ValueError(
            f"{type(self).__name__} has one hypothesis and takes drift of shape (T,), but got {given}; prob= and a "
            "drift for each change are for a Bank, a drift for each parameter is for FLS and Kalman."
        )

    def set_extra(self, lane: Mapping[str, Array], model: Model, prob: Any, drift: Any) -> None:
        """Set the known factors of the next sample of a stream; None is the default."""
        if prob is None and drift is None:
            lane["drift_root"][:] = 1.0
        else:
            lane["drift_root"][:] = self.extra_columns(model, 1, prob, np.asarray(drift)[None])[0]

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        """Add variances p (n,), in squared units of theta, to the covariance in the fields of one lane.

        Raises
        ------
        ValueError
            If the tracker has no covariance that could be widened.
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
        """Covariance (n, n) of theta from the fields of one lane; inf on the diagonal for undetermined parameters."""
        n = len(lane["theta"])
        if not self.covariance:
            return np.full((n, n), np.nan)
        lower = np.tril(lane["P"]) * lane["scale"]
        full: Array = lower + np.tril(lower, -1).T
        np.fill_diagonal(full, lane["var"])
        return full

    def remarks(self, run: Any) -> tuple[tuple[str, str], ...]:
        """Remarks for the summary of a run: a name and a sentence each."""
        return ()

    def unlearned(self, lane: Mapping[str, Array]) -> Array:
        """Which entries of theta the data should have determined by now but have not, (n,) bool: `track` warns."""
        return np.zeros(len(lane["theta"]), bool)

    def learning(self, lane: Mapping[str, Array]) -> Array:
        """Which entries of theta are distinguished by recent regressors, (n,) bool; see `AdaptiveKalman.learning`."""
        raise ValueError(f"learning: {type(self).__name__} keeps no windowed information; AdaptiveKalman does.")


def roots(owner: str, names: Sequence[str], T: int, drift: Any) -> Array:
    """The square roots (T, n) of factors of the drift; ValueError for another shape, and for what is no factor."""
    factors, n = as_numbers("drift", drift), len(names)
    if factors.shape != (T, n):
        raise ValueError(
            f"{owner}: drift with a column for each parameter must be ({T}, {n}), for {', '.join(names)}; got shape "
            f"{factors.shape}."
        )
    return np.asarray(np.sqrt(factor("drift", factors.ravel(), factors.size)).reshape(T, n))

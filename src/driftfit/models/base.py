"""The interface of every model: from signals to a regression, and the names of its parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings

Term = tuple[str, int, int]
"""A regressor: ("y", output, lag), ("u", input, lag), or ("1", 0, 0) for the constant 1."""
GAP = 1.5
"""Intervals longer than this many nominal ones break the lags."""


class Model(Settings, ABC):
    """How signals become ``y_t = phi_t' theta_t + v_t``.

    Besides its regression a model declares its other properties: the properties and methods that have a default here,
    which `driftfit.checks.check_model` tests. A model is *bound* once the number (and perhaps the names) of its inputs
    is known; `bind` returns the bound model, and everything else needs one.
    """

    constant: ClassVar[str] = ""
    """The setting that adds a constant to the prediction, of a model that predicts none without it."""

    @abstractmethod
    def bind(self, inputs: int | Sequence[str]) -> Model:
        """This model for that many inputs, or for inputs of these names; ValueError if they do not fit."""

    @property
    @abstractmethod
    def m(self) -> int:
        """Number of inputs, columns of u."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of theta."""

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs in order, by which named signals are matched; empty if they have none."""
        return ()

    @property
    def dimensions(self) -> tuple[tuple[int, int | None], ...] | None:
        """For every parameter (p, j): its unit is that of y to the power p, over that of input j (None: over nothing).

        None if a model does not declare it; its parameters then have no units, and scaling cannot be undone.
        """
        return None

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs; several outputs are run by `driftfit.run.fleet`."""
        return ("y",)

    @property
    def shared(self) -> bool:
        """Whether all outputs measure one theta, instead of having one each."""
        return False

    def names_of(self, output: str) -> tuple[str, ...]:
        """Names of the parameters of one of several outputs."""
        return tuple(f"{name}[{output}]" for name in self.names)

    def alone(self, output: str) -> Model | None:
        """The model of one of several outputs, if its regression needs none of the others; otherwise None."""
        return None

    @property
    def hidden(self) -> tuple[str, ...] | None:
        """States among its parameters, which only a tracker that `follows_states` moves; None if it has none."""
        return None

    @abstractmethod
    def memory(self) -> Mapping[str, Any]:
        """Fields of the record that hold the model's memory, with their values before the first sample."""

    @property
    @abstractmethod
    def steps(self) -> ModelSteps:
        """The compiled steps."""

    def fitted_to(self, tracker: TrackerSteps) -> tuple[Mapping[str, Any], ModelSteps]:
        """`memory` and `steps` with a tracker that marks readings as outliers, or needs instruments."""
        return self.memory(), self.steps

    @property
    def implicit(self) -> Implicit | None:
        """What the model declares if its regressors hold the present output, so the innovation is not that of y."""
        return None

    @property
    def linearised(self) -> Linearised | None:
        """What the model declares if its regressors depend on theta."""
        return None

    def inspect(self, y: Array, u: Array) -> None:
        """Warn of data that do not suit the model; `track` calls it with the whole record, y (T,), u (T, m)."""

    def noise_response(self, theta: Array, h: int) -> Array:
        """Response of y to one noise, now and at the h - 1 samples after it; 1, 0, 0, .. without output lags."""
        return np.asarray(np.eye(1, h)[0])

    @property
    def output_lags(self) -> int | None:
        """How many entries of phi, from its first, are past outputs and get predictions where those are missing.

        None if past outputs are elsewhere, or are transformed; 0 where there are none. Of several outputs it is their
        number for each.
        """
        own = [k for k, (what, j, _) in enumerate(self.terms or ()) if what == "y" and j == 0]
        return None if self.terms is None or own != list(range(len(own))) else len(own)

    @property
    def terms(self) -> tuple[Term, ...] | None:
        """What every regressor is, if all are signals of this or an earlier sample, or 1; None for any other model."""
        return None

    def transfers(self, theta: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        """The poles' polynomial at theta (.., n), and numerator and denominator from each input, in powers of z^-1.

        ValueError for a model whose inputs do not act through transfer functions.
        """
        raise ValueError(
            "poles, gains and responses belong to runs of ARX, ARMAX, OE and BoxJenkins with one output; this run has "
            f"{self!r}."
        )

    @property
    def reach(self) -> int:
        """Number of past samples in the regressors of a sample; a model that can be run forward declares it."""
        return max((lag for _, _, lag in self.terms or ()), default=0)

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
        """Run systems forward: the outputs (D, h) that inputs and noise cause, each fed back as a lag.

        Parameters
        ----------
        theta : (D, n)
            One system per row.
        y : (D, p)
            Earlier outputs, p at least `reach`.
        u : (D or 1, p + h, m)
            Earlier inputs, and the inputs at the h samples.
        noise : (D, h)
            Noise of the equation.
        span : (low, high), a number or (D,) each
            Range of the observed outputs, for a model that has to be inverted.

        ValueError for a model that cannot be run forward.
        """
        raise ValueError(
            f"{type(self).__name__} cannot be run forward, so nothing can be simulated; give your own model "
            "the methods `reach` and `play` (driftfit.models.base)."
        )

    def follows(self, other: Model) -> bool:
        """Whether the memory of the other model is that of this one, so that its run can be continued."""
        return (self.n, self.m, self.steps) == (other.n, other.m, other.steps)


class Implicit(ABC):
    """What a model declares whose regressors hold the present output: its innovation is the error of an equation."""

    @property
    def noise_varies(self) -> bool:
        """Whether `noise_factor` is anything but 1."""
        return False

    @abstractmethod
    def output_slope(self, theta: Array, y: Array) -> Array:
        """Slope (T,) of the innovation against y, above 0, at theta (T, n) after each sample and y (T,)."""

    def log_jacobian(self, theta: Array, y: Array) -> Array:
        """Its logarithm (T,), which turns the density of the innovation into that of y."""
        with np.errstate(invalid="ignore"):
            found: Array = np.log(self.output_slope(theta, y))
        return found

    def noise_factor(self, theta: Array, y: Array) -> float:
        """Factor of the noise variance of a tracker at an output."""
        return 1.0

    def touched(self, t: int, signal: str) -> range | None:
        """Samples that cannot be used when "y" or "u" is missing at t; None where missing outputs are filled in."""
        return None

    def expand(self, theta: Array) -> Array | None:
        """theta (.., n) from parameters (.., k) that a tracker follows instead; None where they do not define it."""
        return None

    def settled(self, phi: Array, y: Array, u: Array, at: Array) -> Array:
        """Regressors phi (N, n) of the usable samples ``at`` (N,), with outputs y (N,), of a whole record u (T, m).

        A model that takes settings of its functions from its estimates holds them at one value for all samples, because
        a judgement of the record would mistake their first values for a change of the parameters.
        """
        return phi


class Linearised(ABC):
    """What a model declares whose regressors depend on theta, as those of a transfer function do."""

    @property
    def unequal_start(self) -> bool:
        """Whether first innovations are far larger, because a model of the noise is not known yet."""
        return False

    @property
    @abstractmethod
    def settling(self) -> float:
        """Number of first samples whose regressors are poor, and should be forgotten."""

    @property
    def settling_memory(self) -> float:
        """Memory of the first of them, in samples."""
        return 0.1 * self.settling

    @property
    def instruments(self) -> bool:
        """Whether, with a tracker that asks for them (`TrackerSteps.instruments`), it writes instruments to s.zeta."""
        return False

    @abstractmethod
    def held_at(self, theta: Array) -> Model:
        """This model with its linearisation held at theta (n,), so that a run is a linear regression."""

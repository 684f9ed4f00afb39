"""Recursive instrumental variables: least squares that coloured noise does not bias.

    y_t = phi_t' theta_t + v_t,   E zeta_t v_t = 0 although E phi_t v_t != 0

    predict    C <- C / lambda_e,  G <- G / lambda_e          (lambda_e as in `driftfit.trackers.rls`)
    forecast   y_hat = phi' theta;  e = y - y_hat;  h = phi' C phi
    correct    K = G zeta / (1 / w + phi' G zeta);  theta <- theta + K e;  G <- G - K phi' G
               C <- (I - K phi') C (I - K phi')' + K K' / w

with w the weight of the sample. G is the inverse of sum lambda^(t-k) zeta_k phi_k', which is not symmetric. C is the
covariance of theta in units of the noise variance, which is estimated as in `RLS`.

In an ARX model the noise of an output is in the regressors of the next samples. If it is coloured, it is correlated
with them, and least squares is biased however long the record. Instruments are correlated with the regressors, but not
with the noise: the inputs themselves, and the outputs of an auxiliary model instead of past outputs

    x_t = zeta_t' a_t,  |x_t| <= the largest output before;   a_{t+1} = a_t + 0.05 (theta_t - a_t)
    zeta_t = [x_{t-1} .. x_{t-na}, the other regressors]

that is driven by the inputs alone, and follows theta at a distance. The first 10 n samples are used as in least
squares, to have an auxiliary model. Without a prior they are forgotten again, also for lambda = 1: until sample 40 n
the memory is 10 n samples at most. Otherwise their bias would fade as 1 / t only.

`OE` and `BoxJenkins`, and models in continuous time, have instruments of their own, filtered so that the estimate is
efficient if the model of the noise is right: refined instrumental variables
(`driftfit.models.polynomials.instruments`). The covariance is then

    C <- C - C zeta zeta' C / (1 / w + zeta' C zeta)

as for the method of the source, in which G is the same in the limit.

Use it if the residuals of `RLS` are correlated (`Track.diagnose`), and the inputs do not depend on past outputs: under
feedback they are correlated with the noise too. The estimate has a larger variance than least squares. `std`
treats the noise as white. A model without past outputs has its regressors as instruments, which is exponential `RLS`.
There is no smoother: this is not the estimate of a random walk.

A sample with 1 / w + phi' G zeta below one half of 1 / w is not learned from: G would more than double in a direction,
which happens where instruments and regressors have nothing in common. With refined instruments G is set to C where that
sum is more than a million times 1 / w + zeta' C zeta: it has lost its digits.

Source: Young, Recursive Estimation and Time-Series Analysis (2011), chapters 6 (the auxiliary model, and its filter)
and 7; Soderstrom and Stoica, Instrumental Variable Methods for System Identification (1983), chapter 6. Departures: the
diffuse start and the cap of `RLS`; the limit of x; the skipped samples; C in the place of the
variance matrix of white noise in a constant system. Cost per sample: O(n^2), about three times `RLS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel, nothing
from driftfit.models.base import Model
from driftfit.models.polynomials.instruments import FOLLOWING
from driftfit.trackers.forms.covariance import LEFT, prediction, product_with, symmetric_product
from driftfit.trackers.forms.diffuse import MACHINES, forecast_on_roots, spanned_variance
from driftfit.trackers.rls import Forgetting, correct_root_form, fade, forget_root_form, learn_settling_scale

LEAST_SQUARES = 10.0
"""Samples for each parameter, at the start, that are used as in least squares."""

FORGOTTEN = 40.0
"""Samples for each parameter until which these are forgotten again."""

SMALLEST_PRODUCT_SHARE = 0.5
"""Least share of its noise variance that 1 / w + phi' G zeta may be."""

LARGEST_PRODUCT_RATIO = 1e6
"""The most that it may be beside 1 / w + zeta' C zeta, with refined instruments."""


@kernel
def forget(s: State, l: int) -> None:
    grow = fade(s, l)
    for i in range(s.theta.shape[0]):
        for j in range(s.theta.shape[0]):
            s.G[i, j, l] *= grow


@kernel
def weigh_instruments(s: State, l: int) -> float:
    """s.f = G zeta and s.b = G' phi; returns phi' G zeta."""
    n = s.theta.shape[0]
    for i in range(n):
        f, b = 0.0, 0.0
        for j in range(n):
            f += s.G[i, j, l] * s.zeta[j, l]
            b += s.G[j, i, l] * s.phi[j, l]
        s.f[i, l], s.b[i, l] = f, b
    total = 0.0
    for i in range(n):
        total += s.phi[i, l] * s.f[i, l]
    return total


@kernel
def instrument(s: State, i: int, l: int) -> float:
    """zeta_i."""
    return s.zeta[i, l]  # type: ignore[no-any-return]


along_instruments = product_with(instrument)
"""s.g = C zeta; returns zeta' C zeta."""


@kernel
def symmetric(s: State, l: int) -> None:
    """G = C, to which refined instruments bring it in the limit."""
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            s.G[i, j, l] = s.P[i, j, l]
            s.G[j, i, l] = s.P[i, j, l]


@lru_cache
def learning(refined: bool) -> Step:
    """The correction, with g = C phi; refined: with g = C zeta, and the covariance of least squares on zeta."""

    @kernel
    def learn(s: State, l: int) -> None:
        n, noise, e = s.theta.shape[0], s.noise[l], s.e[l]
        v = s.h[l] + noise
        common = noise + weigh_instruments(s, l)
        if refined and not abs(common) < LARGEST_PRODUCT_RATIO * v:
            symmetric(s, l)
            common = noise + weigh_instruments(s, l)
        learned = (s.ok[l] > 0.0) & (common >= SMALLEST_PRODUCT_SHARE * noise) & (common < LARGEST) & (v < LARGEST)
        gain, v_used = (1.0 / common if learned else 0.0), (v if learned else 0.0)
        along = 1.0 / v if learned else 0.0
        for i in range(n):
            k = gain * s.f[i, l]
            s.theta[i, l] += k * e
            for j in range(n):
                s.G[i, j, l] -= k * s.b[j, l]
            k = along * s.g[i, l] if refined else k
            for j in range(i):
                k_j = along * s.g[j, l] if refined else gain * s.f[j, l]
                s.P[i, j, l] -= k * s.g[j, l] + s.g[i, l] * k_j - k * k_j * v_used
            left = s.P[i, i, l] - (2.0 * k * s.g[i, l] - k * k * v_used)
            s.P[i, i, l] = max(left, LEFT * s.P[i, i, l])
        learn_settling_scale(s, l)

    return learn  # type: ignore[no-any-return]


@kernel
def auxiliary_output(s: State, l: int) -> None:
    """zeta, and the present output of the auxiliary model, s.x; the first regressors are past outputs."""
    n, na, settled = s.theta.shape[0], s.output_lags[l], s.learned[l] >= s.settling[l]
    x = 0.0
    for i in range(na):
        x += s.x_lag[i, l] * s.auxiliary[i, l]
        s.zeta[i, l] = s.x_lag[i, l] if settled else s.phi[i, l]
    for i in range(na, n):
        x += s.phi[i, l] * s.auxiliary[i, l]
        s.zeta[i, l] = s.phi[i, l]
    s.x[l] = max(-s.largest[l], min(s.largest[l], x))


@kernel
def follow_auxiliary(s: State, l: int) -> None:
    """The auxiliary model follows theta, and its output is the first of its lags."""
    na = s.output_lags[l]
    s.largest[l] = max(s.largest[l], abs(s.y[l])) if s.observed[l] > 0.0 else s.largest[l]
    share = FOLLOWING if s.learned[l] >= s.settling[l] else 1.0
    for i in range(s.theta.shape[0]):
        s.auxiliary[i, l] += share * (s.theta[i, l] - s.auxiliary[i, l])
    for i in range(na - 1, 0, -1):
        s.x_lag[i, l] = s.x_lag[i - 1, l]
    if na > 0:
        s.x_lag[0, l] = s.x[l]


@lru_cache
def steps(refined: bool) -> TrackerSteps:
    """The steps for models whose first regressors are past outputs; refined: for those that give their own."""
    instruments, follow = (nothing, nothing) if refined else (auxiliary_output, follow_auxiliary)
    learn, product = learning(refined), along_instruments if refined else symmetric_product

    @kernel
    def forecast(s: State, l: int) -> None:
        instruments(s, l)
        y_hat = prediction(s, l)
        s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, max(product(s, l), 0.0)

    @kernel
    def correct(s: State, l: int) -> None:
        s.learned[l] += s.ok[l]
        learn(s, l)
        follow(s, l)

    @kernel
    def forecast_first(s: State, l: int) -> None:
        instruments(s, l)
        forecast_on_roots(s, l)

    @kernel
    def correct_first(s: State, l: int) -> None:
        s.learned[l] += s.ok[l]
        correct_root_form(s, l)
        symmetric(s, l)
        follow(s, l)

    start = TrackerSteps(forget_root_form, forecast_first, correct_first, spanned_variance)
    return TrackerSteps(
        forget, forecast, correct, start=start, instruments=refined, machines=MACHINES, learns_scale=True
    )


def _written_by(model: Model) -> bool:
    """Whether the model has instruments of its own."""
    return model.linearised is not None and model.linearised.instruments


@dataclass(frozen=True)
class InstrumentalVariables(Forgetting):
    """Recursive instrumental variables for models in coloured noise, with an auxiliary model and forgetting.

    For ARX; for OE and BoxJenkins they are refined instrumental variables (RIV, SRIV).

    Parameters
    ----------
    forgetting : number in (0, 1]
        lambda per nominal sample; 1 never forgets.
    p0 : number, (n,), (n, n), or None
        Covariance of theta before the first sample, in units of the noise variance. None: exact diffuse start.
    theta0 : number or (n,)
        Mean of theta before the first sample.
    c_max : number
        Cap of the growth of a variance, as a multiple of its value at the start.

    Raises
    ------
    ValueError
        If forgetting is outside (0, 1], p0 is not a covariance, or c_max is below 1; when a run begins, if the model
        does not say which of its regressors are past outputs.
    """

    forgetting: float | None = None
    p0: Any = None
    theta0: Any = 0.0
    c_max: float = 1e8

    def state(self, n: int) -> Mapping[str, Any]:
        own = super().state(n)
        return {
            **own,
            "G": own["P"],
            "f": np.zeros(n),
            "b": np.zeros(n),
            "zeta": np.zeros(n),
            "auxiliary": own["theta"],
            "x": 0.0,
            "x_lag": np.zeros(n),
            "output_lags": 0,
            "largest": 0.0,
            "learned": 0.0,
            "settling": LEAST_SQUARES * n,
        }

    @property
    def steps(self) -> TrackerSteps:
        """Those for a model without past outputs."""
        return steps(False)

    def steps_for(self, model: Model) -> TrackerSteps:
        if _written_by(model):
            return steps(True)
        if model.output_lags is None:
            raise ValueError(
                f"InstrumentalVariables: {type(model).__name__} does not say which of its regressors are past outputs "
                "(`Model.output_lags`), so they cannot be replaced by instruments; use ARX, OE or BoxJenkins."
            )
        return steps(False)

    def state_for(self, model: Model) -> Mapping[str, Any]:
        own = {**super().state_for(model), "output_lags": model.output_lags or 0}
        if self.p0 is None and model.output_lags and not _written_by(model):
            own |= {"discounted": FORGOTTEN * model.n, "first_memory": LEAST_SQUARES * model.n}
        return own

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        super().widen(lane, p)
        scale = float(lane["scale"])
        np.einsum("ii->i", lane["G"])[:] += p / scale if scale > 0.0 else p

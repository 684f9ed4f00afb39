"""Counts and yes or no: the dynamic generalised linear model.

    theta_t = theta_(t-1) + w_t,  w ~ N(0, q);      eta_t = phi_t' theta_t;      y_t ~ family with mean mu(eta_t)

    "poisson"              mu = exp(eta),              variance mu
    "negative binomial"    mu = exp(eta),              variance mu + alpha mu^2
    "logistic"             mu = 1 / (1 + exp(-eta)),   variance mu (1 - mu),    y between 0 and 1
    "gaussian"             mu = eta,                   variance r: the Kalman filter

    predict   P <- P + q dt d
    forecast  m = phi' theta,  v = phi' P phi,  g = P phi
              y_hat = E mu(eta),  s = r E variance + Var mu(eta)  for eta ~ N(m, v)
    correct   (m+, v+) = mean and variance of p(y | eta)^(1/r) N(eta; m, v)
              theta <- theta + g (m+ - m) / v;   P <- P + g g' (v+ - v) / v^2

The output depends on theta through one number, eta, so that only an integral over that has to be done: by Gauss-Hermite
quadrature about the mode. Given a Gaussian before the sample, mean and covariance after it are exact; that the
distribution after it is taken to be Gaussian again is the only approximation (assumed density filtering). It is good
after some ten samples for each parameter; a single zero or one after a wide prior leaves a skewed distribution, of
which the band is a rough picture. The log-likelihood is that of the predictive distributions, integrated over eta.

``r`` is the dispersion of quasi-likelihood: with 2 the variance of the counts is twice that of the family, and bands
are wider by the square root of 2. Readings that the family excludes (negative counts, a yes beyond 1) are not used.
A known exposure is a regressor, its logarithm, whose parameter is held at 1: theta0 = 1 with p0 = 0 and q = 0.

Source: West, Harrison, Migon, Dynamic generalized linear models and Bayesian forecasting, J. American Statistical
Association 80 (1985); Opper, A Bayesian approach to on-line learning (1998), for the update. Departure from the first:
exact moments instead of conjugate ones. Cost per sample: O(n^2), and 20 to 40 exponentials.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import State, exp, kernel, log, shared
from driftfit.engine.settings import check_numbers, matrix, one_of, vector
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.covariance import LEFT, prediction, read_drift, symmetric_product
from driftfit.trackers.kalman import drift_matrix

FAMILIES = ("gaussian", "poisson", "negative binomial", "logistic")
GAUSSIAN, POISSON, NEGATIVE, LOGISTIC = range(4)

_NODES, _WEIGHTS = np.polynomial.hermite.hermgauss(20)
NODES, WEIGHTS = tuple((np.sqrt(2.0) * _NODES).tolist()), tuple((_WEIGHTS / np.sqrt(np.pi)).tolist())
"""Points and weights for a standard normal variable."""

STEPS, CLOSE = 60, 1e-10
"""Newton steps at most, and the share of a standard deviation at which they end."""

LARGEST_ETA = 40.0
"""Largest eta, and the largest variance of it in a forecast: e^40 is 2e17."""

HALF_LOG_2_PI = 0.9189385332046727


@shared
def log_gamma(x: float) -> float:
    """log Gamma(x), x > 0, by Stirling's series beyond 10."""
    shift = 1.0
    while x < 10.0:
        shift *= x
        x += 1.0
    r = 1.0 / (x * x)
    series = (1.0 / 12.0 - r * (1.0 / 360.0 - r * (1.0 / 1260.0 - r * (1.0 / 1680.0 - r / 1188.0)))) / x
    found: float = (x - 0.5) * log(x) - x + HALF_LOG_2_PI + series - log(shift)
    return found


@shared
def log_likelihood(family: int, y: float, eta: float, alpha: float) -> float:
    """log p(y | eta), without what does not depend on eta."""
    if family == LOGISTIC:
        found: float = y * eta - max(eta, 0.0) - log(1.0 + exp(-abs(eta)))
    else:
        mu = exp(min(eta, 700.0))
        found = y * eta - ((y + 1.0 / alpha) * log(1.0 + alpha * mu) if family == NEGATIVE else mu)
    return found


@shared
def constant(family: int, y: float, alpha: float) -> float:
    """The rest of log p(y | eta)."""
    found = 0.0
    if family == NEGATIVE:
        found = log_gamma(y + 1.0 / alpha) - log_gamma(1.0 / alpha) - log_gamma(y + 1.0) + y * log(alpha)
    elif family == POISSON:
        found = -log_gamma(y + 1.0)
    return found


@shared
def slopes(family: int, y: float, eta: float, alpha: float) -> tuple[float, float]:
    """First derivative of log p(y | eta), and minus the second."""
    if family == LOGISTIC:
        mu = 1.0 / (1.0 + exp(-eta))
        return y - mu, mu * (1.0 - mu)
    mu = exp(min(eta, 700.0))
    if family == NEGATIVE:
        whole = 1.0 + alpha * mu
        return (y - mu) / whole, mu * (1.0 + alpha * y) / (whole * whole)
    return y - mu, mu


@shared
def mode(family: int, y: float, m: float, v: float, alpha: float, r: float) -> tuple[float, float]:
    """The mode of p(y | eta)^(1/r) N(eta; m, v), and the curvature there, by Newton steps within a bracket."""
    score, bend = slopes(family, y, m, alpha)
    far = m + v * score / r
    if family != LOGISTIC and score > 0.0:
        far = min(far, log(y + 0.5))  # beyond it the likelihood falls
    low, high = min(m, far), max(m, far)
    eta = high if family != LOGISTIC else m
    for _ in range(STEPS):
        score, bend = slopes(family, y, eta, alpha)
        slope, curve = score / r - (eta - m) / v, bend / r + 1.0 / v
        if slope > 0.0:
            low = max(low, eta)
        else:
            high = min(high, eta)
        step = slope / curve
        fresh = eta + step
        fresh = fresh if low <= fresh <= high else 0.5 * (low + high)
        moved = abs(fresh - eta)
        eta = fresh
        if moved * moved * curve < CLOSE * CLOSE:
            break
    score, bend = slopes(family, y, eta, alpha)
    return eta, bend / r + 1.0 / v


@shared
def posterior(family: int, y: float, m: float, v: float, alpha: float, r: float) -> tuple[float, float, float]:
    """Mean and variance of p(y | eta)^(1/r) N(eta; m, v), and the logarithm of its integral."""
    peak, curve = mode(family, y, m, v, alpha, r)
    width = 1.0 / np.sqrt(curve)
    top = log_likelihood(family, y, peak, alpha) / r - 0.5 * (peak - m) * (peak - m) / v
    total, mean, square = 0.0, 0.0, 0.0
    for k in range(len(NODES)):
        x = NODES[k]
        eta = peak + width * x
        fall = log_likelihood(family, y, eta, alpha) / r - 0.5 * (eta - m) * (eta - m) / v - top
        share = WEIGHTS[k] * exp(fall + 0.5 * x * x)
        total += share
        mean += share * x
        square += share * x * x
    mean /= total
    variance = width * width * (square / total - mean * mean)
    integral = top + log(total) + log(width) - 0.5 * log(v)
    return peak + width * mean, min(max(variance, 0.0), v), integral + constant(family, y, alpha)


@shared
def forecast(family: int, m: float, v: float, alpha: float) -> tuple[float, float, float]:
    """E mu, E of the variance given eta, and Var mu, for eta ~ N(m, v)."""
    if family == LOGISTIC:
        mean, square, root = 0.0, 0.0, np.sqrt(v)
        for k in range(len(NODES)):
            mu = 1.0 / (1.0 + exp(-(m + root * NODES[k])))
            mean += WEIGHTS[k] * mu
            square += WEIGHTS[k] * mu * mu
        return mean, mean - square, max(square - mean * mean, 0.0)
    wide = min(v, LARGEST_ETA)
    mean = exp(min(m + 0.5 * wide, LARGEST_ETA))
    square = mean * mean * exp(wide)
    return mean, mean + (alpha * square if family == NEGATIVE else 0.0), square - mean * mean


@kernel
def forecast_output(s: State, l: int) -> None:
    """y_hat, h = Var mu(eta), and the expected variance of y given eta, in units of the dispersion."""
    m, v, family = prediction(s, l), symmetric_product(s, l), s.family[l]
    s.eta[l], s.eta_variance[l] = m, v
    if family == GAUSSIAN:
        y_hat, own, of_mean = m, 1.0, v
    else:
        y_hat, own, of_mean = forecast(family, min(max(m, -LARGEST_ETA), LARGEST_ETA), v, s.alpha[l])
    s.y_hat[l], s.e[l], s.h[l], s.dispersed[l] = y_hat, s.y[l] - y_hat, of_mean, own


@kernel
def variance_of_output(s: State, l: int) -> None:
    s.s[l] = s.r[l] * s.noise[l] * s.dispersed[l] + s.h[l]


@kernel
def correct(s: State, l: int) -> None:
    m, v, r, y, family = s.eta[l], s.eta_variance[l], s.r[l] * s.noise[l], s.y[l], s.family[l]
    if family == GAUSSIAN:
        variance = v + r
        after, left = m + v * (y - m) / variance, v * r / variance
        density = -HALF_LOG_2_PI - 0.5 * (log(variance) + (y - m) * (y - m) / variance)
    else:
        held = min(max(m, -LARGEST_ETA), LARGEST_ETA)
        after, left, density = m, v, 0.0
        possible = (y >= 0.0) & ((family != LOGISTIC) | (y <= 1.0))
        s.ok[l] = s.ok[l] if possible else 0.0
        if (s.ok[l] > 0.0) & (v > 0.0):
            after, left, density = posterior(family, y, held, v, s.alpha[l], r)
            after += m - held
        elif s.ok[l] > 0.0:
            density = log_likelihood(family, y, held, s.alpha[l]) / r + constant(family, y, s.alpha[l])
    learns = (s.ok[l] > 0.0) & (v > 0.0)
    gain = (after - m) / v if learns else 0.0
    shrink = (v - left) / (v * v) if learns else 0.0
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += gain * s.g[i, l]
        for j in range(i):
            s.P[i, j, l] -= shrink * s.g[i, l] * s.g[j, l]
        s.P[i, i, l] = max(s.P[i, i, l] - shrink * s.g[i, l] * s.g[i, l], LEFT * s.P[i, i, l])
    s.log_density[l] = density


@kernel
def store(o: State, s: State, l: int) -> None:
    o.log_density[l] = s.log_density[l]


@dataclass(frozen=True)
class DynamicGLM(Tracker):
    """Dynamic generalised linear model: counts, yes or no, with parameters that drift.

    Parameters
    ----------
    family : "poisson", "negative binomial", "logistic" or "gaussian"
        The distribution of the output given its mean.
    q : number, (n,), or (n, n)
        Drift covariance per nominal sample, in squared units of theta. 0 keeps a parameter constant.
    p0 : number, (n,), or (n, n)
        Covariance of theta before the first sample. For regressors of the size of 1, 10 says almost nothing.
    theta0 : number or (n,)
        Mean of theta before the first sample.
    alpha : number
        Of the negative binomial: the variance is mu + alpha mu^2.
    r : number
        Dispersion, a factor of the variance; of "gaussian" the variance of the noise.

    Raises
    ------
    ValueError
        For another family, if q or p0 is not a covariance, or alpha or r is not positive.
    """

    family: str = "gaussian"
    q: Any = None
    p0: Any = None
    theta0: Any = 0.0
    alpha: float = 1.0
    r: float = 1.0

    required: ClassVar[tuple[str, ...]] = ("q", "p0")
    width: ClassVar[int] = 1
    outputs: ClassVar[tuple[str, ...]] = ("log_density",)
    density: ClassVar[str] = "log_density"
    scratch: ClassVar[tuple[str, ...]] = ("g", "log_density", "eta", "eta_variance", "dispersed")
    drift_per_parameter: ClassVar[bool] = True

    @property
    def beyond(self) -> str:
        return "" if self.family == "gaussian" else "has an output that is a curved function of phi' theta"

    def __post_init__(self) -> None:
        one_of("DynamicGLM", "family", self.family, FAMILIES)
        check_numbers(self, ("q", "p0"), ("alpha", "r"), ("theta0",))

    def state(self, n: int) -> Mapping[str, Any]:
        return {
            "theta": vector("DynamicGLM", "theta0", self.theta0, n), "P": matrix("DynamicGLM", "p0", self.p0, n),
            "q": matrix("DynamicGLM", "q", self.q, n), "r": self.r, "alpha": self.alpha,
            "family": FAMILIES.index(self.family), "g": np.zeros(n), "drift_root": np.ones(n), "log_density": 0.0,
            "eta": 0.0, "eta_variance": 0.0, "dispersed": 1.0,
        }  # fmt: skip

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(
            drift_matrix, forecast_output, correct, variance=variance_of_output, store=store, read_extra=read_drift
        )

"""The system behind a run, over time: poles, gain, responses with bands, long-run effects, export to scipy.

    y = sum_j B_j(z) / A_j(z) u_j,     A_j(z) = 1 - a_1 z^-1 - ..,   B_j(z) = z^-nk (b_1 + b_2 z^-1 + ..)

    poles               roots of all A_j                         gain of input j      B_j(1) / A_j(1)
    step response       of B_j / A_j, h samples                  frequency response   B_j(e^iw) / A_j(e^iw)

In an ARX model all A_j are A; in polynomial models A_j = A F_j (`Model.transfers`).

At every sample the parameters of that sample are assumed to be constant: the frozen system. Standard deviations come
from the covariance of the run by the delta method; for a frequency response they are
those of the logarithm of the magnitude and of the phase. Units: w in radians per sample, gains in units of y over u.

In econometrics: in a model of logarithms the gain is the long-run elasticity, b / (1 - a), which `long_run` returns
with its standard error and with the interval of Fieller (1954). Where A(1) is not clearly different from zero the delta
method fails; Fieller's interval is then unbounded, as it should be.

The delta method gives standard deviations of functions of the parameters:

    Cov f(theta) = J Cov(theta) J',     J = df / dtheta by central differences

Steps are a hundredth of a standard deviation, so the slope is that in the region of likely theta. If f is nonlinear
within a standard deviation (a gain whose denominator is near zero), the result is only a first-order approximation.
`LiveSystem` is the same for a stream, now.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.models.arx import ARX
from driftfit.run.live.conformal import quantile
from driftfit.show.text import path_table, printing

if TYPE_CHECKING:
    from driftfit.models.base import Model
    from driftfit.run.live.live import Live
    from driftfit.trackers.base import Tracker


class Followed(Protocol):
    """Objects with parameters over time: a `Track`, or the present of a stream (`driftfit.use.system`)."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def theta(self) -> Array: ...

    @property
    def model(self) -> Model: ...
    @property
    def tracker(self) -> Tracker: ...

    def __len__(self) -> int: ...
    def cov(self, t: int) -> Array: ...
    def covariances(self) -> Array: ...


@printing
class Response(NamedTuple):
    """Values with their standard deviations, NaN if the tracker carries no covariance; printing it shows a table.

    Its rows are those of ``value``, numbered from 0: the samples. The response of a single sample has a row for each
    step, and its gain one for each input.
    """

    value: Array
    std: Array

    def __rich__(self) -> Any:
        value, std = (np.reshape(part, (len(np.atleast_1d(part)), -1)) for part in self)
        value, std = (value.T, std.T) if len(value) == 1 else (value, std)
        k = value.shape[1]
        return path_table("Response", [f"value {i + 1}" for i in range(k)] if k > 1 else ["value"], value, std)

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high) of a normal approximation."""
        half = quantile(level) * self.std
        return self.value - half, self.value + half


@printing
class FrequencyResponse(NamedTuple):
    """For one input: w (k,) in radians per sample; log magnitude and phase (radians), (T, k) each, with std; printing
    it shows that of the last sample.
    """

    w: Array
    magnitude: Array
    log_magnitude_std: Array
    phase: Array
    phase_std: Array

    def __rich__(self) -> Any:
        size, log_std, phase, phase_std = (np.atleast_2d(part)[-1] for part in self[1:])
        value, std = np.stack([size, phase], axis=1), np.stack([size * log_std, phase_std], axis=1)
        return path_table("Response by w", ("magnitude", "phase"), value, std, [f"{w:.4g}" for w in self.w])


class LongRun(NamedTuple):
    """Long-run effect of one input: b / (1 - a)."""

    name: str
    value: float
    std: float
    low: float
    high: float


def linear(run: Followed) -> Model:
    """The model of a run; ValueError if its inputs do not act through transfer functions."""
    if run.names != run.model.names:
        raise ValueError(
            f"poles, gains and responses belong to runs of ARX; this run follows {', '.join(run.names)} instead."
        )
    run.model.transfers(run.theta[:1])
    return run.model


def companion(poles: Array) -> Array:
    """Matrices (T, k, k) whose eigenvalues are the roots of polynomials (T, k + 1) in powers of z^-1."""
    k = poles.shape[1] - 1
    found = np.zeros((len(poles), k, k))
    found[:, :1] = np.where(np.isfinite(poles), -poles, 0.0)[:, None, 1:]
    found[:, np.arange(1, k), np.arange(k - 1)] = 1.0
    return found


def covariances(run: Followed) -> Array:
    """Covariance of theta after every sample, (T, n, n); NaN if it is not finite. Replays the record."""
    n = len(run.names)
    if not run.tracker.covariance:
        return np.full((len(run), n, n), np.nan)
    return _finite(run.covariances())


def _finite(cov: Array) -> Array:
    """Covariances (T, n, n); all entries of one are NaN if a parameter is not determined yet."""
    return np.where(np.asarray(np.isfinite(cov).all(axis=(1, 2), keepdims=True)), cov, np.nan)


def taken(run: Followed, at: Any) -> tuple[Array, Array]:
    """(theta, covariance) of samples: all of them, one, or several."""
    theta = run.theta
    if at is None:
        return theta, covariances(run)
    picked = np.atleast_1d(np.asarray(at))
    if picked.dtype.kind not in "iu" or (picked < -len(run)).any() or (picked >= len(run)).any():
        raise IndexError(f"at= must be samples within the record of {len(run)}; got {at!r}.")
    if len(picked) == 1:
        return theta[picked], _finite(run.cov(int(picked[0]))[None])
    return theta[picked], covariances(run)[picked]


def poles(run: Followed, at: Any = None) -> Array:
    """Poles of the frozen systems, (T, k) complex, largest magnitude first; ``at`` selects samples."""
    theta = run.theta if at is None else run.theta[np.atleast_1d(at)]
    matrices = companion(linear(run).transfers(theta)[0])
    roots = np.linalg.eigvals(matrices).astype(complex) if matrices.shape[1] else np.zeros((len(theta), 0), complex)
    return np.take_along_axis(roots, np.argsort(-np.abs(roots), axis=1, kind="stable"), axis=1)


def largest_pole(run: Followed, at: Any = None) -> Response:
    """Magnitude of the largest pole over time, with its standard deviation; below 1 the system is stable."""
    model = linear(run)

    def largest(theta: Array) -> Array:
        matrices = companion(model.transfers(theta)[0])
        size: Array = np.abs(np.linalg.eigvals(matrices)).max(axis=1) if matrices.shape[1] else np.zeros(len(theta))
        return size

    return Response(*spread(largest, *taken(run, at)))


def dc_gain(run: Followed, at: Any = None) -> Response:
    """Static gain of every input, (T, m), with its standard deviation."""
    model = linear(run)
    return Response(*spread(lambda theta: _gain(model, theta), *taken(run, at)))


def _gain(model: Model, theta: Array) -> Array:
    _, parts = model.transfers(theta)
    with np.errstate(divide="ignore", invalid="ignore"):
        gains = np.array([B.sum(axis=-1) / A.sum(axis=-1) for B, A in parts]).reshape(len(parts), len(theta))
    return np.moveaxis(gains, 0, -1)


def step_response(run: Followed, h: int, input: int | str = 0, at: Any = -1) -> Response:
    """Response (T, h) to a unit step of one input at sample 0; ``at`` selects samples, None all (T h n numbers)."""
    return _response(run, np.ones(whole("step_response", "h", h, 1)), input, at)


def impulse_response(run: Followed, h: int, input: int | str = 0, at: Any = -1) -> Response:
    """Response (T, h) to a unit impulse of one input at sample 0."""
    return _response(run, np.eye(1, whole("impulse_response", "h", h, 1))[0], input, at)


def _response(run: Followed, drive: Array, input: int | str, at: Any) -> Response:
    model, j = linear(run), input_of(run, input)
    return Response(*spread(lambda theta: filtered(*model.transfers(theta)[1][j], drive), *taken(run, at)))


def filtered(B: Array, A: Array, drive: Array) -> Array:
    """B / A, rows of coefficients (T, .), applied to one signal (h,)."""
    y = np.zeros((len(B), len(drive)))
    for k in range(len(drive)):
        for i in range(min(k + 1, B.shape[-1])):
            y[:, k] += B[:, i] * drive[k - i]
        for i in range(1, min(k + 1, A.shape[-1])):
            y[:, k] -= A[:, i] * y[:, k - i]
    return y


def frequency_response(run: Followed, w: Any = None, input: int | str = 0, at: Any = -1) -> FrequencyResponse:
    """B_j / A_j on the unit circle at w (k,) radians per sample, 0.01 to pi by default."""
    model, j = linear(run), input_of(run, input)
    grid = np.geomspace(0.01, np.pi, 100) if w is None else np.atleast_1d(np.asarray(w, float))

    def on_circle(theta: Array) -> Array:
        B, A = model.transfers(theta)[1][j]
        return _at(B, grid) / _at(A, grid)

    theta, cov = taken(run, at)
    H = on_circle(theta)
    magnitude = np.abs(H)
    _, log_std = spread(lambda theta: np.log(np.abs(on_circle(theta))), theta, cov)
    _, phase_std = spread(lambda theta: np.angle(on_circle(theta) / H), theta, cov)
    return FrequencyResponse(grid, magnitude, log_std, np.unwrap(np.angle(H), axis=-1), phase_std)


def _at(polynomial: Array, w: Array) -> Array:
    powers = np.exp(-1j * np.outer(np.arange(polynomial.shape[-1]), w))
    return polynomial @ powers


def input_of(run: Followed, input: int | str) -> int:
    """The index of an input, from its index or name."""
    m = run.model.m
    names = run.model.input_names
    if isinstance(input, str):
        if input not in names:
            raise ValueError(f"there is no input {input!r}; there is {', '.join(names) or 'none with a name'}.")
        return names.index(input)
    if not 0 <= input < m:
        raise ValueError(f"the model has {m} inputs; input must be 0 .. {m - 1}, got {input!r}.")
    return input


def to_scipy(run: Followed, at: int = -1, dt: float = 1.0, input: int | str = 0) -> Any:
    """The frozen system at a sample, from one input to y, as `scipy.signal.dlti` (a transfer function in z)."""
    from scipy import signal

    model, j = linear(run), input_of(run, input)
    parts = model.transfers(run.theta[at])[1][j]
    length = max(map(len, parts))  # with equally many powers of z^-1 in both, they are powers of z
    num, den = (np.pad(part, (0, length - len(part))) for part in parts)
    lead = int(np.argmax(num != 0.0)) if np.any(num) else 0  # a leading zero coefficient makes scipy warn
    return signal.dlti(num[lead:], den, dt=dt)


def long_run(run: Followed, at: int = -1, level: float = 0.95) -> tuple[LongRun, ...]:
    """Long-run effect of every input at a sample: b / (1 - a), its standard error, and Fieller's interval at ``level``.

    In a model of logarithms it is the long-run elasticity. ValueError for models other than ARX.
    """
    model = linear(run)
    if not isinstance(model, ARX):
        raise ValueError(f"long_run: Fieller's interval is for ARX; take dc_gain of {type(model).__name__}.")
    theta, cov = taken(run, at)
    gain = Response(*spread(lambda theta: _gain(model, theta), theta, cov))
    found, place = [], model.na
    over = np.where(np.arange(model.n) < model.na, -1.0, 0.0)
    for j, (nb, _) in enumerate(model.lags):
        top = np.zeros(model.n)
        top[place : place + nb] = 1.0
        place += nb
        low, high = fieller(theta[0], cov[0], top, over, 1.0, quantile(level, "long_run"))
        name = model.inputs[j] if isinstance(model.inputs, tuple) else f"u{j + 1}"
        found.append(LongRun(name, float(gain.value[0, j]), float(gain.std[0, j]), low, high))
    return tuple(found)


def fieller(theta: Array, cov: Array, top: Array, over: Array, one: float, z: float) -> tuple[float, float]:
    """All g for which top' theta - g (one + over' theta) is within z standard deviations of 0.

    (-inf, inf) if this set is unbounded, as when the denominator is not clearly different from zero.
    """
    a, b = float(top @ theta), one + float(over @ theta)
    aa, ab, bb = float(top @ cov @ top), float(top @ cov @ over), float(over @ cov @ over)
    A, B, C = b * b - z * z * bb, a * b - z * z * ab, a * a - z * z * aa
    root = B * B - A * C
    if not (A > 0.0 and root >= 0.0):
        return (float("nan"),) * 2 if np.isnan(A + root) else (-np.inf, np.inf)
    return (B - np.sqrt(root)) / A, (B + np.sqrt(root)) / A


STEP = 0.01


def jacobian(f: Callable[[Array], Array], theta: Array, std: Array) -> Array:
    """Slopes (T, .., n) of f at theta (T, n); f maps (T, n) to (T, ..)."""
    size = np.where(np.isfinite(std) & (std > 0.0), STEP * std, 1e-6 * np.maximum(np.abs(theta), 1e-3))
    slopes = []
    for i in range(theta.shape[1]):
        h = np.zeros_like(theta)
        h[:, i] = size[:, i]
        up, down = f(theta + h), f(theta - h)
        slopes.append((up - down) / (2.0 * size[:, i]).reshape(-1, *(1,) * (up.ndim - 1)))
    return np.stack(slopes, axis=-1)


def spread(f: Callable[[Array], Array], theta: Array, cov: Array) -> tuple[Array, Array]:
    """(f, its standard deviation), each (T, ..), at theta (T, n) with covariance (T, n, n); NaN without one."""
    var = np.einsum("tii->ti", cov)
    J = jacobian(f, theta, np.sqrt(np.abs(var)))
    with np.errstate(invalid="ignore"):
        square = np.einsum("t...i,tij,t...j->t...", J, cov, J)
        return f(theta), np.sqrt(square)


class LiveSystem:
    """The frozen system after the last sample of a stream; `Live.system` makes it.

    The methods are those of `Track` for one sample, without the time axis.
    """

    def __init__(self, live: Live) -> None:
        self.model, self.tracker, self.names = live.model, live.tracker, live.names
        self.theta = live.theta[None]
        self._cov = live.cov
        linear(self)

    def __len__(self) -> int:
        return 1

    def cov(self, t: int) -> Array:
        """Covariance of theta, (n, n)."""
        return self._cov

    def covariances(self) -> Array:
        """The same with a time axis, (1, n, n)."""
        return self._cov[None]

    def poles(self) -> Array:
        """Poles, (na,) complex, the largest first."""
        return np.asarray(poles(self)[0])

    def largest_pole(self) -> Response:
        """Magnitude of the largest pole, with its standard deviation; below 1 the system is stable."""
        return _now(largest_pole(self, -1))

    def dc_gain(self) -> Response:
        """Gain of every input for a constant signal, (m,), with its standard deviation."""
        return _now(dc_gain(self, -1))

    def step_response(self, h: int, input: int | str = 0) -> Response:
        """Response (h,) to a unit step of one input."""
        return _now(step_response(self, h, input))

    def impulse_response(self, h: int, input: int | str = 0) -> Response:
        """Response (h,) to a unit impulse of one input."""
        return _now(impulse_response(self, h, input))

    def frequency_response(self, w: Any = None, input: int | str = 0) -> FrequencyResponse:
        """Magnitude and phase at w (k,) radians per sample, (k,) each, with standard deviations."""
        found = frequency_response(self, w, input)
        return FrequencyResponse(found.w, *(np.asarray(part[0]) for part in found[1:]))

    def to_scipy(self, dt: float = 1.0, input: int | str = 0) -> Any:
        """The system from one input to y as `scipy.signal.dlti`."""
        return to_scipy(self, -1, dt, input)

    def long_run(self, level: float = 0.95) -> tuple[LongRun, ...]:
        """Long-run effect b / (1 - a) of every input, with standard error and Fieller's interval."""
        return long_run(self, -1, level)


def _now(response: Response) -> Response:
    """The response of one sample, without the time axis."""
    return Response(response.value[0], response.std[0])

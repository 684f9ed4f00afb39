"""Other packages on the same regression, one function each: ``follow(record, setting, c) -> Outcome``.

A package is imported when it runs, so that a missing one costs nothing. All of them get the regressors; samples with a
missing output or lag are left out, as when incomplete rows are dropped. Starting weights are zero where a package would
draw them at random. For random-walk filters ``setting`` is the ratio of `walk`, and r = 1.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from lab.bench.oracle import DIFFUSE
from lab.bench.records import Outcome, Record

Follow = Callable[[Record, Any, Array], Outcome]


def walk(setting: tuple[float, float], c: Array) -> Array:
    """q (n,) in units of r: ratio / c^power, c the mean squares of the regressors; power 0 is one q for all."""
    ratio, power = setting
    return np.asarray(ratio / c**power)


@contextmanager
def silence() -> Iterator[None]:
    """Warnings of other packages are suppressed; divergence is scored."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def nothing_said(record: Record) -> Outcome:
    """An outcome to fill in."""
    T, n = record.phi.shape
    return Outcome(np.zeros((T, n)), np.full((T, n), np.nan), np.full(T, np.nan), np.full(T, np.nan))


def one_by_one(record: Record, filter_: Any, weights: Callable[[], Array]) -> Outcome:
    """A filter with predict(x) and adapt(y, x) over the usable samples."""
    out = nothing_said(record)
    for t in range(len(record.y)):
        x = record.phi[t]
        if np.isfinite(x).all():
            out.prediction[t] = filter_.predict(x)
            if record.usable[t]:
                filter_.adapt(record.y[t], x)
        out.theta[t] = weights()
    return out


def padasip_rls(record: Record, setting: Any, c: Array) -> Outcome:
    """FilterRLS; ``setting`` is mu, its forgetting factor."""
    keywords = {} if setting is None else {"mu": setting, "eps": 1.0 / DIFFUSE}
    with silence():
        peer = import_module("padasip").filters.FilterRLS(record.phi.shape[1], w="zeros", **keywords)
        return one_by_one(record, peer, lambda: peer.w)


def padasip_nlms(record: Record, setting: Any, c: Array) -> Outcome:
    """FilterNLMS; ``setting`` is mu, its step."""
    keywords = {} if setting is None else {"mu": setting}
    with silence():
        peer = import_module("padasip").filters.FilterNLMS(record.phi.shape[1], w="zeros", **keywords)
        return one_by_one(record, peer, lambda: peer.w)


class _River:
    """River's learner with arrays for dictionaries."""

    def __init__(self, n: int, rate: float | None) -> None:
        river, optim = import_module("river.linear_model"), import_module("river.optim")
        self.learner = river.LinearRegression() if rate is None else river.LinearRegression(optimizer=optim.SGD(rate))
        self.keys = range(n)

    def predict(self, x: Array) -> float:
        return float(self.learner.predict_one(dict(zip(self.keys, x.tolist(), strict=True))))

    def adapt(self, y: float, x: Array) -> None:
        self.learner.learn_one(dict(zip(self.keys, x.tolist(), strict=True)), float(y))

    def weights(self) -> Array:
        return np.array([self.learner.weights.get(key, 0.0) for key in self.keys])


def river_linear(record: Record, setting: Any, c: Array) -> Outcome:
    """LinearRegression, stochastic gradient; ``setting`` is its learning rate."""
    with silence():
        peer = _River(record.phi.shape[1], setting)
        return one_by_one(record, peer, peer.weights)


def filterpy_kalman(record: Record, setting: Any, c: Array) -> Outcome:
    """KalmanFilter; without a setting its own start P = I, Q = I, R = 1."""
    T, n = record.phi.shape
    out = nothing_said(record)
    with silence():
        peer = import_module("filterpy.kalman").KalmanFilter(n, 1)
        peer.F, peer.H = np.eye(n), np.zeros((1, n))
        if setting is not None:
            peer.P, peer.Q = DIFFUSE * np.eye(n), np.diag(walk(setting, c))
        for t in range(T):
            peer.predict()
            x = record.phi[t : t + 1]
            if np.isfinite(x).all():
                out.prediction[t] = (x @ peer.x).item()
                out.prediction_std[t] = np.sqrt((x @ peer.P @ x.T + peer.R).item())
                if record.usable[t]:
                    peer.update(record.y[t], H=x)
            out.theta[t], out.std[t] = peer.x[:, 0], np.sqrt(np.diag(peer.P))
    return out


def statsmodels_recursive(record: Record, setting: Any, c: Array) -> Outcome:
    """RecursiveLS, which has no setting; its standard deviations use the noise variance of the whole record."""
    rows = record.usable
    with silence():
        api = import_module("statsmodels.api")
        fit = api.RecursiveLS(record.y[rows], record.phi[rows]).fit()
    filtered = fit.recursive_coefficients.filtered.T
    variances = np.diagonal(fit.recursive_coefficients.filtered_cov.T, axis1=1, axis2=2)
    return _spread(record, filtered, np.sqrt(np.maximum(variances, 0.0)), float(fit.scale))


def _spread(record: Record, theta: Array, std: Array, r: float) -> Outcome:
    """Put estimates after every usable sample on all samples; predict from the last one."""
    out = nothing_said(record)
    last = np.cumsum(record.usable) - 1
    known = last >= 0
    out.theta[known], out.std[known] = theta[last[known]], std[last[known]]
    before = np.concatenate([np.zeros((1, theta.shape[1])), out.theta[:-1]])
    out.prediction[:] = np.sum(record.phi * before, axis=1)
    return out


def _masked(record: Record) -> tuple[Array, Array]:
    """(y, phi) with rows of zeros where a sample cannot be used: such a row changes nothing but time."""
    return np.where(record.usable, record.y, 0.0), np.where(record.usable[:, None], record.phi, 0.0)


def pykalman_kalman(record: Record, setting: Any, c: Array) -> Outcome:
    """KalmanFilter with the regressors as observation matrices."""
    y, phi = _masked(record)
    n = phi.shape[1]
    q, start = (np.eye(n), np.eye(n)) if setting is None else (np.diag(walk(setting, c)), DIFFUSE * np.eye(n))
    with silence():
        peer = import_module("pykalman").KalmanFilter(
            np.eye(n), phi[:, None, :], q, [[1.0]], np.zeros(n), [0.0], np.zeros(n), start + q
        )
        mean, cov = peer.filter(y[:, None])
    return after_filtering(record, np.asarray(mean), np.asarray(cov), q)


def dynamax_kalman(record: Record, setting: Any, c: Array) -> Outcome:
    """lgssm_filter in double precision with the regressors as emission weights."""
    y, phi = _masked(record)
    n = phi.shape[1]
    q = np.diag(walk(setting, c))
    with silence():
        import_module("jax").config.update("jax_enable_x64", True)
        array = import_module("jax.numpy").asarray
        module = import_module("dynamax.linear_gaussian_ssm")
        make = import_module("dynamax.linear_gaussian_ssm.inference").make_lgssm_params
        start = np.zeros(n), DIFFUSE * np.eye(n) + q, np.eye(n), q
        post = module.lgssm_filter(make(*map(array, (*start, phi[:, None, :], np.eye(1)))), array(y[:, None]))
    return after_filtering(record, np.asarray(post.filtered_means), np.asarray(post.filtered_covariances), q)


def simdkalman_kalman(record: Record, setting: Any, c: Array) -> Outcome:
    """The steps of its primitives; its filter takes no observation model that changes with time."""
    y, phi = _masked(record)
    T, n = phi.shape
    q, r = np.diag(walk(setting, c)), np.eye(1)
    means, covs = np.empty((T, n)), np.empty((T, n, n))
    with silence():
        steps = import_module("simdkalman.primitives")
        mean, cov = np.zeros((n, 1)), DIFFUSE * np.eye(n)
        for t in range(T):
            mean, cov = steps.predict(mean, cov, np.eye(n), q)
            mean, cov = steps.update(mean, cov, phi[t : t + 1], r, y[t : t + 1, None])
            means[t], covs[t] = mean[:, 0], cov
    return after_filtering(record, means, covs, q)


def after_filtering(record: Record, mean: Array, cov: Array, q: Array) -> Outcome:
    """An outcome from filtered moments (T, n) and (T, n, n): predictions are made from those of the sample before."""
    n = mean.shape[1]
    before = np.concatenate([np.zeros((1, n)), mean[:-1]])
    P = np.concatenate([DIFFUSE * np.eye(n)[None], cov[:-1]]) + q
    with np.errstate(invalid="ignore"):
        s = np.einsum("ti,tij,tj->t", record.phi, P, record.phi) + 1.0
        std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        return Outcome(mean, std, np.sum(record.phi * before, axis=1), np.sqrt(s))

"""The jobs of other packages in the contests of speed: one function per package and task, ``make(signals) -> Job``.

All run theta_t = theta_(t-1) + w, w ~ N(0, Q I), y = phi' theta + v, v ~ N(0, R), theta before the first sample
N(0, P0 I), in double precision. Each raises ImportError where its package is absent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from lab.bench.contest import Job, need

Q, R, P0 = 1e-4, 0.01, 10.0
TRANSITION = ((0.99, 0.01), (0.01, 0.99))


class Signals(NamedTuple):
    """y (T,) and regressors phi (T, n); with a leading axis for many series."""

    y: Array
    phi: Array

    def first(self, stop: int) -> Signals:
        """The first samples."""
        return Signals(self.y[:stop], self.phi[:stop])


def on(data: Signals, makers: Iterable[Callable[[Signals], Job]]) -> list[Callable[[], Job]]:
    """Makers of jobs on these signals."""
    return [partial(make, data) for make in makers]


def _new_filterpy(n: int, q: float = Q) -> Any:
    peer = need("filterpy.kalman", "KalmanFilter")(n, 1)
    peer.F, peer.Q, peer.R, peer.P = np.eye(n), q * np.eye(n), np.array([[R]]), P0 * np.eye(n)
    return peer


def live_filterpy(data: Signals) -> Job:
    """KalmanFilter.predict and update."""
    peer = _new_filterpy(data.phi.shape[1])
    rows, outputs = list(data.phi[:, None, :]), data.y.tolist()

    def run() -> None:
        for y, H in zip(outputs, rows, strict=True):
            peer.predict()
            peer.update(y, H=H)

    return Job("filterpy KalmanFilter", run, len(outputs), lambda: np.asarray(peer.x[:, 0]))


def live_pykalman(data: Signals) -> Job:
    """KalmanFilter.filter_update."""
    n = data.phi.shape[1]
    peer = need("pykalman", "KalmanFilter")(
        transition_matrices=np.eye(n), transition_covariance=Q * np.eye(n), observation_covariance=[[R]]
    )
    now = {"mean": np.zeros(n), "cov": P0 * np.eye(n)}
    rows = list(data.phi[:, None, :])

    def run() -> None:
        for y, H in zip(data.y, rows, strict=True):
            now["mean"], now["cov"] = peer.filter_update(now["mean"], now["cov"], np.array([y]), observation_matrix=H)

    return Job("pykalman filter_update", run, len(rows), lambda: np.asarray(now["mean"]))


def live_simdkalman(data: Signals) -> Job:
    """Primitives predict and update."""
    steps = need("simdkalman.primitives")
    n = data.phi.shape[1]
    now = {"mean": np.zeros((n, 1)), "cov": P0 * np.eye(n)}
    F, q, r = np.eye(n), Q * np.eye(n), np.array([[R]])
    rows, outputs = list(data.phi[:, None, :]), list(data.y[:, None, None])

    def run() -> None:
        for y, H in zip(outputs, rows, strict=True):
            now["mean"], now["cov"] = steps.predict(now["mean"], now["cov"], F, q)
            now["mean"], now["cov"] = steps.update(now["mean"], now["cov"], H, r, y)

    return Job("simdkalman primitives", run, len(rows), lambda: np.asarray(now["mean"]).ravel())


def _live_padasip(name: str, data: Signals, **settings: float) -> Job:
    peer = need("padasip").filters.__dict__[name](data.phi.shape[1], w="zeros", **settings)
    rows, outputs = list(data.phi), data.y.tolist()

    def run() -> None:
        for y, x in zip(outputs, rows, strict=True):
            peer.adapt(y, x)

    return Job(f"padasip {name}", run, len(rows), lambda: np.asarray(peer.w))


def live_padasip_rls(data: Signals, forgetting: float) -> Job:
    """FilterRLS.adapt, which predicts too."""
    return _live_padasip("FilterRLS", data, mu=forgetting, eps=1.0 / P0)


def live_padasip_nlms(data: Signals, mu: float) -> Job:
    """FilterNLMS.adapt; unit step and eps = mu make it `AugmentedFLS`."""
    return _live_padasip("FilterNLMS", data, mu=1.0, eps=mu)


def live_river(data: Signals) -> Job:
    """LinearRegression, predict_one and learn_one."""
    peer = need("river.linear_model", "LinearRegression")()
    rows, outputs = [dict(enumerate(row)) for row in data.phi.tolist()], data.y.tolist()

    def run() -> None:
        for y, x in zip(outputs, rows, strict=True):
            peer.predict_one(x)
            peer.learn_one(x, y)

    return Job("river LinearRegression", run, len(rows))


def live_filterpy_imm(data: Signals) -> Job:
    """IMMEstimator of two filters."""
    n = data.phi.shape[1]
    filters = [_new_filterpy(n, Q), _new_filterpy(n, 100.0 * Q)]
    peer = need("filterpy.kalman", "IMMEstimator")(filters, np.array([0.5, 0.5]), np.array(TRANSITION))
    rows, outputs = list(data.phi[:, None, :]), data.y.tolist()

    def run() -> None:
        for y, H in zip(outputs, rows, strict=True):
            for each in filters:
                each.H = H
            peer.predict()
            peer.update(y)

    return Job("filterpy IMMEstimator", run, len(rows), lambda: np.asarray(peer.x).ravel())


def filterpy_filter(data: Signals) -> Job:
    """The same loop as live, over a record from its start."""
    part = data.first(len(data.y) // 10)
    n = part.phi.shape[1]
    rows, outputs = list(part.phi[:, None, :]), part.y.tolist()
    _new_filterpy(n)

    def run() -> Array:
        peer, theta = _new_filterpy(n), np.empty((len(rows), n))
        for t, (y, H) in enumerate(zip(outputs, rows, strict=True)):
            peer.predict()
            peer.update(y, H=H)
            theta[t] = peer.x[:, 0]
        return theta

    return Job("filterpy KalmanFilter, loop", run, len(rows), run)


def _new_pykalman(data: Signals) -> Any:
    n = data.phi.shape[1]
    return need("pykalman", "KalmanFilter")(
        np.eye(n), data.phi[:, None, :], Q * np.eye(n), [[R]], np.zeros(n), [0.0], np.zeros(n), (P0 + Q) * np.eye(n)
    )


def pykalman_filter(data: Signals) -> Job:
    """KalmanFilter.filter."""
    part = data.first(len(data.y) // 10)
    peer = _new_pykalman(part)
    return Job(
        "pykalman filter", lambda: peer.filter(part.y[:, None]), len(part.y),
        lambda: np.asarray(peer.filter(part.y[:, None])[0]),
    )  # fmt: skip


def pykalman_smoother(data: Signals) -> Job:
    """KalmanFilter.smooth."""
    peer = _new_pykalman(data)
    return Job(
        "pykalman smooth", lambda: peer.smooth(data.y[:, None]), len(data.y),
        lambda: np.asarray(peer.smooth(data.y[:, None])[0]),
    )  # fmt: skip


def _new_statsmodels(data: Signals) -> Any:
    n = data.phi.shape[1]
    peer = need("statsmodels.tsa.statespace.kalman_smoother", "KalmanSmoother")(k_endog=1, k_states=n, k_posdef=n)
    peer.bind(np.array(data.y[:, None]))
    peer["design"], peer["transition"], peer["selection"] = data.phi.T[None].copy(), np.eye(n), np.eye(n)
    peer["state_cov"], peer["obs_cov"] = Q * np.eye(n), np.array([[R]])
    peer.initialize_known(np.zeros(n), (P0 + Q) * np.eye(n))
    return peer


def statsmodels_filter(data: Signals) -> Job:
    """The state-space filter, compiled."""
    peer = _new_statsmodels(data)
    return Job("statsmodels statespace", peer.filter, len(data.y), lambda: np.asarray(peer.filter().filtered_state.T))


def statsmodels_smoother(data: Signals) -> Job:
    """The state-space smoother, compiled."""
    peer = _new_statsmodels(data)
    return Job("statsmodels statespace", peer.smooth, len(data.y), lambda: np.asarray(peer.smooth().smoothed_state.T))


def statsmodels_fleet(data: Signals) -> Job:
    """Sixteen series in a loop."""
    filters = [_new_statsmodels(Signals(*series)) for series in zip(data.y[:16], data.phi[:16], strict=True)]

    def run() -> None:
        for each in filters:
            each.filter()

    answer = lambda: np.asarray(filters[0].filter().filtered_state.T)  # noqa: E731
    return Job("statsmodels statespace, loop", run, data.y[:16].size, answer)


def statsmodels_recursive(data: Signals) -> Job:
    """RecursiveLS."""
    api = need("statsmodels.api")

    def run() -> Any:
        return api.RecursiveLS(data.y, data.phi).fit()

    return Job("statsmodels RecursiveLS", run, len(data.y), lambda: np.asarray(run().recursive_coefficients.filtered.T))


def _dynamax(data: Signals, name: str) -> tuple[Any, Any, Any]:
    """(compiled function of phi and y, phi, y)."""
    jax = need("jax")
    jax.config.update("jax_enable_x64", True)
    n = data.phi.shape[-1]
    make, work = (
        need("dynamax.linear_gaussian_ssm.inference", "make_lgssm_params"),
        need("dynamax.linear_gaussian_ssm", name),
    )
    array = jax.numpy.asarray
    start = [array(v) for v in (np.zeros(n), (P0 + Q) * np.eye(n), np.eye(n), Q * np.eye(n))]

    def call(phi: Any, y: Any) -> Any:
        return work(make(*start, phi[:, None, :], array([[R]])), y[:, None])

    return call, array(data.phi), array(data.y)


def dynamax_filter(data: Signals) -> Job:
    """lgssm_filter, compiled for this length before it is timed."""
    return _dynamax_job(data, "lgssm_filter", "filtered_means")


def dynamax_smoother(data: Signals) -> Job:
    """lgssm_smoother, compiled for this length before it is timed."""
    return _dynamax_job(data, "lgssm_smoother", "smoothed_means")


def _dynamax_job(data: Signals, name: str, means: str) -> Job:
    call, phi, y = _dynamax(data, name)
    jax = need("jax")
    compiled = jax.jit(call)

    def run() -> Any:
        return jax.block_until_ready(compiled(phi, y))

    return Job(f"dynamax {name}", run, len(data.y), lambda: np.asarray(getattr(run(), means)))


def dynamax_fleet(data: Signals) -> Job:
    """lgssm_filter mapped over the series by jax.vmap."""
    call, phi, y = _dynamax(data, "lgssm_filter")
    jax = need("jax")
    compiled = jax.jit(jax.vmap(call))

    def run() -> Any:
        return jax.block_until_ready(compiled(phi, y))

    return Job("dynamax vmap(lgssm_filter)", run, data.y.size, lambda: np.asarray(run().filtered_means[0]))


def simdkalman_fleet(data: Signals) -> Job:
    """Its primitives over all series at once, a loop over time."""
    steps = need("simdkalman.primitives")
    count, T, n = data.phi.shape
    F, q, r = np.eye(n), Q * np.eye(n), np.array([[R]])

    def run() -> Array:
        mean, cov, theta = np.zeros((count, n, 1)), np.tile(P0 * np.eye(n), (count, 1, 1)), np.empty((T, n))
        for t in range(T):
            mean, cov = steps.predict(mean, cov, F, q)
            mean, cov = steps.update(mean, cov, data.phi[:, t, None, :], r, data.y[:, t, None, None])
            theta[t] = mean[0, :, 0]
        return theta

    return Job("simdkalman primitives", run, data.y.size, run)


def polars_rls(data: Signals, forgetting: float) -> Job:
    """least_squares.rls of polars-ols, coefficients."""
    ols, pl = need("polars_ols"), need("polars")
    n = data.phi.shape[1]
    frame = pl.DataFrame({"y": data.y} | {f"x{i}": np.ascontiguousarray(data.phi[:, i]) for i in range(n)})
    settings = ols.RLSKwargs(half_life=math.log(0.5) / math.log(forgetting), initial_state_covariance=P0)
    expression = ols.compute_recursive_least_squares(
        pl.col("y"), *(pl.col(f"x{i}") for i in range(n)), mode="coefficients", rls_kwargs=settings
    )

    def run() -> Any:
        return frame.select(expression.alias("theta"))

    answer = lambda: np.asarray(run()["theta"].struct.unnest().to_numpy())  # noqa: E731
    return Job("polars-ols rls", run, len(data.y), answer)


def padasip_rls(data: Signals, forgetting: float) -> Job:
    """FilterRLS.run, which keeps the weights before each sample."""
    part = data.first(len(data.y) // 10)
    kind = need("padasip").filters.FilterRLS

    def run() -> Array:
        peer = kind(part.phi.shape[1], mu=forgetting, eps=1.0 / P0, w="zeros")
        before = peer.run(part.y, part.phi)[2]
        return np.concatenate([before[1:], [peer.w]])

    return Job("padasip FilterRLS.run", run, len(part.y), run)

"""Ten thousand series at once: driftfit against dynamax (vmap) and simdkalman (its primitives, step by step).

The task: random-walk Kalman regressions with n = 4, y (units, T), regressors (units, T, 4), double precision, results
for every sample. All packages get the same arrays, each runs once to warm up, and the best of three runs counts.
driftfit writes means, variances, predictions, innovations and their variances; the others write means and covariances.
Packages that are not installed are left out. "streaming the bytes" reads the same inputs and writes as many bytes as
driftfit's results have, with the same number of threads: no program that keeps these results can be faster.

Run: python benchmarks/fleets.py [--quick]
"""

from __future__ import annotations

import importlib.util
import itertools
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import ARX, Kalman, Regression, track
from driftfit.engine.kernel import Array
from driftfit.fleets import Fleet
from driftfit.run.parallel_lanes import cores

Q, R, P0 = 1e-4, 0.01, 10.0
TRACKER = Kalman(q=Q, r=R, p0=P0)


def simulate(units: int, T: int) -> tuple[Array, Array]:
    """y (units, T) and regressors (units, T, 4) with random-walk parameters."""
    rng = np.random.default_rng(0)
    phi = rng.normal(size=(units, T, 4))
    theta = rng.normal(size=(units, 1, 4)) + np.cumsum(np.sqrt(Q) * rng.normal(size=(units, T, 4)), axis=1)
    return np.einsum("kti,kti->kt", phi, theta) + np.sqrt(R) * rng.normal(size=(units, T)), phi


def best(run: Callable[[], object], repeats: int = 3) -> tuple[float, float]:
    """(first, best of the rest) in seconds."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return seconds[0], min(seconds[1:])


def dynamax_run(y: Array, phi: Array) -> Callable[[], Array]:
    import jax
    import jax.numpy as jnp
    from dynamax.linear_gaussian_ssm import lgssm_filter
    from dynamax.linear_gaussian_ssm.inference import make_lgssm_params

    jax.config.update("jax_enable_x64", True)

    def one(series: Array, rows: Array) -> tuple[Array, Array]:
        # dynamax's prior refers to the time after the first drift, ours to the time before it
        parameters = make_lgssm_params(
            jnp.zeros(4), (P0 + Q) * jnp.eye(4), jnp.eye(4), Q * jnp.eye(4), rows[:, None, :], R * jnp.eye(1)
        )
        posterior = lgssm_filter(parameters, series[:, None])
        return posterior.filtered_means, posterior.filtered_covariances

    fleet = jax.jit(jax.vmap(one))
    given = jnp.asarray(y), jnp.asarray(phi)
    return lambda: np.asarray(jax.block_until_ready(fleet(*given))[0][:, -1])


def simdkalman_run(y: Array, phi: Array) -> Callable[[], Array]:
    from simdkalman import primitives

    units, T = y.shape
    eye, noise = np.eye(4)[None], np.array([[[R]]])

    def run() -> Array:
        means, covariances = np.empty((T, units, 4)), np.empty((T, units, 4, 4))
        mean, covariance = np.zeros((units, 4, 1)), np.broadcast_to(P0 * np.eye(4), (units, 4, 4))
        for t in range(T):
            mean, covariance = primitives.predict(mean, covariance, eye, Q * eye)
            mean, covariance = primitives.update(mean, covariance, phi[:, t, None, :], noise, y[:, t, None, None])
            means[t], covariances[t] = mean[..., 0], covariance
        return means[-1]

    return run


def streaming(y: Array, phi: Array, size: int) -> Callable[[], None]:
    """Read the inputs and write ``size`` bytes of fresh memory, a share per thread."""

    def share(out: Array, part: slice) -> None:
        y[part].sum()
        phi[part].sum()
        out.fill(1.0)

    def run() -> None:
        out, threads = np.empty(size // 8), cores()
        rows = np.linspace(0, len(y), threads + 1).astype(int)
        with ThreadPoolExecutor(threads) as pool:
            parts = [slice(a, b) for a, b in itertools.pairwise(rows)]
            list(pool.map(share, np.array_split(out, threads), parts))

    return run


def last_theta(fleet: Fleet) -> Array:
    return np.stack([fleet[key].theta[-1] for key in fleet])


def main(quick: bool) -> None:
    units, T = (320, 200) if quick else (10_000, 1_000)
    y, phi = simulate(units, T)
    kept: list[Fleet] = []

    def own() -> None:
        kept.clear()
        kept.append(track(Regression(4), TRACKER, y, phi, by="row"))

    rows = [("driftfit", *best(own))]
    mine = last_theta(kept[0])
    size = kept[0].nbytes
    kept.clear()
    for name, build in (("dynamax", dynamax_run), ("simdkalman", simdkalman_run)):
        if importlib.util.find_spec(name):
            run = build(y, phi)
            agree = np.abs(run() - mine).max()
            assert agree < 1e-8, (name, agree)
            rows.append((name, *best(run, 1 if name == "simdkalman" else 3)))
    rows.append(("streaming the bytes", *best(streaming(y, phi, size))))
    one = phi[:, :, 0]
    rows.append(("driftfit, ARX(2, 2)", *best(lambda: track(ARX(2, 2), TRACKER, y, one, by="row"))))

    console = Console(width=96)
    console.print(f"{units} series of {T} samples, n = 4, {cores()} cores; results of driftfit: {size / 1e6:.0f} MB")
    table = Table(box=SIMPLE_HEAD, show_edge=False)
    for head in ("", "first run, s", "best run, s", "ns per series and step", "times driftfit"):
        table.add_column(head, justify="right" if head else "left")
    for name, first, fastest in rows:
        table.add_row(
            name, f"{first:.2f}", f"{fastest:.2f}", f"{fastest / units / T * 1e9:.1f}", f"{fastest / rows[0][2]:.2f}"
        )
    console.print(table)


if __name__ == "__main__":
    main("--quick" in sys.argv)

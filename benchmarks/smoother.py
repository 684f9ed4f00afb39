"""Speed of exact smoothing against statsmodels and a banded solve, and its growth with the record; and its memory.

    python benchmarks/smoother.py            about two minutes
    python benchmarks/smoother.py --quick

A random-walk regression with n = 4, means and standard deviations. Ours includes the replay of the run that collects
its regressors. Everything runs in one process on one thread; what is compared takes turns, and figures are the least
processor time of the turns, so that other programs on the machine disturb them as little as possible. statsmodels gets
the same model (identity transition, exact diffuse start) and is asked for smoothed means and covariances only. The
banded solve gives means only.

Memory is the peak of what Python allocates during a call, counted from before it. The output is what is asked for, the
means and standard deviations, 8 n bytes each; "held" is what our result keeps: these and the rank. Residuals and
leverages are not part of it: what it costs to read them later, or to ask for them at once, is printed last, with the
time of other starts and results.
"""

import os

for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import argparse
import tracemalloc
from time import process_time
from unittest.mock import patch

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.linalg import solveh_banded

from driftfit import FLS, Kalman, Regression, track
from driftfit.smooth.problem import walk_of
from driftfit.smooth.solvers import elimination
from driftfit.smooth.solvers.halves import inwards, outwards

N, MU = 4, 100.0


def record(T):
    rng = np.random.default_rng(1)
    theta = np.cumsum(0.1 * rng.standard_normal((T, N)), axis=0)
    phi = rng.standard_normal((T, N))
    return phi, np.sum(phi * theta, axis=1) + rng.standard_normal(T)


def ours(phi, y, run):
    smoothed = run.smooth()
    return smoothed.theta, smoothed.std


def statsmodels(phi, y, run):
    from statsmodels.tsa.statespace.kalman_smoother import SMOOTHER_STATE, SMOOTHER_STATE_COV, KalmanSmoother

    model = KalmanSmoother(k_endog=1, k_states=N, k_posdef=N, smoother_output=SMOOTHER_STATE | SMOOTHER_STATE_COV)
    model.bind(y[:, None])
    model["design"] = np.ascontiguousarray(phi.T[None])
    model["transition"] = model["selection"] = np.eye(N)
    model["state_cov"], model["obs_cov"] = np.eye(N) / MU, np.eye(1)
    model.initialize_diffuse()
    found = model.smooth()
    var = np.diagonal(found.smoothed_state_cov.transpose(2, 0, 1), axis1=1, axis2=2)
    return found.smoothed_state.T, np.sqrt(found_scale(run) * var)


def found_scale(run):
    return run.state["scale"]


def banded(phi, y, run):
    """Means by Cholesky of the block tridiagonal normal equations."""
    T = len(y)
    band = np.zeros((N + 1, T * N))
    band[0, N:] = -MU
    for j in range(N):
        band[N - j].reshape(T, N)[:, j:] = phi[:, j:] * phi[:, : N - j]
    band[N].reshape(T, N)[:] += MU * np.where(np.isin(np.arange(T), (0, T - 1)), 1.0, 2.0)[:, None]
    return solveh_banded(band, (phi * y[:, None]).ravel(), overwrite_ab=True).reshape(T, N), None


def seconds(function, *arguments):
    start = process_time()
    result = function(*arguments)
    return process_time() - start, result


def peak(function, *arguments):
    """(largest, remaining) bytes that a call allocates."""
    tracemalloc.start()
    result = function(*arguments)
    held, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most, held, result


def memory(T):
    """Peak memory in bytes per sample."""
    phi, y = record(T)
    run = track(Regression(N), FLS(MU), y, phi)
    smoothed = {}

    def kept():
        smoothed["result"] = run.smooth()
        return smoothed["result"].theta, smoothed["result"].std

    most, held, _ = peak(kept)
    other = peak(statsmodels, phi, y, run)[0]
    print(
        f"Memory in bytes per sample at {T:,} samples: means and standard deviations {16 * N}; driftfit at most "
        f"{most / T:.0f} ({most / T / (16 * N):.2f} times), held {held / T:.0f} ({held / T / (16 * N):.2f} times); "
        f"statsmodels at most {other / T:,.0f}"
    )


def others(T, turns):
    """Time with a proper prior, with leverages, and with covariances, relative to that without."""
    phi, y = record(T)
    run = track(Regression(N), FLS(MU), y, phi)
    prior = track(Regression(N), Kalman(q=1.0 / MU, r=1.0, p0=10.0), y, phi)
    ways = (run.smooth, prior.smooth, lambda: run.smooth().leverage, lambda: run.smooth("fit").leverage)
    alone, *others = np.min([[seconds(way)[0] for way in ways] for _ in range(turns)], axis=0)
    others.append(min(seconds(run.smooth, "cov")[0] for _ in range(5)))  # apart: its memory is new to the next in turn
    proper, later, at_once, cov = np.array(others) / alone
    print(
        f"Times as long: {proper:.2f} with a proper prior (Kalman, p0=10); {later:.2f} with leverages, {at_once:.2f} "
        f'with keep="fit"; {cov:.1f} with keep="cov"'
    )


def phases(T, turns):
    """Shares of the time: the replay of the filter, and the elimination inwards and outwards."""
    phi, y = record(T)
    run = track(Regression(N), FLS(MU), y, phi)
    least = dict.fromkeys(("walk_of", "inwards", "outwards"), np.inf)

    def timed(name, function):
        def call(*arguments):
            taken, result = seconds(function, *arguments)
            least[name] = min(least[name], taken)
            return result

        return call

    with patch.multiple(elimination, inwards=timed("inwards", inwards), outwards=timed("outwards", outwards)):
        whole = min(seconds(run.smooth)[0] for _ in range(turns))
    for _ in range(turns):
        timed("walk_of", walk_of)(run)
    replay, inside, outside = np.array(list(least.values())) / whole
    print(
        f"Shares of the time at {T:,} samples ({whole / T * 1e9:.0f} ns a sample): replay of the filter {replay:.2f}, "
        f"elimination {inside:.2f} inwards and {outside:.2f} outwards"
    )


def main(quick: bool) -> None:
    sizes = (1_000, 3_000) if quick else (10_000, 100_000, 1_000_000)
    methods = {"driftfit": ours, "statsmodels": statsmodels, "banded solve, means only": banded}
    table = Table(
        title=f"Exact smoothing, n = {N}: seconds of processor time, and microseconds a sample",
        title_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
    )
    table.add_column("samples", justify="right")
    for name in methods:
        table.add_column(name, justify="right")
    table.add_column("statsmodels / driftfit", justify="right")
    table.add_column("largest difference", justify="right")
    track(Regression(N), FLS(MU), *record(100)[::-1]).smooth()
    for T in sizes:
        times, gap = compare(methods, T, 1 if quick or T == 1_000_000 else 600_000 // T)
        cells = [f"{min(t):.4f} ({min(t) / T * 1e6:.2f})" for t in times.values()]
        ratio = min(times["statsmodels"]) / min(times["driftfit"])
        table.add_row(f"{T:,}", *cells, f"{ratio:.1f}", f"{gap:.0e}")
    Console(width=120).print(table, "")
    memory(sizes[0])
    others(sizes[0], 1 if quick else 60)
    phases(sizes[1], 1 if quick else 20)


def compare(methods, T, turns):
    """Seconds of each method, and the largest difference from statsmodels."""
    phi, y = record(T)
    run = track(Regression(N), FLS(MU), y, phi)
    times = {name: [] for name in methods}
    found = {}
    for _ in range(turns):
        for name, method in methods.items():
            taken, found[name] = seconds(method, phi, y, run)
            times[name].append(taken)
    theta, std = found["driftfit"]
    other, other_std = found["statsmodels"]
    return times, max(np.abs(theta - other).max() / np.abs(theta).max(), np.abs(std / other_std - 1.0).max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="up to 3,000 samples, once")
    main(parser.parse_args().quick)

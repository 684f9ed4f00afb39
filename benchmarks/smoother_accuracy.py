"""Accuracy of exact smoothing against eighty-digit arithmetic, with a banded solve and a large P0 for comparison.

    python benchmarks/smoother_accuracy.py       about 20 seconds

Errors are the largest over 40 samples and 3 parameters, relative to each parameter's largest value. "ratio" is mu over
the mean of phi' phi. The banded solve is Cholesky without refinement; "P0 = 1e7" is this library's Kalman filter and
smoother with a large number in the place of the diffuse start.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import numpy as np
from naive_smoother import precise
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.linalg import LinAlgError, solveh_banded

from driftfit import FLS, Kalman, Regression, track

L, N = 40, 3


def records():
    rng = np.random.default_rng(1)
    plain = rng.standard_normal((L, N))
    near = plain.copy()
    near[:, 2] = plain[:, 1] + 1e-4 * plain[:, 2]
    y = rng.standard_normal(L)
    return {"plain": (plain, y), "columns 1e-4, 1, 1e4": (plain * [1e-4, 1.0, 1e4], y), "collinear to 1e-4": (near, y)}


def banded(phi, y, mu):
    band = np.zeros((N + 1, L * N))
    band[0, N:] = -mu
    for k in range(L):
        block = np.outer(phi[k], phi[k]) + mu * (1.0 if k in (0, L - 1) else 2.0) * np.eye(N)
        for i in range(N):
            for j in range(i, N):
                band[N - (j - i), k * N + j] = block[i, j]
    try:
        return solveh_banded(band, (phi * y[:, None]).ravel()).reshape(L, N)
    except LinAlgError:
        return np.full((L, N), np.nan)


def error(found, truth):
    size = np.abs(found - truth).max(axis=0) / np.abs(truth).max(axis=0)
    return "fails" if np.isnan(size).any() else f"{size.max():.0e}"


def main() -> None:
    table = Table(
        title="Errors of the smoothed path, and of the standard deviations",
        title_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
    )
    for name in ("regressors", "ratio", "driftfit", "std", "path", "banded", "P0 = 1e7"):
        table.add_column(name, justify="left" if name == "regressors" else "right")
    for name, (phi, y) in records().items():
        for ratio in (1e-12, 1e-6, 1.0, 1e6, 1e12):
            mu = ratio * float(np.mean(np.sum(phi**2, axis=1)))
            theta, var = precise(phi, y, mu)
            ours = track(Regression(N), FLS(mu), y, phi).smooth()
            large = track(Regression(N), Kalman(q=1.0 / mu, r=1.0, p0=1e7), y, phi).smooth()
            table.add_row(
                name, f"{ratio:g}", error(ours.theta, theta), error(ours.std / np.sqrt(ours.r), np.sqrt(var)),
                ours.method, error(banded(phi, y, mu), theta), error(large.theta, theta),
            )  # fmt: skip
    Console(width=100, color_system=None).print(table)


if __name__ == "__main__":
    main()

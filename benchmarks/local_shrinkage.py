"""Local shrinkage beside other smoothers, on the examples of Chen et al. (2020) and two systems with known paths.

Errors of theta (rms, from the sixth sample on) and the share of it within 95 % bands: of all samples, and of those
within six samples of a jump. Flexible least squares is tuned by maximum likelihood; total variation has the best of the
penalties .3, 1, 3 and 10 in hindsight, and no bands.
Run: python benchmarks/local_shrinkage.py [records, 10 by default] [--quick, a row]
"""

import sys
import warnings

import numpy as np

from driftfit import FLS, AdaptiveKalman, Bank, Regression, local_shrinkage, total_variation, track, tune
from driftfit.show.text import printed, table_of
from driftfit.systems import time_varying
from driftfit.systems.time_varying import Simulated

SYSTEMS = ("sinusoids", "rational", "switching", "exp_ar", "jumps one by one", "walk")


def system(name: str, rng: np.random.Generator, T: int = 400) -> Simulated:
    if hasattr(time_varying, name):
        made: Simulated = getattr(time_varying, name)(rng=rng)
        return made
    if name == "walk":
        theta = np.cumsum(0.05 * rng.standard_normal((T, 2)), axis=0)
    else:
        theta = np.tile([1.0, 0.5], (T, 1))
        for j in (0, 0, 1, 1):
            theta[rng.integers(20, T - 20) :, j] += rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0)
    phi = np.column_stack([rng.standard_normal(T), np.ones(T)])
    return Simulated(Regression(2), np.sum(phi * theta, axis=1) + 0.5 * rng.standard_normal(T), phi, phi, theta)


def tuned(made: Simulated) -> FLS:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a record of 30 samples without noise at the best mu
        best: FLS = tune(made.model, FLS(), made.y, made.u, intervals=False).tracker
    return best


def main(records: int = 10, systems: tuple[str, ...] = SYSTEMS) -> None:
    names = ("FLS, tuned", "total variation", "Bank", "default", "local shrinkage")
    errors = table_of("Errors of theta (rms)", "", *names)
    bands = table_of("Within 95 % bands, and near jumps", "", *(name for name in names if name != "total variation"))
    for name in systems:
        square: dict[str, list[float]] = {one: [] for one in names}
        inside: dict[str, list[float]] = {one: [] for one in names}
        near: dict[str, list[float]] = {one: [] for one in names}
        for seed in range(records):
            made = system(name, np.random.default_rng([seed, *name.encode()]))
            run = track(made.model, FLS(100.0), made.y, made.u)
            paths = {
                "FLS, tuned": track(made.model, tuned(made), made.y, made.u).smooth(),
                "Bank": track(made.model, Bank(), made.y, made.u).smooth(),
                "default": track(made.model, AdaptiveKalman(), made.y, made.u).smooth(),
                "local shrinkage": local_shrinkage(run, seed=seed),
            }
            jumps = np.abs(np.diff(made.theta, axis=0, prepend=made.theta[:1])).max(axis=1) > 0.25
            close = np.convolve(jumps, np.ones(13), "same")[5:] > 0.0
            for one, path in paths.items():
                low, high = path.band()
                within = ((low <= made.theta) & (made.theta <= high))[5:]
                square[one].append(np.mean((path.theta - made.theta)[5:] ** 2))
                inside[one].append(within.mean())
                near[one] += within[close].ravel().tolist() if name in ("switching", "jumps one by one") else []
            pieces = (total_variation(run, penalty).theta for penalty in (0.3, 1.0, 3.0, 10.0))
            square["total variation"].append(min(np.mean((path - made.theta)[5:] ** 2) for path in pieces))
        errors.add_row(name, *(f"{np.mean(square[one]) ** 0.5:.3f}" for one in names))
        parts = [(inside[one], near[one]) for one in names if inside[one]]
        bands.add_row(name, *(f"{np.mean(a):.2f}" + (f", {np.mean(b):.2f}" if b else "") for a, b in parts))
    print(printed(errors, bands))


if __name__ == "__main__":
    given = [int(one) for one in sys.argv[1:] if one.isdigit()]
    main(*given, **({"systems": SYSTEMS[:1]} if "--quick" in sys.argv else {}))

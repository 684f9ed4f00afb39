"""Flexible least squares on simulated records whose truth is known: filter, lag, smoother, outliers, jumps, sweeps.

Prints the tables of the chapter and, given a folder, draws its pictures. Run: python examples/smoothing.py [folder]
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from driftfit import FLS, AugmentedFLS, Kalman, Live, Regression, augmented, huber, total_variation, track, tune

BLUE, RED, GREY = "#1f5fa8", "#c23b22", "#8a8a8a"
SEEDS = 10
TWO = Regression(["gain", "offset"])


def random_walk(seed: int, T: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two coefficients with steps of 0.05, observed in noise of 0.5: the model is true with mu = 100."""
    rng = np.random.default_rng(seed)
    theta = np.cumsum(0.05 * rng.standard_normal((T, 2)), axis=0)
    phi = np.column_stack([rng.standard_normal(T), np.ones(T)])
    return phi, np.sum(phi * theta, axis=1) + 0.5 * rng.standard_normal(T), theta


def switching(seed: int, T: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two coefficients that jump from (0.3, 0.7) to (0.8, 1) in the middle, in noise of 0.2."""
    rng = np.random.default_rng(seed)
    theta = np.where(np.arange(T)[:, None] < T // 2, [0.3, 0.7], [0.8, 1.0])
    phi = rng.standard_normal((T, 2))
    return phi, np.sum(phi * theta, axis=1) + 0.2 * rng.standard_normal(T), theta


def with_outliers(y: np.ndarray, seed: int) -> np.ndarray:
    """A copy in which one output in twenty is off by 4."""
    rng = np.random.default_rng(seed)
    bad = y.copy()
    hit = rng.random(len(y)) < 0.05
    bad[hit] += 4.0 * rng.choice([-1.0, 1.0], hit.sum())
    return bad


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def table(title: str, head: list[str], rows: list[list[str]]) -> None:
    shown = Table(title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False)
    for i, name in enumerate(head):
        shown.add_column(name, justify="left" if i == 0 else "right")
    for row in rows:
        shown.add_row(*row)
    Console(width=110, color_system=None).print(shown, "")


def lags() -> None:
    """The value of waiting: errors and coverage of the filter, of every lag and of the smoother."""
    waits = (0, 1, 2, 5, 10, 20)
    errors: dict[str, list[float]] = {str(k): [] for k in (*waits, "whole record")}
    inside: dict[str, list[float]] = {name: [] for name in errors}
    for seed in range(SEEDS):
        phi, y, theta = random_walk(seed)
        live = Live(TWO, FLS(100.0), lag=max(waits))
        windows = []
        for t in range(len(y)):
            live.update(y[t], phi[t])
            windows.append(live.smooth())
        judged = slice(50, len(y) - max(waits))
        for k in waits:
            found = np.array([windows[t + k].theta[-1 - k] for t in range(50, len(y) - max(waits))])
            std = np.array([windows[t + k].std[-1 - k] for t in range(50, len(y) - max(waits))])
            errors[str(k)].append(rms(found - theta[judged]))
            inside[str(k)].append(np.mean(np.abs(found - theta[judged]) < 1.96 * std))
        smoothed = track(TWO, FLS(100.0), y, phi).smooth()
        errors["whole record"].append(rms(smoothed.theta[judged] - theta[judged]))
        inside["whole record"].append(
            np.mean(np.abs(smoothed.theta[judged] - theta[judged]) < 1.96 * smoothed.std[judged])
        )
    rows = [[k, f"{np.mean(errors[k]):.3f}", f"{np.mean(inside[k]):.3f}"] for k in errors]
    table(
        f"A true random walk, mu = 100, mean of {SEEDS} records",
        ["samples waited for", "error (rms)", "95 % bands cover"],
        rows,
    )


def robust() -> None:
    """Errors with and without outliers, and with a path of jumps."""
    found: dict[str, list[float]] = {}
    for seed in range(SEEDS):
        phi, y, theta = switching(seed)
        clean = track(Regression(2), FLS(30.0), y, phi)
        dirty = track(Regression(2), FLS(30.0), with_outliers(y, seed), phi)
        jumps = total_variation(clean, 3.0)
        for name, path in {
            "clean: quadratic, mu = 30": clean.smooth().theta,
            "clean: Huber": huber(clean).path.theta,
            "clean: total variation, penalty 3": jumps.theta,
            "clean: total variation, refitted": jumps.refit,
            "5 % outliers: quadratic, mu = 30": dirty.smooth().theta,
            "5 % outliers: Huber": huber(dirty).path.theta,
            "5 % outliers: total variation, penalty 3": total_variation(dirty, 3.0).theta,
        }.items():
            found.setdefault(name, []).append(rms(path - theta))
    rows = [[name, f"{np.median(values):.3f}"] for name, values in found.items()]
    table(f"Jumping coefficients, median of {SEEDS} records", ["", "error (rms)"], rows)


def sweeps() -> None:
    """Distance of the sweeps of the augmented smoother from the exact path, and when they converge."""
    k = np.arange(1, 31)
    phi = np.column_stack([np.sin(10 + k) + 0.01, np.cos(10 + k)])
    theta = np.column_stack([np.sin(2 * np.pi * k / 15), np.cos(np.pi * k / 15)])
    y = np.sum(phi * theta, axis=1) + np.random.default_rng(1000).normal(0.0, 0.1, 30)
    rows = []
    for mu in (1.0, 10.0, 100.0):
        run = track(Regression(2), AugmentedFLS(mu), y, phi)
        exact = track(Regression(2), FLS(mu), y, phi).smooth().theta
        count = augmented(run, "constant", tol=1e-10).sweeps
        tied = augmented(run, "constant", ends="printed", tol=1e-10).theta
        power = augmented(run).theta
        rows.append([f"{mu:g}", str(count), f"{rms(tied - exact):.3f}", f"{rms(power - exact):.3f}"])
    table(
        "Augmented smoother, first example of the paper",
        [
            "mu",
            "sweeps to 1e-10",
            "off the exact path: printed ends",
            "power schedule",
        ],
        rows,
    )


def forecasts() -> None:
    """Coverage of forecasts of y, twenty samples ahead."""
    inside = []
    for seed in range(10 * SEEDS):
        phi, y, _ = random_walk(seed)
        found = track(TWO, Kalman(q=0.0025, r=0.25), y[:380], phi[:380]).forecast(20, phi[380:])
        inside.append(np.abs(y[380:] - found.y_hat) < 1.96 * found.y_std)
    covered = np.mean(inside, axis=0)
    rows = [
        [str(h), f"{covered[a:b].mean():.3f}"]
        for h, a, b in (("1 to 5", 0, 5), ("6 to 10", 5, 10), ("11 to 20", 10, 20))
    ]
    table(f"Forecasts of y, {10 * SEEDS} records", ["samples ahead", "95 % bands cover"], rows)


def trending(seed: int, T: int = 300, ahead: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two coefficients that oscillate slowly, observed in noise of 0.3."""
    rng = np.random.default_rng(seed)
    t = np.arange(T + ahead)
    theta = np.column_stack([np.sin(2.0 * np.pi * t / 200.0 + rng.uniform(0.0, 6.0)), 0.5 + 0.004 * t])
    phi = np.column_stack([rng.standard_normal(len(t)), np.ones(len(t))])
    return phi, np.sum(phi * theta, axis=1) + 0.3 * rng.standard_normal(len(t)), theta


def differences() -> None:
    """First and second differences, each with the mu of maximum likelihood, where they are suitable and where not."""
    rows = []
    truths = {"swings slowly": trending, "walks at random": lambda seed: random_walk(seed, 320)}
    for name, make in truths.items():
        for order in (1, 2):
            errors: list[tuple[float, ...]] = []
            for seed in range(SEEDS):
                phi, y, theta = make(seed)
                y, seen, known, later = y[:300], phi[:300], theta[:300], theta[300:]
                run = track(TWO, tune(TWO, FLS(differences=order), y, seen).tracker, y, seen)
                paths = (run.theta[50:] - known[50:], run.smooth().theta - known, run.forecast(20).theta - later)
                errors.append(tuple(rms(path) for path in paths))
            rows.append([f"{name}: differences={order}", *(f"{value:.3f}" for value in np.median(errors, axis=0))])
    table(
        f"Errors of theta (rms), mu by maximum likelihood, median of {SEEDS} records",
        ["", "filtered", "smoothed", "20 samples ahead"],
        rows,
    )


def maintained(seed: int, T: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A gain that changes only at sample 150, at maintenance, and an offset that drifts; with the known drift."""
    rng = np.random.default_rng(seed)
    theta = np.column_stack([np.where(np.arange(T) < 150, 1.0, 1.6), np.cumsum(0.05 * rng.standard_normal(T))])
    phi = np.column_stack([rng.standard_normal(T), np.ones(T)])
    y = np.sum(phi * theta, axis=1) + 0.5 * rng.standard_normal(T)
    drift = np.column_stack([np.where(np.arange(T) == 150, 1e3, 0.0), np.ones(T)])
    return phi, y, theta, drift


def known_changes() -> None:
    """A drift for every step and parameter, and one that maximum likelihood estimates for each parameter."""
    found: dict[str, list[list[float]]] = {}
    for seed in range(SEEDS):
        phi, y, theta, drift = maintained(seed)
        tuned = tune(TWO, Kalman(), y, phi, groups="each").tracker
        for name, run in {
            "a drift for each parameter, maximum likelihood": track(TWO, tuned, y, phi),
            "FLS(100), drift of the gain at sample 150 only": track(TWO, FLS(100.0), y, phi, drift=drift),
        }.items():
            errors = [rms(run.theta[50:, i] - theta[50:, i]) for i in (0, 1)]
            errors += [rms(run.smooth().theta[:, i] - theta[:, i]) for i in (0, 1)]
            found.setdefault(name, []).append(errors)
    rows = [[name, *(f"{value:.3f}" for value in np.median(errors, axis=0))] for name, errors in found.items()]
    table(
        f"A gain that changes once, at a known time, median of {SEEDS} records, error (rms)",
        ["", "gain, filtered", "offset", "gain, smoothed", "offset"],
        rows,
    )


def pictures(folder: Path) -> None:
    phi, y, theta = random_walk(3)
    smoothed = track(TWO, FLS(100.0), y, phi).smooth()
    figure = smoothed.plot()
    for i, axis in enumerate(figure.axes):
        axis.plot(smoothed.time, theta[:, i], color=RED, lw=0.9, label="truth")
    figure.axes[0].legend(loc="best", fontsize=8, ncols=3, frameon=False)
    figure.savefig(folder / "fls_smoother.png", dpi=110)

    phi, y, theta = switching(1)
    bad = with_outliers(y, 1)
    run, clean = track(Regression(2), FLS(30.0), bad, phi), track(Regression(2), FLS(30.0), y, phi)
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    left, right = figure.subplots(2, 1, sharex=True)
    left.set_title("one output in twenty is off by 4", fontsize=9, loc="left")
    left.plot(run.smooth().theta[:, 0], color=GREY, lw=1.0, label="quadratic")
    left.plot(huber(run).path.theta[:, 0], color=BLUE, lw=1.5, label="Huber")
    right.set_title("no outliers", fontsize=9, loc="left")
    right.plot(clean.smooth().theta[:, 0], color=GREY, lw=1.0, label="quadratic")
    jumps = total_variation(clean, 3.0)
    right.plot(jumps.theta[:, 0], color=BLUE, lw=1.5, label="total variation")
    for axis in (left, right):
        axis.plot(theta[:, 0], color=RED, lw=0.9, label="truth")
        axis.set_ylabel("theta1")
        axis.grid(alpha=0.25, lw=0.5)
        axis.legend(loc="best", fontsize=8, ncols=3, frameon=False)
    right.set_xlabel("sample")
    figure.savefig(folder / "fls_robust.png", dpi=110)
    second_differences().savefig(folder / "fls_second.png", dpi=110)


def second_differences() -> Figure:
    """The first coefficient of a slow oscillation, smoothed and forecast with first and with second differences."""
    phi, y, theta = trending(1, ahead=60)
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True, sharey=True)
    for order, axis in enumerate(axes, start=1):
        run = track(TWO, tune(TWO, FLS(differences=order), y[:300], phi[:300]).tracker, y[:300], phi[:300])
        path, ahead = run.smooth(), run.forecast(60)
        t = np.arange(360)
        mean = np.append(path.theta[:, 0], ahead.theta[:, 0])
        half = 1.96 * np.append(path.std[:, 0], ahead.std[:, 0])
        axis.set_title(f"differences={order}", fontsize=9, loc="left")
        axis.fill_between(t, mean - half, mean + half, color=BLUE, alpha=0.15, lw=0)
        axis.plot(t, mean, color=BLUE, lw=1.4, label="smoothed, then forecast")
        axis.plot(t, theta[:, 0], color=RED, lw=0.9, label="truth")
        axis.axvline(299.5, color=GREY, lw=0.8, ls=":")
        axis.set_ylim(-2.4, 2.4)
        axis.set_ylabel("gain")
        axis.grid(alpha=0.25, lw=0.5)
    axes[0].legend(loc="best", fontsize=8, ncols=2, frameon=False)
    axes[1].set_xlabel("sample")
    return figure


def main(folder: str | None = None) -> None:
    lags()
    robust()
    sweeps()
    forecasts()
    differences()
    known_changes()
    if folder:
        pictures(Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:2])

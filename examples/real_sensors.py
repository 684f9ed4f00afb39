"""Typical sensors of a plant, simulated: a constant input, fault codes, a coarse meter, a switching arc; and the
smoothing of random walks.

Prints the tables of docs/real_sensors.md. Run: python examples/real_sensors.py
"""

from __future__ import annotations

import warnings

import numpy as np

from driftfit import ARX, RLS, AdaptiveKalman, Bank, Kalman, Regression, Track, Tracker, track
from driftfit.extend import Array
from driftfit.systems.arc_furnace import switching

T = 2000
FORGET, WALK = RLS(0.98), Kalman(q=1e-4, r=0.01)


def rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def idle() -> None:
    """The first of two parameters jumps from 1 to 2 at sample 1000."""
    rng = np.random.default_rng(0)
    x, v = rng.normal(size=T), 0.1 * rng.normal(size=T)
    y = np.where(np.arange(T) < 1000, 1.0, 2.0) * x + v
    print("An input that is constant: response to x, 2 after a jump, at the end")
    print(f"  {'second column':16}{'AdaptiveKalman':>22}{'Bank()':>22}{'RLS(0.98)':>22}{'Kalman':>22}")
    for name, second in (("moves too", rng.normal(size=T)), ("stays at 0", np.zeros(T)), ("is x again", x)):
        for gate in (None, False):
            cells = []
            for tracker in (AdaptiveKalman(), Bank(), FORGET, WALK):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    run = track(Regression(2), tracker, y, np.column_stack([x, second]), gate=gate)
                both = name == "is x again"
                cells.append(f"{run.theta[-1].sum() if both else run.theta[-1, 0]:.3f} (std {run.std[-1, 0]:.3f})")
            print(f"  {name if gate is None else '  no gate':16}" + "".join(f"{cell:>22}" for cell in cells))


def codes() -> None:
    """y_t = 0.7 y_{t-1} + 2 u_{t-1} + v."""
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + 2.0 * u[t - 1] + 0.1 * rng.normal()
    print("\nFault codes: largest distance from [0.7, 2], 20 and 500 samples after the last of them")
    columns = [("AdaptiveKalman", AdaptiveKalman(), None), ("no gate", AdaptiveKalman(), False)]
    columns += [("RLS(0.98), gate", FORGET, True), ("no gate", FORGET, False)]
    columns += [("Kalman, gate", WALK, True), ("no gate", WALK, False)]
    print(f"  {'codes':22}" + "".join(f"{name:>16}" for name, _, _ in columns))
    for code, count, where, begin in (
        (9999.0, 1, "y", 100), (9999.0, 5, "y", 100), (-999.0, 1, "y", 100), (9999.0, 1, "u", 100),
        (9999.0, 1, "y", 0), (9999.0, 20, "y", 0), (-999.0, 1, "y", 4), (9999.0, 1, "u", 4),
    ):  # fmt: skip
        record = {"y": y.copy(), "u": u.copy()}
        record[where][begin : begin + count] = code
        cells = []
        for _, tracker, gate in columns:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a run without a gate names the codes
                away = np.abs(track(ARX(1, 1), tracker, **record, gate=gate).theta - [0.7, 2.0]).max(axis=1)
            cells.append(f"{away[begin + count + 19]:.3f}, {away[begin + count + 499]:.3f}")
        print(f"  {f'{code:g}, {count} in {where}, from {begin}':22}" + "".join(f"{cell:>16}" for cell in cells))


def coarse() -> None:
    """A flow of 32 +- 2 read in integers."""
    rng = np.random.default_rng(2)
    x = np.repeat(rng.normal(size=T // 20), 20)
    u = np.column_stack([x, np.ones(T)])
    y = np.round(u @ [2.0, 32.0] + 0.05 * rng.normal(size=T))
    print("\nWhole numbers, inputs that change every 20 samples (1 / sqrt 12 is 0.289)")
    print(f"  {'':24}{'innovation std':>16}{'y in band':>12}{'theta in band':>15}{'log-likelihood':>16}")
    for name, tracker, gate in (
        ("AdaptiveKalman", AdaptiveKalman(), None), ("AdaptiveKalman, no gate", AdaptiveKalman(), False),
        ("Bank()", Bank(), None), ("Bank(), no gate", Bank(), False), ("RLS(0.98), gate", FORGET, True),
        ("RLS(0.98), no gate", FORGET, False), ("Kalman, gate", WALK, True), ("Kalman, no gate", WALK, False),
    ):  # fmt: skip
        run, late = track(Regression(2), tracker, y, u, gate=gate), slice(200, None)
        inside = np.abs(run.innovation[late]) < 1.96 * run.innovation_std[late]
        covered = np.abs(run.theta[late] - [2.0, 32.0]) < 1.96 * run.std[late]
        print(
            f"  {name:24}{np.median(run.innovation_std[late]):>16.3f}{inside.mean():>12.2f}{covered.mean():>15.2f}"
            f"{run.loglik:>16.0f}"
        )


def arcs() -> None:
    """i = g u, with g alternating between 0.02 and 4."""
    print("\nA conductance that switches between 0.02 and 4: rms error of g u")
    names = ("AdaptiveKalman", "no gate", "RLS(0.998)", "RLS(0.98)", "Kalman")
    print(f"  {'half period':18}" + "".join(f"{name:>16}" for name in names))
    for half in (10, 25, 50, 100):
        arc = switching(half=half)
        u = np.column_stack([arc.u, np.random.default_rng(3).normal(size=len(arc.u))])
        trackers: list[Tracker] = [AdaptiveKalman(), AdaptiveKalman(), RLS(0.998), FORGET, WALK]
        gates = (None, False, None, None, None)
        runs: list[Track] = [
            track(Regression(2), one, arc.i, u, gate=gate) for one, gate in zip(trackers, gates, strict=True)
        ]
        cells = (rms(((run.theta[:, 0] - arc.g) * arc.u)[200:]) for run in runs)
        print(f"  {f'{half} samples':18}" + "".join(f"{cell:>16.2f}" for cell in cells))


def ignition() -> None:
    """An arc that conducts from 0.7 of the peak voltage on until it passes zero; a half period is 25 samples."""
    rng, t = np.random.default_rng(4), np.arange(T)
    u, g = np.sin(np.pi * t / 25.0), np.full(T, 0.02)
    for k in range(1, T):
        g[k] = 4.0 if abs(u[k]) > 0.7 or (g[k - 1] > 1.0 and u[k] * u[k - 1] > 0.0) else 0.02
    i, begins = g * u + 0.05 * rng.normal(size=T), np.append(False, np.diff(g) > 0.0)
    print("\nAn arc that ignites at 0.7 of the peak voltage: rms error of the prediction of i, one step ahead")
    print(f"  {'':24}{'all samples':>16}{'at ignition':>16}{'elsewhere':>16}")
    named: list[tuple[str, Tracker, bool | None]] = [("AdaptiveKalman", AdaptiveKalman(), None)]
    named += [("AdaptiveKalman, no gate", AdaptiveKalman(), False), ("RLS(0.998)", RLS(0.998), None)]
    for name, tracker, gate in [*named, ("RLS(0.98)", FORGET, None), ("Kalman", WALK, None)]:
        e = track(Regression(1), tracker, i, u[:, None], gate=gate).innovation[200:]
        cells = (rms(e), rms(e[begins[200:]]), rms(e[~begins[200:]]))
        print(f"  {name:24}" + "".join(f"{c:>16.2f}" for c in cells))


def smoothing() -> None:
    """Both parameters are random walks, in noise of standard deviation 0.3; 20 records of 500 samples."""
    print("\nParameters that walk, 20 records: rms error, and share of the truth in 95 % bands")
    print(f"  {'step':18}{'followed':>16}{'smoothed':>16}")
    for step, gate in [(step, gate) for step in (0.01, 0.03, 0.1) for gate in (None, False)]:
        found: list[list[float]] = []
        for seed in range(20):
            rng = np.random.default_rng(seed)
            u, theta = rng.normal(size=(500, 2)), 1.0 + np.cumsum(step * rng.normal(size=(500, 2)), axis=0)
            y = (u * theta).sum(axis=1) + 0.3 * rng.normal(size=500)
            run = track(Regression(2), AdaptiveKalman(), y, u, gate=gate)
            path, late = run.smooth(), slice(100, None)
            away, back = (run.theta - theta)[late], (path.theta - theta)[late]
            inside, covered = np.abs(away) < 1.96 * run.std[late], np.abs(back) < 1.96 * path.std[late]
            found.append([rms(away), float(inside.mean()), rms(back), float(covered.mean())])
        a, b, c, d = np.mean(found, axis=0)
        name = f"{step:g} a sample" if gate is None else "  no gate"
        print(f"  {name:18}{f'{a:.3f}, {b:.2f}':>16}{f'{c:.3f}, {d:.2f}':>16}")


def main() -> None:
    idle()
    codes()
    coarse()
    arcs()
    ignition()
    smoothing()


if __name__ == "__main__":
    main()

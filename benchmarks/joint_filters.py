"""Time of a sample of `JointKalman` and of filterpy's unscented filter, on the battery of examples/hidden_states.py.

    python benchmarks/joint_filters.py

The two unscented filters use the same points; the last column is the largest difference between their estimates, in
standard deviations.
"""

from __future__ import annotations

import time
from pathlib import Path
from runpy import run_path
from typing import Any

import numpy as np
from filterpy.kalman import JulierSigmaPoints, UnscentedKalmanFilter

from driftfit import JointKalman, Live, track

T = 1500


def theirs(model: Any, q: dict[str, float], r: float, p0: dict[str, float], y: Any, u: Any) -> tuple[Any, float]:
    """(estimates (T, n), seconds for each sample) of filterpy."""
    capacity, R1, R0, charge, v1 = (model.names.index(name) for name in ("capacity", "R1", "R0", "charge", "v1"))

    def fx(z: Any, dt: float, i: float) -> Any:
        z = z.copy()
        z[charge] -= 10 * i / 3600 / z[capacity]
        z[v1] += 10 * (z[R1] * i - z[v1]) / 60
        return z

    def hx(z: Any, i: float) -> Any:
        return np.array([3.2 + 0.5 * z[charge] + 0.4 * z[charge] ** 3 - z[R0] * i - z[v1]])

    n = model.n
    other = UnscentedKalmanFilter(n, 1, 1.0, hx, fx, JulierSigmaPoints(n, kappa=0.0))
    other.x, other.R = model.begins.copy(), np.array([[r]])
    other.P, other.Q = (np.diag([given.get(name, 0.0) for name in model.names]) for given in (p0, q))
    path, begin = np.empty((T, n)), time.perf_counter()
    for t in range(T):
        other.predict(i=u[t])
        other.update(y[t], i=u[t])
        path[t] = other.x
    return path, (time.perf_counter() - begin) / T


def best(work: Any, times: int = 5) -> float:
    """The shortest of several times, in seconds for each sample."""
    found = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        found.append((time.perf_counter() - begin) / T)
    return min(found)


def main() -> None:
    """Print the table."""
    battery = run_path(str(Path(__file__).parents[1] / "examples" / "hidden_states.py"), run_name="plants")["battery"]
    model, q, r, p0, y, u, _ = battery(np.random.default_rng(0))
    y, u = y[:T], u[:T]
    path, seconds = theirs(model, q, r, p0, y, u)
    print(f"{'us for each sample':30}{'live':>8}{'record':>8}{'filterpy / live':>18}{'difference':>12}")
    print(f"{'filterpy, unscented':30}{1e6 * seconds:8.1f}{'':8}{1:18.0f}")
    values, drives = y.tolist(), u.tolist()
    for method in ("unscented", "extended"):
        tracker = JointKalman(q=q, r=r, p0=p0, method=method)
        run = track(model, tracker, y, u)

        def stream(tracker: JointKalman = tracker) -> None:
            live = Live(model, tracker)
            for one, drive in zip(values, drives, strict=True):
                live.update(one, drive)

        stream()
        live, record = best(stream), best(lambda tracker=tracker: track(model, tracker, y, u))
        away = f"{np.nanmax(np.abs(path - run.theta) / run.std):12.0e}" if method == "unscented" else ""
        print(f"{'driftfit, ' + method:30}{1e6 * live:8.2f}{1e6 * record:8.2f}{seconds / live:18.0f}{away}")


if __name__ == "__main__":
    main()

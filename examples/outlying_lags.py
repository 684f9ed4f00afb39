"""Outliers of the sensor and of the plant in an ARX(2, 2) model, whose regressors remember both.

y_t = 1.2 y_{t-1} - 0.5 y_{t-2} + u_{t-1} + 0.5 u_{t-2} + v, with noise of standard deviation 0.3. Outliers are 3 to 9
standard deviations, in 3 % of the samples. The same tracker is given the lags as they were read (a `Regression` on
them), and as `ARX`, which doubts them; the bank has a hypothesis for each kind of outlier. Ten records, scored after
100 of 1000 samples: rms errors of theta, and of the prediction of what the plant does.

Prints the table of docs/real_sensors.md. Run: python examples/outlying_lags.py
"""

from __future__ import annotations

import numpy as np

from driftfit import ARX, AdaptiveKalman, Bank, Regression, Sensor, Track, track
from driftfit.extend import Array

T, NOISE, SEEDS = 1000, 0.3, 10
KINDS = ("none", "of the sensor", "of the plant", "of both", "t3 noise", "no outlier, jumps")
BOTH = [
    Sensor.nominal(prob=0.96),
    Sensor.outlier(kind="innovation", prob=0.02),
    Sensor.outlier(kind="additive", prob=0.02),
]


def simulate(kind: str, seed: int) -> tuple[Array, Array, Array, Array]:
    """y (T,), u (T,), theta (T, 4), and the output that the plant was expected to have (T,)."""
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=T), NOISE * rng.normal(size=T)
    if kind == "t3 noise":
        v = NOISE * rng.standard_t(3, size=T) / np.sqrt(3.0)
    theta = np.tile([1.2, -0.5, 1.0, 0.5], (T, 1))
    for k, at in enumerate((300, 600, 800) if "jumps" in kind else ()):
        theta[at:, 2] *= -0.6
        theta[at:, 0] += 0.1 * (-1.0) ** (k + 1)
    spikes = NOISE * rng.uniform(3.0, 9.0, T) * rng.choice([-1.0, 1.0], T) * (rng.random(T) < 0.03)
    share = {"of the sensor": 1.0, "of both": 0.5}.get(kind, 0.0)
    sensor = rng.random(T) < share
    v += spikes * ~sensor * (kind in ("of the plant", "of both"))
    x, expected = np.zeros(T), np.zeros(T)
    for t in range(2, T):
        expected[t] = theta[t] @ [x[t - 1], x[t - 2], u[t - 1], u[t - 2]]
        x[t] = expected[t] + v[t]
    return x + spikes * sensor, u, theta, expected


def runs(y: Array, u: Array) -> tuple[Track, ...]:
    past = np.column_stack([np.roll(one, k) for one in (y, u) for k in (1, 2)])
    past[:2] = np.nan
    raw = track(Regression(4), AdaptiveKalman(), y, past)
    return raw, track(ARX(2, 2), AdaptiveKalman(), y, u), track(ARX(2, 2), Bank(sensors=BOTH), y, u)


def main() -> None:
    print("Errors of theta and of the prediction, and coverage of the 95 % bands of theta")
    names = ("lags as read", "AdaptiveKalman", "Bank, both kinds")
    print(f"  {'outliers':18}" + "".join(f"{name:>21}" for name in names))
    for kind in KINDS:
        found: list[list[tuple[float, ...]]] = []
        for seed in range(SEEDS):
            y, u, theta, expected = simulate(kind, seed)
            scored: list[tuple[float, ...]] = []
            for run in runs(y, u):
                away, ahead = (run.theta - theta)[100:], (run.prediction - expected)[100:]
                inside = np.abs(away) < 1.96 * run.std[100:]
                scored.append((float(np.mean(away**2)), float(np.mean(ahead**2)), float(np.mean(inside))))
            found.append(scored)
        mean = np.mean(found, axis=0)
        cells = (f"{np.sqrt(a):.3f}, {np.sqrt(b):.2f}, {c:.2f}" for a, b, c in mean)
        print(f"  {kind:18}" + "".join(f"{cell:>21}" for cell in cells))


if __name__ == "__main__":
    main()

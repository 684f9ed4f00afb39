"""Nearly collinear regressors, a wide prior, and little noise: the digits of a bank.

Two regressors differ by a ten thousandth (P0 = 1e8, r = 1e-6, one parameter jumps by the known covariance). Prints the
largest error of the parameters relative to the same filter in fifty digits. Run: python examples/collinear.py
"""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np

from driftfit import Bank, Change, Regression, Sensor, track

T, JUMP, P0, R, Q = 200, 100, 1e8, 1e-6, 1.0


def record(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """y (T,) and regressors (T, 2)."""
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((T, 1)) + 1e-4 * rng.standard_normal((T, 2))
    theta = np.where(np.arange(T)[:, None] < JUMP, [1.0, 2.0], [1.5, 1.0])
    return (phi * theta).sum(axis=1) + np.sqrt(R) * rng.standard_normal(T), phi


def exact(y: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """The Kalman filter with the known jump, in fifty digits."""
    exactly = np.vectorize(Decimal, otypes=[object])
    path = []
    with localcontext() as context:
        context.prec = 50
        m, C = exactly(np.zeros(2)), exactly(P0 * np.eye(2))
        for t, (z, target) in enumerate(zip(exactly(phi), exactly(y), strict=True)):
            C = C + exactly(Q * np.eye(2)) if t == JUMP else C
            g = C @ z
            s = z @ g + Decimal(R)
            m, C = m + g * ((target - z @ m) / s), C - np.outer(g, g) / s
            path.append(m.astype(float))
    return np.array(path)


def main() -> None:
    prob = np.tile([1.0, 0.0], (T, 1))
    prob[JUMP] = 0.0, 1.0
    worst = 0.0
    for seed in range(5):
        y, phi = record(seed)
        bank = Bank([Change(0.0), Change(Q, prob=0.01)], [Sensor.nominal(R)], p0=P0)
        run, path = track(Regression(2), bank, y, phi, prob=prob), exact(y, phi)
        worst = max(worst, float(np.abs(run.theta - path)[5:].max() / np.abs(path).max()))
    print(f"largest relative error of the parameters: {worst:.0e}")


if __name__ == "__main__":
    main()

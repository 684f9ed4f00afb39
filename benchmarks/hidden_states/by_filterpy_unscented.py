"""Four plants with the unscented filter of filterpy: each function returns ``step(y, u)``, which returns the state.

The share of susceptible people in the epidemic is known at first; with its variance 0 the factorisation fails, so that
it is 1e-9.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from filterpy.kalman import JulierSigmaPoints, UnscentedKalmanFilter


def exchanger() -> Any:
    def hx(z: Any, u: Any) -> Any:
        return np.array([u[0] - (u[0] - u[1]) * np.exp(-z[0] / u[2])])

    ukf = UnscentedKalmanFilter(1, 1, 1.0, hx, lambda z, dt: z, JulierSigmaPoints(1, kappa=2.0))
    ukf.x = np.array([2.5])
    ukf.P, ukf.Q, ukf.R = np.eye(1), 2e-4 * np.eye(1), 0.25 * np.eye(1)

    def step(y: float, u: Any) -> Any:
        ukf.predict()
        ukf.update(y, u=u)
        return ukf.x

    return step


def battery() -> Any:
    def fx(z: Any, dt: float, i: float) -> Any:
        capacity, R1, R0, charge, v1 = z
        return np.array([capacity, R1, R0, charge - 10 * i / 3600 / capacity, v1 + 10 * (R1 * i - v1) / 60])

    def hx(z: Any, i: float) -> Any:
        return np.array([3.2 + 0.5 * z[3] + 0.4 * z[3] ** 3 - z[2] * i - z[4]])

    ukf = UnscentedKalmanFilter(5, 1, 1.0, hx, fx, JulierSigmaPoints(5, kappa=0.0))
    ukf.x = np.array([2.3, 0.03, 0.06, 0.5, 0.0])
    ukf.P = np.diag([0.25, 1e-4, 1e-3, 0.04, 1e-4])
    ukf.Q = np.diag([4e-6, 0.0, 1e-8, 0.0, 1e-8])
    ukf.R = np.array([[1e-4]])

    def step(y: float, i: float) -> Any:
        ukf.predict(i=i)
        ukf.update(y, i=i)
        return ukf.x

    return step


def epidemic() -> Any:
    def fx(z: Any, dt: float) -> Any:
        contact, s, li = z
        growth = contact * s - 0.15
        return np.array([contact, s - contact * s * np.exp(li), li + growth - 0.5 * growth**2])

    def hx(z: Any) -> Any:
        return np.array([np.log(1e6 * z[0] * z[1]) + z[2]])

    ukf = UnscentedKalmanFilter(3, 1, 1.0, hx, fx, JulierSigmaPoints(3, kappa=0.0))
    ukf.x = np.array([0.3, 1.0, -9.0])
    ukf.P, ukf.Q = np.diag([0.01, 1e-9, 1.0]), np.diag([1e-4, 0.0, 4e-4])
    ukf.R = np.array([[0.01]])

    def step(y: float, u: Any) -> Any:
        ukf.predict()
        ukf.update(y)
        return ukf.x

    return step


def vehicle() -> Any:
    def fx(z: Any, dt: float, u: Any) -> Any:
        drag, mass, v = z
        return np.array([drag, mass, v + (u[0] - drag * v * abs(v)) / mass - 9.81 * u[1]])

    def hx(z: Any) -> Any:
        return z[2:]

    ukf = UnscentedKalmanFilter(3, 1, 1.0, hx, fx, JulierSigmaPoints(3, kappa=0.0))
    ukf.x = np.array([0.004, 15.0, 15.0])
    ukf.P, ukf.Q = np.diag([1e-5, 25.0, 1.0]), np.diag([0.0, 0.02, 1e-4])
    ukf.R = np.array([[0.04]])

    def step(y: float, u: Any) -> Any:
        ukf.predict(u=u)
        ukf.update(y)
        return ukf.x

    return step

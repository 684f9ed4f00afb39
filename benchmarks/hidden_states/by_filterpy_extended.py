"""Four plants with the extended filter of filterpy, whose derivatives are written by hand; as by_filterpy_unscented."""

from __future__ import annotations

from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter


def exchanger() -> Any:
    ekf = ExtendedKalmanFilter(1, 1)
    ekf.x = np.array([2.5])
    ekf.P, ekf.Q, ekf.R = np.eye(1), 2e-4 * np.eye(1), 0.25 * np.eye(1)

    def step(y: float, u: Any) -> Any:
        steam, inlet, flow = u
        ekf.predict()
        ekf.update(
            np.array([y]),
            lambda z: np.array([[(steam - inlet) * np.exp(-z[0] / flow) / flow]]),
            lambda z: np.array([steam - (steam - inlet) * np.exp(-z[0] / flow)]),
        )
        return ekf.x

    return step


def battery() -> Any:
    class Cell(ExtendedKalmanFilter):
        def predict_x(self, i: float = 0.0) -> None:
            capacity, R1, _, charge, v1 = self.x
            self.F = np.eye(5)
            self.F[3, 0] = 10 * i / 3600 / capacity**2
            self.F[4, 1], self.F[4, 4] = 10 * i / 60, 1 - 10 / 60
            self.x = self.x.copy()
            self.x[3:] = charge - 10 * i / 3600 / capacity, v1 + 10 * (R1 * i - v1) / 60

    ekf = Cell(5, 1)
    ekf.x = np.array([2.3, 0.03, 0.06, 0.5, 0.0])
    ekf.P = np.diag([0.25, 1e-4, 1e-3, 0.04, 1e-4])
    ekf.Q = np.diag([4e-6, 0.0, 1e-8, 0.0, 1e-8])
    ekf.R = np.array([[1e-4]])

    def step(y: float, i: float) -> Any:
        ekf.predict(i)
        ekf.update(
            np.array([y]),
            lambda z: np.array([[0.0, 0.0, -i, 0.5 + 1.2 * z[3] ** 2, -1.0]]),
            lambda z: np.array([3.2 + 0.5 * z[3] + 0.4 * z[3] ** 3 - z[2] * i - z[4]]),
        )
        return ekf.x

    return step


def epidemic() -> Any:
    class Cases(ExtendedKalmanFilter):
        def predict_x(self, u: float = 0.0) -> None:
            contact, s, li = self.x
            i, growth = np.exp(li), contact * s - 0.15
            self.F = np.array(
                [
                    [1.0, 0.0, 0.0],
                    [-s * i, 1 - contact * i, -contact * s * i],
                    [s * (1 - growth), contact * (1 - growth), 1.0],
                ]
            )
            self.x = np.array([contact, s - contact * s * i, li + growth - 0.5 * growth**2])

    ekf = Cases(3, 1)
    ekf.x = np.array([0.3, 1.0, -9.0])
    ekf.P, ekf.Q = np.diag([0.01, 0.0, 1.0]), np.diag([1e-4, 0.0, 4e-4])
    ekf.R = np.array([[0.01]])

    def step(y: float, u: Any) -> Any:
        ekf.predict()
        ekf.update(
            np.array([y]),
            lambda z: np.array([[1 / z[0], 1 / z[1], 1.0]]),
            lambda z: np.array([np.log(1e6 * z[0] * z[1]) + z[2]]),
        )
        return ekf.x

    return step


def vehicle() -> Any:
    class Lorry(ExtendedKalmanFilter):
        def predict_x(self, u: Any = 0.0) -> None:
            drag, mass, v = self.x
            pull = u[0] - drag * v * abs(v)
            self.F = np.eye(3)
            self.F[2] = -v * abs(v) / mass, -pull / mass**2, 1 - 2 * drag * abs(v) / mass
            self.x = np.array([drag, mass, v + pull / mass - 9.81 * u[1]])

    ekf = Lorry(3, 1)
    ekf.x = np.array([0.004, 15.0, 15.0])
    ekf.P, ekf.Q = np.diag([1e-5, 25.0, 1.0]), np.diag([0.0, 0.02, 1e-4])
    ekf.R = np.array([[0.04]])

    def step(y: float, u: Any) -> Any:
        ekf.predict(u)
        ekf.update(np.array([y]), lambda z: np.array([[0.0, 0.0, 1.0]]), lambda z: z[2:])
        return ekf.x

    return step

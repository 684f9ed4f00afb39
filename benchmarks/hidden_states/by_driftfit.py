"""Four plants with driftfit: each function returns the model, and the settings that all trackers of it share."""

from __future__ import annotations

from typing import Any

from driftfit import StateSpace


def exchanger() -> tuple[Any, dict[str, Any]]:
    model = StateSpace("outlet = steam - (steam - inlet) * exp(-theta.UA / flow)", start={"UA": 2.5})
    return model, {"q": {"UA": 2e-4}, "r": 0.25, "p0": {"UA": 1.0}}


def battery() -> tuple[Any, dict[str, Any]]:
    model = StateSpace(
        """
        charge = charge[-1] - 10 * dt * i / 3600 / theta.capacity
        v1 = v1[-1] + 10 * dt * (theta.R1 * i - v1[-1]) / 60
        v = 3.2 + 0.5 * charge + 0.4 * charge ** 3 - theta.R0 * i - v1
        """,
        start={"charge": 0.5, "capacity": 2.3, "R1": 0.03, "R0": 0.06},
    )
    p0 = {"charge": 0.04, "capacity": 0.25, "R1": 1e-4, "R0": 1e-3, "v1": 1e-4}
    return model, {"q": {"capacity": 4e-6, "R0": 1e-8, "v1": 1e-8}, "r": 1e-4, "p0": p0}


def epidemic() -> tuple[Any, dict[str, Any]]:
    model = StateSpace(
        """
        s = s[-1] - theta.contact * s[-1] * exp(li[-1])
        li = li[-1] + theta.contact * s[-1] - 0.15 - 0.5 * (theta.contact * s[-1] - 0.15) ** 2
        cases = log(1e6 * theta.contact * s) + li
        """,
        start={"contact": 0.3, "s": 1.0, "li": -9.0},
    )
    return model, {"q": {"contact": 1e-4, "li": 4e-4}, "r": 0.01, "p0": {"contact": 0.01, "li": 1.0}}


def vehicle() -> tuple[Any, dict[str, Any]]:
    model = StateSpace(
        """
        v = v[-1] + dt * ((force - theta.drag * v[-1] * abs(v[-1])) / theta.mass - 9.81 * slope)
        speed = v
        """,
        start={"mass": 15.0, "drag": 0.004, "v": 15.0},
        inputs=["force", "slope"],
    )
    return model, {"q": {"mass": 0.02, "v": 1e-4}, "r": 0.04, "p0": {"mass": 25.0, "drag": 1e-5, "v": 1.0}}

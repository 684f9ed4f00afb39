"""Share of 95 % bands that cover the true parameters at the end of a record, where the model is true.

    python benchmarks/coverage_of_models.py [--quick]    with --quick the first row alone

Parameters are constant for trackers that assume so, and walk for filters, with the variances that the filter is given.
A share of 800 parameters has a standard error of .008; those of a record are not independent.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy import signal

from driftfit import (
    ARMAX,
    ARX,
    OE,
    RLS,
    AdaptiveKalman,
    BoxJenkins,
    ContinuousTransfer,
    DynamicGLM,
    Equation,
    InstrumentalVariables,
    JointKalman,
    Kalman,
    ParticleFilter,
    Regression,
    StateSpace,
    track,
)

T, RECORDS, H, Q = 1000, 200, 0.1, 1e-4
HIDDEN = StateSpace("x = 0.8 * x[-1] + theta.b * u[-1] \n y = x + theta.c", start={"b": 1.0, "c": 0.0})
GIVEN = {"q": {"b": Q, "c": Q, "x": 1e-3}, "r": 0.01, "p0": {"b": 0.25, "c": 0.25, "x": 0.25}}


def linear(rng: np.random.Generator, noise: Any) -> tuple[Any, Any]:
    """y and u of z / (1 - 0.8 z), in noise that is filtered by ``noise``."""
    u, e = rng.normal(size=T), 0.5 * rng.normal(size=T)
    return signal.lfilter([0.0, 1.0], [1.0, -0.8], u) + signal.lfilter(*noise, e), u


def walk(rng: np.random.Generator, start: float) -> Any:
    """A parameter that drifts by Q."""
    return start + np.cumsum(np.sqrt(Q) * rng.normal(size=T))


def of_equation(rng: np.random.Generator) -> tuple[Any, Any, list[float]]:
    k, u = walk(rng, 2.0), rng.normal(size=T)
    return k * np.tanh(0.8 * u) + 0.1 * rng.normal(size=T), u, [float(k[-1])]


def of_states(rng: np.random.Generator) -> tuple[Any, Any, list[float]]:
    b, c, x = walk(rng, 1.0 + 0.5 * rng.normal()), walk(rng, 0.5 * rng.normal()), np.zeros(T)
    u, x[0] = rng.normal(size=T), 0.5 * rng.normal()
    for t in range(1, T):
        x[t] = 0.8 * x[t - 1] + b[t - 1] * u[t - 1] + np.sqrt(1e-3) * rng.normal()
    return x + c + 0.1 * rng.normal(size=T), u, [float(b[-1]), float(c[-1])]


def of_counts(rng: np.random.Generator) -> tuple[Any, Any, list[float]]:
    b, u = walk(rng, 0.5), rng.normal(size=T)
    return rng.poisson(np.exp(b * u)).astype(float), u, [float(b[-1])]


def of_continuous(rng: np.random.Generator) -> tuple[Any, Any, list[float]]:
    """1 / (s + 0.5), held inputs."""
    u, fall = np.repeat(rng.choice([-1.0, 1.0], T // 10), 10), np.exp(-0.5 * H)
    return signal.lfilter([0.0, 2.0 * (1.0 - fall)], [1.0, -fall], u) + 0.1 * rng.normal(size=T), u, [0.5, 1.0]


def plant(noise: Any, truth: list[float]) -> Any:
    return lambda rng: (*linear(rng, noise), truth)


ARX_NOISE, WHITE, BOX = ([1.0], [1.0, -0.8]), ([1.0], [1.0]), ([1.0, 0.5], [1.0, -0.9])
EQUATION = Equation("y = theta.k * tanh(0.8 * u)")
ROWS: list[tuple[str, Any, Any, Any]] = [
    ("ARX, RLS", ARX(1, 1), RLS(1.0), plant(ARX_NOISE, [0.8, 1.0])),
    ("ARMAX, RLS", ARMAX(1, 1, 1), RLS(1.0), plant(([1.0, 0.5], [1.0, -0.8]), [0.8, 1.0, 0.5])),
    ("OE, RLS", OE(1, 1), RLS(1.0), plant(WHITE, [1.0, 0.8])),
    ("OE, InstrumentalVariables", OE(1, 1), InstrumentalVariables(1.0), plant(WHITE, [1.0, 0.8])),
    ("BoxJenkins, RLS", BoxJenkins(1, 1, 1, 1), RLS(1.0), plant(BOX, [1.0, 0.5, 0.9, 0.8])),
    ("BoxJenkins, InstrumentalVariables", BoxJenkins(1, 1, 1, 1), InstrumentalVariables(1.0),
     plant(BOX, [1.0, 0.5, 0.9, 0.8])),
    ("ContinuousTransfer, RLS", ContinuousTransfer(1, dt=H), RLS(1.0), of_continuous),
    ("Equation, Kalman", EQUATION, Kalman(q=Q, r=0.01), of_equation),
    ("Equation, AdaptiveKalman", EQUATION, AdaptiveKalman(), of_equation),
    ("StateSpace, JointKalman", HIDDEN, JointKalman(**GIVEN), of_states),
    ("StateSpace, ParticleFilter of 100", HIDDEN, ParticleFilter(100, **GIVEN), of_states),
    ("StateSpace, ParticleFilter of 500", HIDDEN, ParticleFilter(500, **GIVEN), of_states),
    ("Poisson counts, DynamicGLM", Regression(1), DynamicGLM("poisson", q=Q, p0=1.0), of_counts),
]  # fmt: skip


def main() -> None:
    """Print the table."""
    print(f"{'':36}{'parameters':>11}{'in band':>9}")
    for name, model, tracker, record in ROWS[: 1 if "--quick" in sys.argv else None]:
        inside: list[Any] = []
        records = RECORDS // (4 if "Particle" in name else 1)
        for seed in range(records):
            y, u, truth = record(np.random.default_rng(seed))
            run = track(model, tracker, y, u)
            n = len(truth)
            inside += (np.abs(run.theta[-1, :n] - truth) < 1.96 * run.std[-1, :n]).tolist()
        print(f"{name:36}{len(inside):11}{np.mean(inside):9.2f}", flush=True)


if __name__ == "__main__":
    main()

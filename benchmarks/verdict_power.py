"""How often a change is found at a level of 5 % in noise that is correlated, beside how often it is said wrongly.

Two models: a regression on two inputs and an intercept, and ARX(1, 1). Inputs are white, or autoregressions with 0.8;
the noise is an autoregression with 0.9, and of variance 1. The first input's coefficient is 1; *jump* is its change
half-way, in deviations of the noise.

Run: python benchmarks/verdict_power.py [records per cell, 200 by default] [--quick]
"""

from __future__ import annotations

import sys

import numpy as np
from scipy import signal

from driftfit.engine.kernel import Array
from driftfit.judge.statistics.constancy import constancy

LEVEL, RHO, BEFORE = 0.05, 0.9, 300
LENGTHS, JUMPS = (80, 300, 1000), (0.0, 0.3, 0.6, 1.0)


def correlated(rng: np.random.Generator, rho: float, *shape: int) -> Array:
    """An autoregression of variance 1 along the last axis."""
    e = rng.normal(size=(*shape[:-1], shape[-1] + BEFORE))
    return signal.lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], e)[..., BEFORE:]  # type: ignore[no-any-return]


def record(model: str, inputs: str, T: int, jump: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Regressors and output."""
    e, u = correlated(rng, RHO, T), correlated(rng, 0.0 if inputs == "white" else 0.8, 2, T)
    gain = 1.0 + jump * (np.arange(T) >= T // 2)
    if model == "regression":
        return np.column_stack([*u, np.ones(T)]), gain * u[0] - u[1] + e
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.8 * y[t - 1] + gain[t] * u[0, t - 1] + e[t]
    return np.column_stack([y[:-1], u[0, :-1]]), y[1:]


def main(records: int = 200, lengths: tuple[int, ...] = LENGTHS) -> None:
    print(f"Said to move, % of {records} records, noise AR({RHO:g})")
    print(f"{'':34}{'T':>5}" + "".join(f"{f'jump {jump:g}' if jump else 'constant':>10}" for jump in JUMPS))
    for model in ("regression", "ARX(1, 1)"):
        for inputs in ("white", "AR(0.8)"):
            for T in lengths:
                cells = []
                for jump in JUMPS:
                    rng = np.random.default_rng([T, *model.encode(), *inputs.encode(), int(100 * jump)])
                    p = [constancy(*record(model, inputs, T, jump, rng)).p_joint for _ in range(records)]
                    cells.append(f"{100.0 * np.mean(np.array(p) < LEVEL):10.0f}")
                print(f"{f'{model}, inputs {inputs}':34}{T:5}" + "".join(cells), flush=True)


if __name__ == "__main__":
    if "--quick" in sys.argv:
        main(3, (80,))
    else:
        main(*map(int, sys.argv[1:2]))

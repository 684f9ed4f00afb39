"""Equations of one's own: a heat exchanger that fouls, and a vehicle whose load and drag change.

Prints the error of each parameter beside that of the best constant value, which knows the whole path, and how often the
bands cover. Run: python examples/equations.py [picture.png]
"""

import sys
from collections.abc import Callable

import numpy as np
import pandas as pd

from driftfit import AdaptiveKalman, Equation, track

T = 1500


def exchanger(rng: np.random.Generator) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """UA falls from 3 to 2 kW/K while the wall fouls, and is 3 again after it has been cleaned."""
    UA = np.interp(np.arange(T), [300, 1000], [3.0, 2.0])
    UA[1100:] = 3.0
    inlet, steam, flow = 20.0 + rng.normal(size=T), 120.0 + 2.0 * rng.normal(size=T), rng.uniform(1.0, 4.0, T)
    outlet = steam - (steam - inlet) * np.exp(-UA / flow) + 0.5 * rng.normal(size=T)
    return pd.DataFrame({"outlet": outlet, "inlet": inlet, "steam": steam, "flow": flow}), {"UA": UA}


def vehicle(rng: np.random.Generator) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Tonnes and drag: 4 t are loaded at sample 500, and a tarpaulin opens at 1000."""
    t = np.arange(T)
    m, d = np.where(t < 500, 12.0, 16.0), np.where(t < 1000, 3.0, 4.5)
    v = 15.0 + 6.0 * np.sin(t / 40.0) + np.cumsum(rng.normal(size=T)) / 30.0
    a = 0.4 * np.sin(t / 9.0) + 0.2 * rng.normal(size=T)
    force = m * a + d * (v / 10.0) ** 2 + 0.8 + 0.5 * rng.normal(size=T)
    return pd.DataFrame({"force": force, "a": a, "v": v}), {"m": m, "d": d}


PLANTS: dict[str, tuple[Callable, str]] = {
    "heat exchanger": (exchanger, "outlet = steam - (steam - inlet) * exp(-theta.UA / flow)"),
    "vehicle": (vehicle, "force = theta.m * a + theta.d * (v / 10) ** 2 + theta.r"),
}


def main(picture: str | None = None) -> None:
    print(f"{'':16} {'':4}  constant  tracked   in band")
    for name, (plant, text) in PLANTS.items():
        model = Equation(text)
        data, truth = plant(np.random.default_rng(0))
        run = track(model, AdaptiveKalman(), model.formula.output, list(model.input_names), data=data)
        for parameter, path in truth.items():
            k = run.names.index(parameter)
            found, std = run.theta[50:, k], run.std[50:, k]
            best = np.mean(path[50:])
            errors = [np.sqrt(np.mean((one - path[50:]) ** 2)) for one in (best, found)]
            inside = np.mean(np.abs(found - path[50:]) < 1.96 * std)
            print(f"{name:16} {parameter:4} {errors[0]:9.3f} {errors[1]:8.3f} {inside:9.2f}")
        if picture is not None and name == "heat exchanger":
            run.plot().savefig(picture)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)

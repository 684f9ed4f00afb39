"""Three plants in coloured noise: what least squares, instruments and prediction errors make of them.

Prints the medians over 40 records of the largest error of a plant parameter and of the error of the static gain, and
how often the bands cover. Run: python examples/coloured_noise.py
"""

import numpy as np
from scipy import signal

from driftfit import ARMAX, ARX, OE, RLS, AdaptiveKalman, BoxJenkins, InstrumentalVariables, Model, Tracker, track

A, B = np.array([1.0, -1.5, 0.7]), np.array([0.0, 1.0, 0.5])
TRUTH = {"a1": 1.5, "a2": -0.7, "f1": 1.5, "f2": -0.7, "b1": 1.0, "b2": 0.5}
PLANTS = {
    "ARMAX: noise (1 - z + 0.2 z^2) / A": (([1.0, -1.0, 0.2], A), ARMAX(2, 2, 2)),
    "output error: white noise": (([1.0], [1.0]), OE(2, 2)),
    "Box-Jenkins: noise (1 + 0.5 z) / (1 - 0.9 z)": (([1.0, 0.5], [1.0, -0.9]), BoxJenkins(2, 1, 1, 2)),
}
RECORDS, T = 40, 1500


def record(noise: tuple, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=T), 0.7 * rng.normal(size=T)
    return signal.lfilter(B, A, u) + signal.lfilter(*noise, e), u


def judged(model: Model, tracker: Tracker, noise: tuple) -> tuple[float, float, float]:
    """Medians of the largest error and of the relative error of the gain, and the share of bands that cover."""
    errors, gains, inside = [], [], []
    for seed in range(RECORDS):
        run = track(model, tracker, *record(noise, seed))
        which = [i for i, name in enumerate(run.names) if name in TRUTH]
        values, std = run.theta[-1][which], run.std[-1][which]
        truth = np.array([TRUTH[run.names[i]] for i in which])
        lags = np.array([run.names[i][0] in "af" for i in which])
        errors.append(np.abs(values - truth).max())
        gains.append(abs(values[~lags].sum() / (1.0 - values[lags].sum()) / 7.5 - 1.0))
        inside.append(np.abs(values - truth) < 1.96 * std)
    return float(np.median(errors)), float(np.median(gains)), float(np.mean(inside))


def main() -> None:
    for name, (noise, model) in PLANTS.items():
        print(f"{name:46}   error    gain   in band")
        rows = (
            ("ARX(2, 2), RLS(1.0)", ARX(2, 2), RLS(1.0)),
            ("ARX(2, 2), InstrumentalVariables(1.0)", ARX(2, 2), InstrumentalVariables(1.0)),
            (f"{type(model).__name__}, RLS(1.0)", model, RLS(1.0)),
            (f"{type(model).__name__}, AdaptiveKalman()", model, AdaptiveKalman()),
        )
        for label, one, tracker in rows:
            error, gain, inside = judged(one, tracker, noise)
            print(f"  {label:44} {error:7.3f} {gain:7.1%} {inside:8.2f}")


if __name__ == "__main__":
    main()

"""Two peaks: the growth model of Gordon, Salmond and Smith (1993), whose output does not know the sign of its state.

The root mean square error of the state over eight records of 300 samples, the share of its 95 % bands that cover, the
error of b, which is 1.5, and the mean log-likelihood of a sample.
"""

import numpy as np

from driftfit import JointKalman, ParticleFilter, StateSpace, track

MODEL = StateSpace(
    "x = 0.5 * x[-1] + 25 * x[-1] / (1 + x[-1] ** 2) + 8 * cos(1.2 * clock) \n y = x * x / 20 + theta.b * u",
    start={"b": 0.0},
)
VARIANCES = {"q": {"b": 1e-4, "x": 10.0}, "r": 1.0, "p0": {"b": 4.0, "x": 5.0}}
TRACKERS = {
    "JointKalman, extended": JointKalman(**VARIANCES, method="extended"),
    "JointKalman, unscented": JointKalman(**VARIANCES),
    "ParticleFilter, 100": ParticleFilter(100, **VARIANCES),
    "ParticleFilter, 500": ParticleFilter(500, **VARIANCES),
}


def record(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """y, u and the state."""
    rng = np.random.default_rng(seed)
    u, x, states, y = rng.normal(size=300), 0.0, np.zeros(300), np.zeros(300)
    for t in range(300):
        x = 0.5 * x + 25.0 * x / (1.0 + x * x) + 8.0 * np.cos(1.2 * t) + np.sqrt(10.0) * rng.normal()
        states[t], y[t] = x, x * x / 20.0 + 1.5 * u[t] + rng.normal()
    return y, u, states


def main() -> None:
    """Print the table."""
    print(f"{'':24}{'error of x':>12}{'in band':>10}{'error of b':>12}{'loglik':>10}")
    for name, tracker in TRACKERS.items():
        errors, inside, of_b, fits = [], [], [], []
        for seed in range(8):
            y, u, x = record(seed)
            run = track(MODEL, tracker, y, u)
            errors.append(run.theta[:, 1] - x)
            inside.append(np.abs(errors[-1]) < 1.96 * run.std[:, 1])
            of_b.append(run.theta[-1, 0] - 1.5)
            fits.append(run.loglik / 300)
        size, of_b = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(of_b)))
        print(f"{name:24}{size:12.2f}{np.mean(inside):10.2f}{of_b:12.2f}{np.mean(fits):10.2f}")


if __name__ == "__main__":
    main()

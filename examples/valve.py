"""A valve that closes: pressure drives flow, and the gain of the path falls while the record runs.

Prints the summary of a tracked run and saves its picture. Run: python examples/valve.py [picture.png]
"""

import sys

import numpy as np

from driftfit import ARX, Kalman, track


def simulate(T: int = 600, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """flow_t = 0.7 flow_{t-1} + gain_t pressure_{t-1} + noise, the gain falling from 1 to 0.4 within 100 samples."""
    rng = np.random.default_rng(seed)
    gain = np.interp(np.arange(T), [250, 350], [1.0, 0.4])
    pressure = 2.0 + 0.5 * np.cumsum(rng.normal(size=T)) / np.sqrt(1.0 + np.arange(T)) + 0.3 * rng.normal(size=T)
    flow = np.zeros(T)
    for t in range(1, T):
        flow[t] = 0.7 * flow[t - 1] + gain[t] * pressure[t - 1] + 0.05 * rng.normal()
    flow[100:103] = np.nan  # a sensor that fails for three samples
    return flow, pressure, gain


def main(picture: str | None = None) -> None:
    flow, pressure, gain = simulate()
    run = track(ARX(na=1, nb=1, inputs=["pressure"]), Kalman(q=[0.0, 1e-4], r=0.0025), flow, pressure)
    print(run.summary())
    error = run.theta[50:, 1] - gain[50:]
    print(f"error of the gain after 50 samples (rms): {np.sqrt(np.mean(error**2)):.3f}")
    if picture:
        run.plot().savefig(picture, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:2])

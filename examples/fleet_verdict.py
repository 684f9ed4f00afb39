"""Verdict over many series at once: thirty simulated pumps, in six of which the gain of the pressure falls.

Run: python examples/fleet_verdict.py [page.html, which then is written]
"""

import sys

import numpy as np

from driftfit import ARX, Kalman, track

PUMPS, T, WORN = 30, 400, (4, 9, 13, 18, 22, 27)


def record(rng: np.random.Generator, wear: float) -> tuple[np.ndarray, np.ndarray]:
    """Flow of a first-order loop, whose gain falls by ``wear`` in the second half."""
    u, v = rng.normal(size=T), 0.1 * rng.normal(size=T)
    gain = 1.0 - wear * np.clip((np.arange(T) - 200) / 100, 0.0, 1.0)
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.6 * y[t - 1] + gain[t] * u[t - 1] + v[t]
    return y, u


def table() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    parts = [(f"pump {k:02d}", *record(rng, 0.15 if k in WORN else 0.0)) for k in range(PUMPS)]
    return {
        "pump": np.repeat([name for name, *_ in parts], T),
        "t": np.tile(np.arange(T), PUMPS),
        "flow": np.concatenate([y for _, y, _ in parts]),
        "pressure": np.concatenate([u for *_, u in parts]),
    }


if __name__ == "__main__":
    import polars as pl

    fleet = track(
        ARX(1, 1), Kalman(q=1e-5, r=0.01), y="flow", u="pressure", data=pl.DataFrame(table()), time="t", by="pump"
    )
    print(fleet.verdict())
    if len(sys.argv) > 1:
        print(fleet.diagnose())
        fleet.report(sys.argv[1], "Thirty pumps")

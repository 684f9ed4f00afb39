"""Records to track, and ways to run them, shared by the tests.

Compiled combinations are what costs time, so the tests share them: ARX(2, 2) (n = 4), ARX(1, 1) (n = 2) and
Regression(1) (n = 1), in tiles of one lane or of a fleet's width.
"""

import numpy as np

from driftfit.engine.drivers import drivers
from driftfit.engine.tiles import make_tile, output_type

BAD = (np.nan, np.inf, -np.inf, 1e200, -1e200)
THETA = np.array([1.2, -0.5, 1.0, 0.4])


def arx_record(T, seed=0, noise=0.1, theta=THETA):
    """y, u of a stable ARX(2, 2) with parameters ``theta``, one vector or one per sample."""
    rng = np.random.default_rng(seed)
    u, v = rng.standard_normal(T), noise * rng.standard_normal(T)
    path = np.broadcast_to(theta, (T, 4)).tolist()
    y, drive, error = [0.0, 0.0], [0.0, 0.0, *u.tolist()], v.tolist()
    for t, (a1, a2, b1, b2) in enumerate(path):
        y.append(a1 * y[-1] + a2 * y[-2] + b1 * drive[t + 1] + b2 * drive[t] + error[t])
    return np.array(y[2:]), u


def damaged(y, u, seed=0, share=0.08):
    """Copies with bad values sprinkled over both, and an outage of ten outputs in the middle."""
    rng = np.random.default_rng(seed)
    y, u = y.copy(), u.copy()
    for signal in (y, u):
        hit = rng.random(len(signal)) < share
        signal[hit] = rng.choice(BAD, hit.sum())
    y[len(y) // 2 : len(y) // 2 + 10] = np.nan
    return y, u


def run_lanes(model, trackers, y, u, known):
    """Drive a tile with one lane per tracker over y (T, L), u (T, m, L), known (T, 3, L); returns (out, tile)."""
    steps = trackers[0].steps_for(model)
    memory, own = model.fitted_to(steps)
    tile = make_tile(model.n, model.m, memory, [tracker.state_for(model) for tracker in trackers])
    out = np.empty(len(y), output_type(tile, trackers[0].outputs))
    drivers(own, steps).run(tile, y, u, known, out)
    return out, tile


def same(a, b):
    """Equal bit for bit, NaN being equal to NaN."""
    return np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)


def rows_of(text):
    """The words of each line of a printed table."""
    return [line.split() for line in str(text).splitlines() if line.split()]

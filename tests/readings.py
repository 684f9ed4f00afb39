"""A record with one bad reading at every position: what a tracker and a model make of it, as a fleet."""

import numpy as np
from support import arx_record

from driftfit import track

VALUES = (
    1e-320, 1e-300, 1e-200, 1e-160, 1e-100, 1e-80, 1e-50, -1e-40, 1e-37, 1e-20, 0.0, -3e4, -1e5, 1e7, 1e10, 1e20,
    -1e30, 1e37, 1e40, -1e60, 1e80, 1e99, 1e101, 1e155, -1e200, 1e308, np.nan, np.inf, -np.inf,
)  # fmt: skip
AFTER = 100
"""Samples by which a run must have recovered."""


def records(T, positions, values=VALUES):
    """y and u (units, T), the place and the value of each unit, and whether it is y that is bad; the first is whole."""
    y, u = arx_record(T, 3)
    cases = [(t, value, in_y) for t in positions for value in values for in_y in (True, False)]
    Y, U = np.tile(y, (len(cases) + 1, 1)), np.tile(u, (len(cases) + 1, 1))
    for k, (t, value, in_y) in enumerate(cases, 1):
        (Y if in_y else U)[k, t] = value
    return Y, U, cases


def failures(model, tracker, positions, T, values=VALUES, at_once=None, gate=None):
    """What went wrong, a line for each record: (place, value, signal, what).

    Records run side by side in lanes, or few at a time one after another, which compiles less.
    """
    Y, U, cases = records(T, positions, values)
    at_once = at_once or len(Y)
    fleets = [
        track(model, tracker, Y[k : k + at_once], U[k : k + at_once], by="row", gate=gate)
        for k in range(0, len(Y), at_once)
    ]
    found = []
    for k, (t, value, in_y) in enumerate(cases, 1):
        run = fleets[k // at_once][k % at_once]
        s, ok = run.innovation_std, run.ok
        wrong = []
        if not np.isfinite(run.theta).all():
            wrong.append("theta is not finite")
        if not (np.isfinite(run.innovation[ok]).all() and np.isfinite(run.prediction[ok]).all()):
            wrong.append("a used sample has no innovation")
        if tracker.covariance and (s[ok] < 0.0).any():
            wrong.append("a negative variance")
        late = slice(t + AFTER, None)
        if not ok[late].all():
            wrong.append("samples after it are left out")
        if tracker.covariance and not (np.isfinite(run.std[late]).all() and np.isfinite(s[late]).all()):
            wrong.append("no variances after it")
        found += [(t, value, "y" if in_y else "u", what) for what in wrong]
    return found, len(cases)

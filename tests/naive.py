"""Slow and obvious twins of the drifts of `AdaptiveKalman`, in plain NumPy."""

import numpy as np

from driftfit.trackers.parts.modes.drifts.about_means import STILL
from driftfit.trackers.parts.modes.drifts.trend import FADING, GROWN, LOST, SHORTEST


def walks(lane):
    """Drift covariances (K, n, n) of the filters of `AdaptiveKalman` in a nominal interval."""
    unit, first = np.sqrt(lane["c"]), int(lane["first_along"])
    found = lane["r"] * np.array([np.diag(ratio) for ratio in lane["ratio"].T])
    for j, ratio in enumerate(lane["along"]):
        found[first + j] += lane["r"] * ratio * np.outer(lane["direction"], lane["direction"])
    found /= np.outer(unit, unit)
    mean, variance, first = lane["mean"], lane["variance"], int(lane["first_about"])
    constant = np.flatnonzero((mean != 0.0) & (variance <= STILL * lane["c"]))
    own, away = lane["c"].copy(), np.eye(len(mean))
    if len(constant):
        k = constant[-1]
        others = np.arange(len(mean)) != k
        own[others] = variance[others]
        away[k, others] = -mean[others] / mean[k]
    inverse = np.divide(1.0, own, out=np.zeros(len(own)), where=own > STILL * lane["c"])
    for j, ratio in enumerate(lane["about"]):
        found[first + j] = lane["r"] * ratio * (away * inverse) @ away.T
    return found


def moved_along(lane, walked, time=1.0):
    """Means (n, K) of the filters of `AdaptiveKalman` after an interval; ``walked`` (n, K) is what it adds to C_ii."""
    m, memory = lane["m"].copy(), time / np.sqrt(max(float(lane["apart"]), SHORTEST))
    for j, bend in enumerate(lane["bend"]):
        k = int(lane["trend"]) + j
        variance = np.maximum(np.diagonal(lane["C"][..., k]) + walked[:, k], 1e-300)
        fading = FADING + LOST * (1.0 - np.minimum(1.0, GROWN * lane["corrected"][:, j] / variance))
        m[:, k] += lane["slopes"][:, j] * time * (1.0 / (1.0 + 0.5 * bend * fading * memory))
    return m

"""A slow and obvious twin of one sample of `AdaptiveKalman`, in plain NumPy, from the fields of a stream."""

import numpy as np
from scipy import stats

from driftfit.trackers.mixture import filters
from driftfit.trackers.mixture.filters import COMMON, FIRST_ALONE, FIRST_LEARNED, FLOOR, JUMPS, OUTLYING


def full(lower):
    """A symmetric matrix (n, n, ..) from its lower triangle."""
    other = np.swapaxes(lower, 0, 1)
    return np.where(np.tri(len(lower), dtype=bool).reshape(lower.shape[:2] + (1,) * (lower.ndim - 2)), lower, other)


def walks(lane, jump=JUMPS):
    """Drift covariances (K, n, n) of the modes in a nominal interval, in units of theta; ``jump`` is that of jumps."""
    n, c = len(lane["c"]), lane["c"]
    rho = lane["r"] * np.where(lane["ratio"] == JUMPS, jump, lane["ratio"])
    mean, v, away = lane["mean"], lane["variance"], np.eye(n)
    moving = v > filters.STILL * c
    constant = np.flatnonzero(~moving & (mean != 0.0))[-1:]
    centred = moving & (c > (1.0 + filters.FAR) * v) & (len(constant) > 0)
    away[constant] -= np.where(centred, mean / mean[constant, None], 0.0)
    common = (away / np.where(centred, v, np.where(c > 0.0, c, np.inf))) @ away.T
    a = np.divide(lane["sums"][filters.DIRECTION], np.sqrt(c), out=np.zeros(n), where=c > 0.0)
    inverse = np.divide(1.0, c, out=np.zeros(n), where=c > 0.0)
    learned = np.diag(lane["sums"][filters.WEIGHT] * inverse) + FLOOR * common + np.outer(a, a)
    Q = np.zeros((len(rho), n, n))
    Q[:FIRST_LEARNED], Q[FIRST_LEARNED:FIRST_ALONE] = common, learned
    for i, (first, end) in enumerate(lane["alone"].T):
        Q[first:end, i, i] = inverse[i]
    return rho[:, None, None] * Q


def moved_along(lane, time=1.0):
    """Means (n, K) after an interval."""
    m = lane["m"].copy()
    m[:, len(COMMON) : FIRST_LEARNED] += time * lane["trend"]
    return m


def before(lane, phi, jump=JUMPS):
    """x, means (n, K), covariances (K, n, n) and variances (3,) of the noise before a sample."""
    S, r = lane["S"], lane["r"]
    C = np.moveaxis(full(lane["C"]), -1, 0) + S @ walks(lane, jump) @ S.T
    v = lane["noise"] * np.array([r, max(lane["restless"], filters.LEAST_RESTLESS * r), filters.LARGE * r])
    return np.linalg.solve(S.T, phi), moved_along(lane), C, v


def expected(lane, phi):
    """Prediction, and its variance if nothing unusual happens."""
    x, m, C, v = before(lane, phi)
    jump, mean, restless = lane["ratio"] == JUMPS, x @ m @ lane["mu"], states(lane)[1] / (1.0 - states(lane)[2])
    of = np.einsum("i,kij,j->k", x, C, x) + (x @ m - mean) ** 2
    usual, wide = (np.average(of[which], weights=lane["mu"][which]) for which in (~jump, jump))
    noise, p = v[0] ** (1.0 - restless) * v[1] ** restless, lane["mu"][jump].sum()
    return mean, (noise + usual) ** (1.0 - p) * (noise + wide) ** p


def after_jump(lane, phi, y):
    """The same as `before`, with jumps as large as an unusual innovation."""
    mean, variance = expected(lane, phi)
    square = (y - mean) ** 2 * ((y - mean) ** 2 > filters.LARGE * variance)
    return before(lane, phi, max(JUMPS, min(lane["power"], square / lane["noise"]) / lane["r"]))


def states(lane):
    """Probabilities (3,) of the states of the noise before a sample."""
    (quiet, restless, _), o = lane["nu"], lane["nu_prior"][OUTLYING]
    usual = np.array([[filters.STAY, 1.0 - filters.STAY], [1.0 - filters.CALM, filters.CALM]])
    return np.append((1.0 - o) * np.array([quiet, restless]) @ usual, o)


def density(lane, phi, y):
    """The predictive density of y, of any shape: Student's while r rests on few samples, and a Cauchy tail."""
    (x, m, C, v), total, count = before(lane, phi), 0.0, float(lane["count"])
    body = stats.norm if count > filters.STUDENT else stats.t(count)
    for k, weight in enumerate(lane["mu"]):
        e, h = y - x @ m[:, k], x @ C[k] @ x
        for j, p in enumerate(states(lane)):
            law = stats.cauchy if j == 2 else body
            scale = np.sqrt(h + v[j])
            total = total + weight * p * law.pdf(e / scale) / scale
    return total


def sample(lane, phi, y):
    """Probabilities (K,), means (n, K) and covariances (K, n, n) after a sample, before and after the interaction."""
    (x, m, C, v), K, count = after_jump(lane, phi, y), len(lane["mu"]), float(lane["count"])
    e, g = y - x @ m, C @ x
    h = g @ x
    s = h + np.stack([np.full(K, v[0]), np.full(K, v[1]), np.maximum(v[2], e**2)])
    kernel = np.exp(-0.5 * e**2 / s) if count > filters.STUDENT else (1.0 + e**2 / s / count) ** (-0.5 * (count + 1.0))
    joint = lane["mu"] * states(lane)[:, None] * kernel / np.sqrt(s)
    joint /= joint.sum()
    mu = np.maximum(joint.sum(axis=0), filters.LEAST)
    a, a2 = (joint / s).sum(axis=0) / mu, (joint / s**2).sum(axis=0) / mu
    m = m + g.T * (a * e)
    C = C - ((a - np.maximum(a2 - a * a, 0.0) * e**2) * g.T).T[:, :, None] * g[:, None, :]
    return mu, m, C, joint


def interaction(lane, mu, m, C):
    """The same after it, with the full matrix of transitions: down a ladder, or from anywhere to a mode."""
    ratio, arrive = lane["ratio"], lane["arrive"]
    down = np.where(ratio < 1.0, filters.DOWN, np.where(ratio < JUMPS, filters.AFTER, filters.ENDS))
    down *= np.append(False, np.diff(ratio) > 0.0)
    T = np.diag(1.0 - down - arrive.sum()) + np.diag(down[1:], -1) + arrive
    share = mu[:, None] * T
    prior = share.sum(axis=0)
    share /= prior
    mean = m @ share
    off = m[:, :, None] - mean[:, None, :]
    cov = np.einsum("kj,kab->jab", share, C) + np.einsum("kj,akj,bkj->jab", share, off, off)
    return prior, mean, cov, T

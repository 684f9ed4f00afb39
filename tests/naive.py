"""Slow and obvious twins in plain NumPy. They keep everything they ever saw and solve from scratch at every sample.

A twin of a tracker has ``see(phi, y, dt, noise, drift)``, which lets time pass and takes one sample in (y may be None),
and returns (y_hat, e, s). A twin of a model turns signals into those calls.
"""

import numpy as np
from scipy.linalg import null_space

from driftfit.trackers.parts.modes.drifts.about_means import STILL
from driftfit.trackers.parts.modes.drifts.trend import FADING, GROWN, LOST, SHORTEST

LARGEST = 1e100
SMALL = 1e-9


class Kalman:
    """The posterior of theta_t given all rows, from the joint Gaussian of drifts and observations.

    theta_t = theta0 + d + D_1 + .. + D_t with d flat (or N(0, p0)) and D_k ~ N(0, Q_k); y_k = phi_k' theta_k + v_k.
    """

    def __init__(self, n, q, r, p0=None, theta0=0.0):
        self.n = n
        self.theta0 = np.zeros(n) + theta0
        self.q = np.diag(np.zeros(n) + q) if np.ndim(q) < 2 else np.asarray(q)
        self.r = r
        self.flat = p0 is None
        self.drifted = np.zeros((n, n)) if p0 is None else np.diag(np.zeros(n) + p0) if np.ndim(p0) < 2 else p0
        self.rows = []  # (phi, y, noise variance, covariance of theta_k - d when it was taken)
        self.theta, self.P = self.solve()

    def see(self, phi, y, dt=1.0, noise=1.0, drift=1.0):
        self.drifted = self.drifted + self.q * dt * drift
        self.theta, self.P = self.solve()
        y_hat = phi @ self.theta
        s = variance_along(phi, self.P, self.free) + self.r * noise
        if y is None or not np.isfinite(noise):
            return y_hat, np.nan, s
        e = y - y_hat
        self.rows.append((phi, y, self.r * noise, self.drifted))
        self.theta, self.P = self.solve()
        return y_hat, e, s

    def solve(self):
        """Mean and covariance now; ``free`` spans the directions of which nothing is known."""
        n, N = self.n, len(self.rows)
        self.free = np.eye(n) if self.flat else np.zeros((n, 0))
        if N == 0:
            return self.theta0, self.drifted
        A = np.array([phi for phi, *_ in self.rows])
        residual = np.array([y for _, y, *_ in self.rows]) - A @ self.theta0
        S, C = np.zeros((N, N)), np.zeros((n, N))
        for i, (phi, _, r, then) in enumerate(self.rows):
            C[:, i] = then @ phi
            for j, (other, *_) in enumerate(self.rows):
                S[i, j] = phi @ self.rows[min(i, j)][3] @ other
            S[i, i] += r
        if not self.flat:
            gain = C @ np.linalg.inv(S)
            return self.theta0 + gain @ residual, self.drifted - gain @ C.T
        self.free = null_space(A / np.linalg.norm(A, axis=1).clip(1e-300)[:, None], rcond=SMALL)
        half = np.linalg.inv(np.linalg.cholesky(S))
        B = half @ A
        inverse = np.linalg.pinv(B, rcond=SMALL)  # least squares of least norm
        d = inverse @ half @ residual
        gain = C @ half.T @ half
        self.S, self.B, self.left = S, B, half @ (residual - A @ d)
        rest = np.eye(n) - gain @ A
        P = rest @ inverse @ inverse.T @ rest.T + self.drifted - gain @ C.T
        return self.theta0 + d + gain @ (residual - A @ d), P

    def loglik(self):
        """The diffuse log-likelihood of all rows at once: the likelihood of what the flat start leaves."""
        values = np.linalg.svd(self.B, compute_uv=False)
        values = values[values > SMALL * values[0]]
        count = len(self.rows) - len(values)
        determinants = np.linalg.slogdet(self.S)[1] + 2.0 * np.log(values).sum()
        return -0.5 * (count * np.log(2 * np.pi) + determinants + self.left @ self.left)

    def var(self):
        """Variances, inf for every parameter that the rows do not span."""
        return np.where((self.free**2).sum(axis=1) > 1e-8, np.inf, np.diag(self.P))


def variance_along(phi, P, free):
    """phi' P phi, inf where phi has a part of which nothing is known."""
    size = np.linalg.norm(phi)
    return np.inf if size and np.linalg.norm(free.T @ phi) > 1e-6 * size else phi @ P @ phi


class RLS:
    """Weighted least squares on all rows, of least norm about theta0; the weight fades with the time since."""

    def __init__(self, n, forgetting, p0=None, theta0=0.0):
        self.n, self.forgetting = n, forgetting
        self.theta0 = np.zeros(n) + theta0
        prior = None if p0 is None else np.linalg.inv(np.diag(np.zeros(n) + p0) if np.ndim(p0) < 2 else p0)
        self.rows = [] if prior is None else [(row, row @ self.theta0, 0.0) for row in np.linalg.cholesky(prior).T]
        self.weights = [1.0] * len(self.rows)
        self.now = 0.0
        self.squares = []
        self.solve()

    def see(self, phi, y, dt=1.0, noise=1.0, drift=1.0):
        self.now += dt
        self.solve()
        y_hat = phi @ self.theta
        v = variance_along(phi, self.P, self.free) + noise
        s = v * self.scale() if np.isfinite(v) else v
        if y is None or not np.isfinite(noise):
            return y_hat, np.nan, s
        e = y - y_hat
        if np.isfinite(v):
            self.squares.append(e * e / v)
        self.rows.append((phi, y, self.now))
        self.weights.append(1.0 / noise)
        self.solve()
        return y_hat, e, s

    def solve(self):
        self.theta, self.P, self.free = self.theta0, np.zeros((self.n, self.n)), np.eye(self.n)
        if self.rows:
            A = np.array([phi for phi, *_ in self.rows])
            faded = np.sqrt(
                [w * self.forgetting ** (self.now - t) for (*_, t), w in zip(self.rows, self.weights, strict=True)]
            )
            inverse = np.linalg.pinv(A * faded[:, None], rcond=SMALL)
            residual = np.array([y for _, y, _ in self.rows]) - A @ self.theta0
            self.theta, self.P = self.theta0 + inverse @ (faded * residual), inverse @ inverse.T
            self.free = null_space(A / np.linalg.norm(A, axis=1).clip(1e-300)[:, None], rcond=SMALL)

    def scale(self):
        return np.mean(self.squares) if self.squares else np.nan

    def var(self):
        scale, P = self.scale(), np.diag(self.P)
        known = P * scale if np.isfinite(scale) else np.where(P > 0.0, np.inf, 0.0)  # no residual has shown the noise
        return np.where((self.free**2).sum(axis=1) > 1e-8, np.inf, known)


class AugmentedFLS:
    """The published form, with the matrix: theta + [phi phi' + m I]^-1 phi (y - phi' theta)."""

    def __init__(self, n, mu, theta0=1e-6, alpha=1.0):
        self.theta, self.mu, self.alpha = np.zeros(n) + theta0, mu, alpha

    def see(self, phi, y, dt=1.0, noise=1.0, drift=1.0):
        y_hat = phi @ self.theta
        if y is None or not np.isfinite(noise):
            return y_hat, np.nan, np.nan
        e = y - y_hat
        if dt * drift > 0.0:
            m = self.mu * noise / (dt * drift)
            step = np.linalg.solve(np.outer(phi, phi) + m * np.eye(len(phi)), phi * e)
            self.theta = self.theta + self.alpha * step
        return y_hat, e, np.nan

    def var(self):
        return np.full(len(self.theta), np.nan)


def known(value):
    """The number, or None where it cannot be used."""
    return None if value is None or not abs(value) < LARGEST else float(value)


class ARX:
    """Lists of the past, newest first, with None for what is missing."""

    def __init__(self, na, lags, intercept=False, start="drop"):
        self.na, self.lags, self.intercept = na, lags, intercept
        self.unknown = None if start == "drop" else 0.0
        self.started = start == "zero"
        self.y = [self.unknown] * na
        self.u = [[self.unknown] * (nb + nk) for nb, nk in lags]
        self.missing = 0

    def run(self, tracker, y, u, dt, noise, drift):
        """Rows (theta, var, y_hat, e, s, ok) of a record; u is (T, m)."""
        return [self.step(tracker, *sample) for sample in zip(y, u, dt, noise, drift, strict=True)]

    def step(self, tracker, y, u, dt, noise, drift):
        if dt > 1.5:
            self.y = [None] * self.na
            self.u = [[None] * len(past) for past in self.u]
        phi = list(self.y)
        for past, value, (nb, nk) in zip(self.u, u, self.lags, strict=True):
            past.insert(0, known(value))
            phi += past[nk : nk + nb]
        phi += [1.0] * self.intercept
        complete = None not in phi
        self.started = self.started or complete
        y = known(y)
        y_hat, e, s = np.nan, np.nan, np.nan
        if self.started:
            row = np.array([0.0 if value is None else value for value in phi])
            y_hat, e, s = tracker.see(row, y if complete else None, dt, noise, drift)
        if not complete:
            y_hat, s = np.nan, np.nan
        knows = not np.isinf(s) or np.isinf(noise)
        fill = float(y_hat) if complete and knows and self.missing < self.na else None
        self.missing = 0 if y is not None else self.missing + 1
        self.y = [y if y is not None else fill, *self.y][: self.na]
        self.u = [past[: nb + nk] for past, (nb, nk) in zip(self.u, self.lags, strict=True)]
        return tracker.theta, tracker.var(), y_hat, e, s, bool(complete and y is not None and np.isfinite(noise))


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

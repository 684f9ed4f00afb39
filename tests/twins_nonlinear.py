"""Textbooks of what is not linear in theta: derivatives are differences, in so many digits that they are exact.

As in `twins`; a model here is a function that gives the arguments of ``see`` for every sample.
"""

from decimal import Decimal, localcontext

import numpy as np
from twins import DIGITS, Kalman, exact, known, square

STEP = Decimal("1e-90")


def slope(function, z):
    """The derivatives of a scalar or vector function, (.., n)."""
    return np.array([(function(z + e) - function(z - e)) / (2 * STEP) for e in STEP * square(1.0, len(z))]).T


class Extended(Kalman):
    """z <- f(z), P <- F P F' + q dt d;  y_hat = h(z), g = P h', s = (1 + inflation) h' P h + r;  z, P as in `Kalman`.

    ``see`` takes what f and h need beside z in the place of phi. A prior is needed.
    """

    def __init__(self, n, f, h, q, r, p0, theta0, inflation=0.0):
        super().__init__(n, q, r, p0, theta0)
        self.f, self.h, self.inflation = f, h, Decimal(inflation)

    def see(self, given, y, dt=1.0, noise=1.0, drift=1.0):
        self.move(lambda z: self.f(z, given))
        self.predict(dt, drift)
        y_hat, g, h = self.forecast(lambda z: self.h(z, given))
        s = (1 + self.inflation) * h + self.r * Decimal(noise)
        if y is None or not np.isfinite(noise):
            return float(y_hat), np.nan, float(s)
        e = Decimal(y) - y_hat
        self.x, self.P = self.x + g * (e / s), self.P - np.outer(g, g) / s
        self.kappa = max(self.kappa, h / self.r)
        return float(y_hat), float(e), float(s)

    def move(self, f):
        F = slope(f, self.x)
        self.x, self.P = f(self.x), F @ self.P @ F.T

    def forecast(self, h):
        row = slope(h, self.x)
        return h(self.x), self.P @ row, row @ self.P @ row


class Unscented(Extended):
    """The same by points z +- sqrt(n + k) L_j, P = L L', and z itself with weight k / (n + k), k = max(3 - n, 0)."""

    def points(self):
        centre = Decimal(max(3 - self.n, 0))
        L = (self.n + centre).sqrt() * cholesky(self.P).T
        weights = [1 / (2 * (self.n + centre))] * (2 * self.n) + [centre / (self.n + centre)]
        return np.concatenate([self.x + L, self.x - L, self.x[None]]), np.array(weights)

    def move(self, f):
        points, weights = self.points()
        moved = np.array([f(one) for one in points])
        self.x = weights @ moved
        self.P = (moved - self.x).T @ (weights[:, None] * (moved - self.x))

    def forecast(self, h):
        points, weights = self.points()
        shown = np.array([h(one) for one in points])
        y_hat = weights @ shown
        return y_hat, (points - self.x).T @ (weights * (shown - y_hat)), weights @ (shown - y_hat) ** 2


class OutputError(Extended):
    """z = (w, xi): xi drifts, then w_t = -a w_(t-1) + sum_j b_j v_(t-j) + N(0, q_w), v = u + c u^2;  y_t = w_t + n_t.

    Departure: |w| <= 3 times the largest output before.
    """

    def __init__(self, q, r, p0, theta0, q_w, p_w):
        q, p0, start = np.r_[0.0, np.full(4, q)], np.r_[p_w, np.full(4, p0)], np.r_[0.0, np.zeros(4) + theta0]
        super().__init__(5, self.following, lambda z, given: z[0], q, r, p0, start)
        self.q_w, self.largest, self.begun = Decimal(q_w), Decimal(0), False

    def following(self, z, given):
        a, b, c = z[1], z[2:4], z[4]
        return np.r_[b @ (given[1:] + c * given[1:] ** 2) - a * z[0], z[1:]]

    def see(self, given, y, dt=1.0, noise=1.0, drift=1.0):
        if not self.begun:
            self.x[0], self.begun = given[0], True
        Kalman.predict(self, dt, drift)
        self.largest = max(self.largest, abs(given[0]))
        return super().see(given, y, dt, noise, drift)

    def predict(self, dt, drift):
        self.x[0] = max(-3 * self.largest, min(3 * self.largest, self.x[0]))
        self.P = self.P + self.q_w * np.diag([Decimal(1), *[Decimal(0)] * 4])

    @property
    def theta(self):
        return self.x[1:].astype(float)

    def var(self):
        return np.diag(self.P)[1:].astype(float)


def cholesky(P):
    """L with L L' = P; what is known has a column of zeros."""
    L = square(0.0, len(P))
    for j in range(len(P)):
        pivot = P[j, j] - L[j] @ L[j]
        if pivot > Decimal("1e-14") * P[j, j]:
            L[j, j] = pivot.sqrt()
            for i in range(j + 1, len(P)):
                L[i, j] = (P[i, j] - L[i] @ L[j]) / L[j, j]
    return L


def played(tracker, samples, record, digits=DIGITS):
    """theta, var, y_hat, e, s, ok of a record; ``samples`` yields (what the model needs, whether it is complete, y)."""
    with localcontext() as context:
        context.prec, rows = digits, []
        for (given, complete, y), dt, noise, drift in zip(samples, record.dt, record.noise, record.drift, strict=True):
            shown = np.nan, np.nan, np.nan
            if given is not None:
                shown = tracker.see(given, y if complete else None, dt, noise, drift)
            rows.append((tracker.theta, tracker.var(), *shown, complete and y is not None and np.isfinite(noise)))
    return [np.array(column, dtype=float) for column in zip(*rows, strict=True)]


def states(record):
    """Samples of a `StateSpace` with u and u[-1]: where one is missing, the states move on with the last one known."""
    now, before = None, None
    for y, value, dt in zip(record.y, record.u[:, 0], record.dt, strict=True):
        u = known(value)
        complete = u is not None and before is not None
        now = u if u is not None else now
        yield (now, before, dt), complete, known(y)
        before = u


def hammerstein_wiener(record, powers=2):
    """Samples (phi, complete, z) of powers of u_(t-1), y_(t-1) and y_t, in the columns of the publication; na = nb = 1.

    Nothing is filled in, and nothing happens before the first complete sample.
    """
    past, drive, started = None, None, False
    higher = range(2, powers + 1)
    for y, u, dt in zip(record.y, record.u[:, 0], record.dt, strict=True):
        now = known(y)
        past, drive = (past, drive) if dt <= 1.5 else (None, None)
        complete = None not in (past, drive)
        started = started or complete
        y1, u1, y0 = (0.0 if one is None else one for one in (past, drive, now))
        phi = [y1, -u1, *(y0**k for k in higher), *(-(u1**k) for k in higher), *(y1**k for k in higher)]
        yield exact(np.array(phi)) if started else None, complete, None if now is None else -now
        past, drive = now, known(u)


def output_error(record):
    """Samples (y_(t-1), u_(t-1), u_(t-2)) of `OutputError`; all inputs are there, and the first outputs."""
    y, u = [known(one) or 0.0 for one in record.y], record.u[:, 0]
    for t, now in enumerate(record.y):
        yield exact(np.array([y[t - 1], u[t - 1], u[t - 2]])) if t > 1 else None, t > 1, known(now)


def products(xi, powers=2):
    """theta of the regression from xi = (a, b, c_2 .., d_2 ..); na = nb = 1."""
    a, b, c, d = xi[:1], xi[1:2], xi[2 : powers + 1], xi[powers + 1 :]
    return np.concatenate([a, b, d, b * c, a * d])


class DynamicGLM:
    """(m+, v+) = mean and variance of p(y | eta)^(1 / r) N(eta; m, v), eta = phi' theta, by twenty points of Gauss and
    Hermite about the mode;  theta <- theta + g (m+ - m) / v;  P <- P + g g' (v+ - v) / v^2.
    """

    def __init__(self, n, family, q, p0, theta0=0.0, alpha=1.0, r=1.0):
        self.family, self.alpha, self.r = family, Decimal(alpha), Decimal(r)
        self.x, self.P, self.q, self.kappa = exact(np.zeros(n) + theta0), square(p0, n), square(q, n), Decimal(0)
        nodes, weights = np.polynomial.hermite.hermgauss(20)
        self.nodes, self.weights = exact(np.sqrt(2.0) * nodes), exact(weights / np.sqrt(np.pi))

    def mean(self, eta):
        return 1 / (1 + (-eta).exp()) if self.family == "logistic" else eta.exp()

    def variance(self, mu):
        return mu + {"poisson": 0, "negative binomial": self.alpha, "logistic": -1}[self.family] * mu * mu

    def log_likelihood(self, y, eta):
        if self.family == "logistic":
            return y * eta - (1 + eta.exp()).ln()
        if self.family == "poisson":
            return y * eta - eta.exp()
        return y * eta - (y + 1 / self.alpha) * (1 + self.alpha * eta.exp()).ln()

    def see(self, phi, y, dt=1.0, noise=1.0, drift=1.0):
        with localcontext() as context:
            context.prec = 40
            return self.sample(exact(phi), y, self.q * Decimal(dt) * Decimal(drift), Decimal(noise) * self.r)

    def sample(self, phi, y, walked, r):
        self.P = self.P + walked
        g = self.P @ phi
        m, v = phi @ self.x, phi @ g
        y_hat, square_mean, own = self.forecast(m, v)
        s = r * own + square_mean - y_hat**2
        possible = y is not None and r.is_finite() and y >= 0.0 and (self.family != "logistic" or y <= 1.0)
        if possible and v > 0:
            after, left = self.posterior(Decimal(y), m, v, r)
            self.x, self.P = self.x + g * ((after - m) / v), self.P + np.outer(g, g) * ((left - v) / v**2)
        return float(y_hat), float(Decimal(y) - y_hat) if possible else np.nan, float(s)

    def forecast(self, m, v):
        """E mu, E mu^2, and E of the variance, for eta ~ N(m, v)."""
        if self.family == "logistic":
            mu = np.array([self.mean(m + v.sqrt() * x) for x in self.nodes])
            return self.weights @ mu, self.weights @ mu**2, self.weights @ self.variance(mu)
        first, second = (m + v / 2).exp(), (2 * m + 2 * v).exp()
        return first, second, first + (self.alpha * second if self.family == "negative binomial" else 0)

    def posterior(self, y, m, v, r):
        def log_joint(eta):
            return self.log_likelihood(y, eta) / r - (eta - m) ** 2 / (2 * v)

        def bends(eta):
            """First and minus second derivative."""
            mu = self.mean(eta)
            scale = 1 + self.alpha * mu if self.family == "negative binomial" else Decimal(1)
            curve = self.variance(mu) if self.family != "negative binomial" else mu * (1 + self.alpha * y) / scale**2
            return (y - mu) / scale / r - (eta - m) / v, curve / r + 1 / v

        low, high = m - 50, m + 50
        for _ in range(100):
            middle = (low + high) / 2
            low, high = (middle, high) if bends(middle)[0] > 0 else (low, middle)
        mode = (low + high) / 2
        width = 1 / bends(mode)[1].sqrt()
        heights = [(log_joint(mode + width * x) - log_joint(mode) + x * x / 2).exp() for x in self.nodes]
        share = self.weights * heights / (self.weights @ heights)
        mean = share @ self.nodes
        return mode + width * mean, width**2 * (share @ self.nodes**2 - mean**2)

    @property
    def theta(self):
        return self.x.astype(float)

    def var(self):
        return np.diag(self.P).astype(float)

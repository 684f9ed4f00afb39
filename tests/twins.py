"""Textbooks: the recursion of every tracker as its source prints it, in three hundred digits.

A twin shares no code with the library, knows nothing of outliers and codes, and has no rounding: arrays hold
`decimal.Decimal`. So what differs is the library's, whatever the condition of a record. A diffuse start is what it is
the limit of, a prior of variance `LARGE` times the identity: a variance above `UNKNOWN` is infinite.

``see(phi, y, dt, noise, drift)`` lets time pass, takes one sample (y may be None) and returns (y_hat, e, s) as floats;
``theta`` and ``var()`` are what it then knows. ``kappa`` is the largest h / r of a used sample. `ARX` turns signals
into such calls by lists of the past.
"""

from decimal import Decimal, localcontext

import numpy as np

DIGITS = 300
LARGE, UNKNOWN = Decimal(10) ** 120, Decimal(10) ** 60
UNUSABLE = 1e38
"""Signals of this size and above are missing."""

exact = np.frompyfunc(Decimal, 1, 1)


def square(value, n):
    """A number, (n,) or (n, n) as a matrix of exact numbers."""
    return exact(np.diag(np.zeros(n) + value) if np.ndim(value) < 2 else np.asarray(value))


def reported(variances):
    return np.array([float(v) if v < UNKNOWN else np.inf for v in variances])


class Kalman:
    """P <- P + q_ij sqrt(d_i d_j) dt;  K = P phi / s;  theta <- theta + K e;  P <- P - K (P phi)'.

    Departure: what no regressor has reached stays where it is, also if q is no multiple of the identity.
    """

    def __init__(self, n, q, r, p0=None, theta0=0.0):
        self.n, self.q, self.r = n, square(q, n), exact(r)
        self.x = exact(np.zeros(n) + theta0)
        self.P = LARGE * square(1.0, n) if p0 is None else square(p0, n)
        self.reached = [] if p0 is None else list(square(1.0, n))
        self.kappa, self.loglik, self.since = Decimal(0), 0.0, square(1.0, n)

    def predict(self, dt, drift):
        root = [Decimal(d).sqrt() for d in np.zeros(self.n) + drift]
        self.P = self.P + self.q * np.outer(root, root) * Decimal(dt)

    def see(self, phi, y, dt=1.0, noise=1.0, drift=1.0):
        self.predict(dt, drift)
        h_row = self.row(exact(phi))
        g = self.P @ h_row
        h, r, y_hat = h_row @ g, self.r * Decimal(noise), h_row @ self.x
        s = h + r if h < UNKNOWN else Decimal("inf")
        if y is None or not np.isfinite(noise):
            return float(y_hat), np.nan, self.scaled(s)
        e = Decimal(y) - y_hat
        found = float(y_hat), float(e), self.scaled(s)
        before, self.x, self.P = self.x, self.x + g * (e / (h + r)), self.P - np.outer(g, g) / (h + r)
        self.hold(before, h_row)
        self.learn(h_row, h, r, e)
        return found

    def row(self, phi):
        """The regressor of x."""
        return phi

    def scaled(self, s):
        return float(s)

    def hold(self, before, h_row):
        """Undo the part of a change, as of the first sample, that is orthogonal to all regressors so far."""
        row = left = h_row @ self.since
        for one in self.reached:
            left = left - one * (one @ left)
        if left @ left > Decimal("1e-100") * (row @ row):
            self.reached.append(left / (left @ left).sqrt())
        apart = solve(self.since, self.x - before)
        for one in self.reached:
            apart = apart - one * (one @ apart)
        self.x = self.x - self.since @ apart

    def learn(self, h_row, h, r, e):
        if h < UNKNOWN:
            self.kappa = max(self.kappa, h / r)
            self.loglik -= 0.5 * (np.log(2.0 * np.pi) + float((h + r).ln() + e * e / (h + r)))
        else:
            self.loglik -= 0.5 * float(((h + r) / LARGE).ln())

    @property
    def theta(self):
        return self.x[: self.n].astype(float)

    def var(self):
        return reported(np.diag(self.P)[: self.n])


def solve(A, b):
    """A^-1 b by Gauss and Jordan, with pivoting."""
    M = np.hstack([A, b.reshape(len(A), -1)])
    for i in range(len(A)):
        k = i + int(np.argmax(abs(M[i:, i])))
        M[[i, k]] = M[[k, i]]
        M[i] = M[i] / M[i, i]
        for j in range(len(A)):
            if j != i:
                M[j] = M[j] - M[j, i] * M[i]
    return M[:, len(A) :].reshape(b.shape)


class Scaled(Kalman):
    """P in units of the noise variance, which is the mean of e^2 / s over the samples after the start."""

    def __init__(self, n, q, p0, theta0):
        super().__init__(n, q, 1.0, p0, theta0)
        self.squares = []

    def scale(self):
        return float(sum(self.squares) / len(self.squares)) if self.squares else np.nan

    def scaled(self, s):
        return float(s) * self.scale() if s.is_finite() else np.inf

    def learn(self, h_row, h, r, e):
        super().learn(h_row, h, r, e)
        if h < UNKNOWN:
            self.squares.append(e * e / (h + r))

    def var(self):
        known = super().var()
        return known * self.scale() if self.squares else np.where(known > 0.0, np.inf, 0.0)


class RLS(Scaled):
    """Exponential: P <- P / lambda_e, also if y is missing. Directional: after a sample that was predicted
    P <- P + (1 / lambda - 1) g g' / (phi' g), g = P phi.

    Departures: lambda_e = min(1, max(lambda^dt, max_i P_ii / (c_max P_ii at full rank))).
    """

    def __init__(self, n, forgetting, p0=None, theta0=0.0, c_max=1e8, kind="exponential"):
        super().__init__(n, 0.0, p0, theta0)
        self.forgetting, self.c_max, self.kind = Decimal(forgetting), Decimal(c_max), kind
        self.first = None if p0 is None else np.diag(self.P)

    def predict(self, dt, drift):
        if self.kind == "exponential":
            first = np.zeros(self.n) if self.first is None else self.first
            grown = [P / (self.c_max * one) for P, one in zip(np.diag(self.P), first, strict=True) if one > 0]
            self.P = self.P / min(Decimal(1), max(self.forgetting ** Decimal(dt), *grown, Decimal(0)))

    def learn(self, h_row, h, r, e):
        super().learn(h_row, h, r, e)
        if self.kind == "directional" and 0 < h < UNKNOWN:
            g = self.P @ h_row
            self.P = self.P + (1 / self.forgetting - 1) * np.outer(g, g) / (h_row @ g)
        if self.first is None and len(self.reached) == self.n:
            self.first = np.diag(self.P)


class FLS(Scaled):
    """The Kalman filter with q = 1 / mu and r = 1, the prior of which is that of the first sample.

    With differences=2 the slope is the random walk: x = (theta, slope), P <- F P F' + D^-1 (dt, 1)(dt, 1)'.
    """

    def __init__(self, n, mu, theta0=0.0, p0=None, differences=1):
        N = n * differences
        super().__init__(N, 0.0, p0, np.r_[np.zeros(n) + theta0, np.zeros(N - n)])
        self.n, self.begun = n, False
        self.walk = square(1.0 / (np.zeros(n) + mu), n)

    def predict(self, dt, drift):
        n, N, time = self.n, len(self.x), Decimal(dt)
        if self.begun:
            F = square(1.0, N)
            q = self.walk * exact(np.diag(np.zeros(n) + drift)) * time
            if n < N:
                F[:n, n:] = square(dt, n)
                q = np.block([[q * time * time, q * time], [q * time, q]])
            self.x, self.P, self.since = F @ self.x, F @ self.P @ F.T + q, F @ self.since
        self.begun = self.begun or dt > 0.0

    def row(self, phi):
        return np.r_[phi, exact(np.zeros(len(self.x) - len(phi)))]


class Laws(Kalman):
    """theta = H x;  x <- F(dt) x,  P <- F P F' + Q(dt) d.

    ``laws`` has a tuple for each parameter: ("walk", q), ("returns", time, std), ("trend", q) or
    ("season", period, harmonics, q); a level of a season has the drift q of the tracker. Only levels have a prior.
    """

    def __init__(self, n, q, r, laws, p0=None, theta0=0.0):
        self.parts = [part for i, law in enumerate(laws) for part in parts_of(i, law, (np.zeros(n) + q)[i])]
        N = len(self.parts)
        super().__init__(N, 0.0, r)
        levels = [i for i, part in enumerate(self.parts) if part[1] == "level"]
        self.H = exact(np.zeros((n, N)))
        for i, (owner, kind, *_) in enumerate(self.parts):
            self.H[owner, i] = Decimal(kind not in ("slope", "sine"))
            if kind == "decay":
                self.P[i, i] = Decimal(self.parts[i][3]) ** 2
        self.x[levels] = exact(np.zeros(n) + theta0)
        if p0 is not None:
            self.P[np.ix_(levels, levels)] = square(p0, n)

    def predict(self, dt, drift):
        N, dt = len(self.parts), Decimal(dt)
        F, Q = square(1.0, N), square(0.0, N)
        factor = np.zeros(len(self.H)) + drift
        for i, (owner, kind, rate, noise) in enumerate(self.parts):
            d = Decimal(factor[owner]) * dt * Decimal(noise)
            if kind == "decay":
                F[i, i] = (-dt / Decimal(rate)).exp()
                Q[i, i] = Decimal(factor[owner]) * Decimal(noise) ** 2 * (1 - F[i, i] ** 2)
            elif kind == "slope":
                F[i - 1, i] = dt
                Q[i - 1 : i + 1, i - 1 : i + 1] = d * np.outer([dt, 1], [dt, 1])
            elif kind == "sine":
                angle = float(dt) * rate
                turn = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
                F[i - 1 : i + 1, i - 1 : i + 1] = exact(np.array(turn))
                Q[i - 1, i - 1] = Q[i, i] = d
            elif kind == "level":
                Q[i, i] = d
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q

    def row(self, phi):
        return phi @ self.H

    def hold(self, before, h_row):
        pass

    @property
    def theta(self):
        return (self.H @ self.x).astype(float)

    def var(self):
        return reported(np.diag(self.H @ self.P @ self.H.T))


def parts_of(i, law, q):
    """What parameter i consists of: (parameter, kind, time or angle per nominal sample, variance or std)."""
    kind, *given = law
    if kind == "returns":
        return [(i, "level", 0.0, 0.0), (i, "decay", *given)]
    if kind == "trend":
        return [(i, "level", 0.0, 0.0), (i, "slope", 0.0, *given)]
    if kind == "walk":
        return [(i, "level", 0.0, *given)]
    period, harmonics, noise = given
    angles = [2.0 * np.pi * k / period for k in range(1, harmonics + 1)]
    return [(i, "level", 0.0, q), *((i, kind, angle, noise) for angle in angles for kind in ("cosine", "sine"))]


class InstrumentalVariables(RLS):
    """K = G zeta / (1 / w + phi' G zeta);  theta <- theta + K e;  G <- G - K phi' G;
    C <- (I - K phi') C (I - K phi')' + K K' / w, with the first ``na`` regressors replaced in zeta by

        x_t = zeta_t' a_t,  |x_t| <= the largest output before;    a_(t+1) = a_t + 0.05 (theta_t - a_t)

    Departures: least squares for 10 n samples, which without a prior are forgotten again: until sample 40 n the memory
    is max(10 n, k / 4) samples; and no step where 1 / w + phi' G zeta < 0.5 / w.
    """

    def __init__(self, n, forgetting, na, p0=None, theta0=0.0, c_max=1e8):
        super().__init__(n, forgetting, p0, theta0, c_max)
        self.G, self.na, self.settles = self.P, na, p0 is None and na > 0
        self.kappa = Decimal(10) ** 10  # x is fed back: an early estimate that is unstable magnifies rounding
        self.used = self.faded_at = 0
        self.auxiliary, self.lags, self.largest = self.x, [Decimal(0)] * na, Decimal(0)

    def predict(self, dt, drift):
        k, before, forgetting = len(self.squares), self.P, self.forgetting
        if self.settles and self.faded_at < k < 40 * self.n and dt > 0.0:
            self.faded_at = k
            memory = Decimal(max(10 * self.n, k / 4))
            self.forgetting = min(forgetting ** Decimal(dt), 1 - 1 / memory) ** (1 / Decimal(dt))
        super().predict(dt, drift)
        self.forgetting = forgetting
        self.G = self.G * (self.P[0, 0] / before[0, 0])

    def see(self, phi, y, dt=1.0, noise=1.0, drift=1.0):
        self.predict(dt, drift)
        phi = exact(phi)
        settled = self.used >= 10 * self.n
        instruments = np.r_[self.lags, phi[self.na :]] if self.na else phi
        zeta = instruments if settled else phi
        x = max(-self.largest, min(self.largest, instruments @ self.auxiliary))
        h, r, y_hat = phi @ self.P @ phi, Decimal(noise), phi @ self.x
        found = float(y_hat), np.nan, self.scaled(h + r if h < UNKNOWN else Decimal("inf"))
        if y is not None and np.isfinite(noise):
            e, self.used = Decimal(y) - y_hat, self.used + 1
            found = found[0], float(e), found[2]
            common = r + phi @ self.G @ zeta
            if common >= r / 2:
                K = self.G @ zeta / common
                left = square(1.0, self.n) - np.outer(K, phi)
                self.x, self.G = self.x + K * e, self.G - np.outer(K, phi @ self.G)
                self.P = left @ self.P @ left.T + r * np.outer(K, K)
            self.hold(self.x, phi)
            self.learn(phi, h, r, e)
        if self.reading is not None:
            self.largest = max(self.largest, abs(Decimal(self.reading)))
        share = Decimal("0.05") if self.used >= 10 * self.n else Decimal(1)
        self.auxiliary = self.auxiliary + share * (self.x - self.auxiliary)
        self.lags = [x, *self.lags][: self.na]
        return found


class AugmentedFLS:
    """theta <- theta + alpha phi (y - phi' theta) / (mu / (w d dt) + phi' phi)."""

    def __init__(self, n, mu, theta0=1e-6, alpha=1.0):
        self.x, self.mu, self.alpha, self.kappa = exact(np.zeros(n) + theta0), Decimal(mu), Decimal(alpha), Decimal(0)

    def see(self, phi, y, dt=1.0, noise=1.0, drift=1.0):
        phi, moves = exact(phi), Decimal(dt) * Decimal(drift)
        y_hat = phi @ self.x
        if y is None or not np.isfinite(noise):
            return float(y_hat), np.nan, np.nan
        e = Decimal(y) - y_hat
        if moves > 0:
            self.x = self.x + self.alpha * phi * e / (self.mu * Decimal(noise) / moves + phi @ phi)
        return float(y_hat), float(e), np.nan

    @property
    def theta(self):
        return self.x.astype(float)

    def var(self):
        return np.full(len(self.x), np.nan)


def known(value):
    """The number, or None where it cannot be used."""
    return None if value is None or not abs(value) < UNUSABLE else float(value)


class ARX:
    """Lists of the past, newest first, with None for what is missing; ``lags`` are (nb, nk) of every input."""

    def __init__(self, na, lags, intercept=False, start="drop"):
        self.na, self.lags, self.intercept = na, lags, intercept
        self.unknown = None if start == "drop" else 0.0
        self.started = start == "zero"
        self.y = [self.unknown] * na
        self.u = [[self.unknown] * (nb + nk) for nb, nk in lags]
        self.missing = 0

    def run(self, tracker, y, u, dt, noise, drift):
        """theta, var, y_hat, e, s, ok of a record, (T, ..) each; u is (T, m)."""
        with localcontext() as context:
            context.prec = DIGITS
            rows = [self.step(tracker, *sample) for sample in zip(y, u, dt, noise, drift, strict=True)]
        return [np.array(column, dtype=float) for column in zip(*rows, strict=True)]

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
        tracker.reading = y = known(y)
        y_hat, e, s = np.nan, np.nan, np.nan
        if self.started:
            row = np.array([0.0 if value is None else value for value in phi])
            y_hat, e, s = tracker.see(row, y if complete else None, dt, noise, drift)
        if not complete:
            y_hat, s = np.nan, np.nan
        foreseen = not np.isinf(s) or np.isinf(noise)
        fill = float(y_hat) if complete and foreseen and self.missing < self.na else None
        self.missing = 0 if y is not None else self.missing + 1
        self.y = [y if y is not None else fill, *self.y][: self.na]
        self.u = [past[: nb + nk] for past, (nb, nk) in zip(self.u, self.lags, strict=True)]
        return tracker.theta, tracker.var(), y_hat, e, s, bool(complete and y is not None and np.isfinite(noise))

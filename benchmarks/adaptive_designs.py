"""Ways of choosing the drift automatically, on the scenarios of the tracking benchmark; `AdaptiveKalman` is the best.

Prints the parameter RMSE after 200 samples of every design as a ratio to the best Kalman filter with one drift ratio,
chosen per scenario in hindsight from a grid that is printed too. Run: python benchmarks/adaptive_designs.py [--quick]

    mixture    Kalman filters with fixed ratios in parallel, weighted by recent predictive likelihood (factor 0.99)
    IMM        the same filters interacting; all transitions between modes have the same small probability
    slow log-q one filter whose log ratio follows the gradient of the predictive likelihood
    memories   least squares with a memory for each parameter, longer while its corrections alternate in sign
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from driftfit import ARX, AdaptiveKalman, Kalman, Regression, track
from driftfit.engine.kernel import Array, Driver, part
from driftfit.systems import scenarios

BURN = 200
GRID = np.array([0.0, *np.logspace(-7, 1, 17)])
LADDER = np.array([0.0, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0])
MODELS = {"regression": Regression(3), "arx": ARX(2, 2)}


def regressors(kind: str, y: Array, u: Array) -> Array:
    """phi (T, n); NaN where a lag is missing."""
    if kind == "regression":
        return u
    phi = np.full((len(y), 4), np.nan)
    phi[2:] = np.stack([y[1:-1], y[:-2], u[1:-1, 0], u[:-2, 0]], axis=1)
    return phi


@part
def mix(m: Array, P: Array, mu: Array, stay: float, means: Array, covariances: Array, prior: Array) -> None:
    """Interaction of K filters, into the last three: all transitions to other modes have the same probability."""
    K, n = m.shape
    move = (1.0 - stay) / (K - 1)
    means[:], covariances[:] = 0.0, 0.0
    for j in range(K):
        prior[j] = stay * mu[j] + move * (1.0 - mu[j])
        for i in range(K):
            share = mu[i] * (stay if i == j else move) / prior[j]
            for a in range(n):
                means[j, a] += share * m[i, a]
        for i in range(K):
            share = mu[i] * (stay if i == j else move) / prior[j]
            for a in range(n):
                for b in range(n):
                    product = (m[i, a] - means[j, a]) * (m[i, b] - means[j, b])
                    covariances[j, a, b] += share * (P[i, a, b] + product)


@Driver
def bank(phi: Array, y: Array, ratios: Array, fade: float, stay: float) -> Array:
    """Filters in parallel; stay = 1: weights by faded likelihood; below 1: IMM with that probability to stay."""
    T, n = phi.shape
    K = len(ratios)
    m, P = np.zeros((K, n)), np.zeros((K, n, n))
    for k in range(K):
        P[k] = 1e4 * np.eye(n)
    mu, score, r, c, seen = np.full(K, 1.0 / K), np.zeros(K), 1.0, np.zeros(n), 0.0
    means, covariances, out = np.zeros((K, n)), np.zeros((K, n, n)), np.zeros((T, n))
    for t in range(T):
        prior = mu.copy()
        if stay < 1.0:
            mix(m, P, mu, stay, means, covariances, prior)
            m[:], P[:] = means, covariances
        usable = np.isfinite(y[t]) and np.isfinite(phi[t]).all()
        if usable:
            seen += 1.0
            c += (phi[t] ** 2 - c) / min(seen, 200.0)
        for k in range(K):
            for i in range(n):
                if c[i] > 0.0:
                    P[k, i, i] += ratios[k] * r / c[i]
        if usable:
            loglik, surprise = np.zeros(K), 0.0
            for k in range(K):
                g = P[k] @ phi[t]
                s, e = phi[t] @ g + r, y[t] - phi[t] @ m[k]
                m[k] += g * e / s
                P[k] -= np.outer(g, g) / s
                loglik[k] = -0.5 * (np.log(s) + e * e / s)
                surprise += prior[k] * e * e / s
            if seen > 2 * n:
                score = fade * score + loglik
                weight = prior * np.exp(loglik - loglik.max()) if stay < 1.0 else np.exp(score - score.max())
                mu = weight / weight.sum()
            if seen > n:
                r *= 1.0 + (surprise - 1.0) / min(seen - n + 1.0, 100.0)
        for k in range(K):
            out[t] += mu[k] * m[k]
    return out


@Driver
def slow_log_q(phi: Array, y: Array, rate: float) -> Array:
    """One filter; log q follows d log N(e; 0, s) / d log q, the derivative of P being q's own share of it."""
    T, n = phi.shape
    m, P, share = np.zeros(n), 1e4 * np.eye(n), np.zeros((n, n))
    log_ratio, r, c, seen = np.log(1e-3), 1.0, np.zeros(n), 0.0
    out = np.zeros((T, n))
    for t in range(T):
        if np.isfinite(y[t]) and np.isfinite(phi[t]).all():
            seen += 1.0
            c += (phi[t] ** 2 - c) / min(seen, 200.0)
            for i in range(n):
                q = np.exp(log_ratio) * r / c[i]
                P[i, i] += q
                share[i, i] += q
            g = P @ phi[t]
            s, e = phi[t] @ g + r, y[t] - phi[t] @ m
            slope = phi[t] @ share @ phi[t]
            m += g * e / s
            P -= np.outer(g, g) / s
            keep = np.eye(n) - np.outer(g / s, phi[t])
            share = keep @ share @ keep.T
            surprise = min(e * e / s, 9.0) - 1.0
            if seen > 2 * n:
                log_ratio = min(1.0, max(np.log(1e-7), log_ratio + rate * 0.5 * slope / s * surprise))
            if seen > n:
                r *= 1.0 + surprise / min(seen - n + 1.0, 100.0)
        out[t] = m
    return out


@Driver
def memories(phi: Array, y: Array, meta: float) -> Array:
    """Least squares with a memory per parameter, shorter while a parameter's corrections agree in sign."""
    T, n = phi.shape
    m, P, trend, memory = np.zeros(n), 1e4 * np.eye(n), np.zeros(n), np.full(n, np.log(100.0))
    out = np.zeros((T, n))
    for t in range(T):
        if np.isfinite(y[t]) and np.isfinite(phi[t]).all():
            grow = 1.0 / np.sqrt(1.0 - np.exp(-memory))
            P *= np.outer(grow, grow)
            g = P @ phi[t]
            s, e = phi[t] @ g + 1.0, y[t] - phi[t] @ m
            step = g * e / s
            memory += meta * (0.2 - np.sign(trend) * np.sign(step))
            memory = np.minimum(np.log(2000.0), np.maximum(np.log(5.0), memory))
            trend = 0.9 * trend + step
            m += step
            P -= np.outer(g, g) / s
        out[t] = m
    return out


def own(kind: str, y: Array, u: Array) -> Array:
    return np.asarray(track(MODELS[kind], AdaptiveKalman(), y, u).theta)


def on_regressors(follow: Callable[[Array, Array], Array]) -> Callable[[str, Array, Array], Array]:
    return lambda kind, y, u: follow(regressors(kind, y, u), y)


DESIGNS: dict[str, Callable[[str, Array, Array], Array]] = {
    "AdaptiveKalman": own,
    "mixture": on_regressors(lambda phi, y: bank(phi, y, LADDER, 0.99, 1.0)),
    "IMM": on_regressors(lambda phi, y: bank(phi, y, LADDER, 1.0, 0.998)),
    "slow log-q": on_regressors(lambda phi, y: slow_log_q(phi, y, 0.05)),
    "memories": on_regressors(lambda phi, y: memories(phi, y, 0.02)),
}


def rmse(paths: list[tuple[Array, Array]]) -> float:
    return float(np.sqrt(np.mean([np.mean((path - truth)[BURN:] ** 2) for path, truth in paths])))


def main(quick: bool) -> None:
    runs = 2 if quick else 20
    table = Table(title=f"RMSE after {BURN} samples / best fixed ratio in hindsight, {runs} runs of 1000 samples")
    for head in ("scenario", "model", *DESIGNS, "best fixed RMSE", "its q/r"):
        table.add_column(head, justify="left" if head in ("scenario", "model") else "right")
    ratios = []
    for name in scenarios.found():
        for kind, model in MODELS.items():
            records = [scenarios.simulate(name, kind, seed) for seed in range(runs)]
            fixed = [
                rmse([(track(model, Kalman(q=g * 0.09, r=0.09), s.y, s.u).theta, s.theta) for s in records])
                for g in GRID
            ]
            best = min(fixed)
            row = [rmse([(follow(kind, s.y, s.u), s.theta) for s in records]) / best for follow in DESIGNS.values()]
            ratios.append(row)
            table.add_row(name, kind, *(f"{x:.2f}" for x in row), f"{best:.4f}", f"{GRID[np.argmin(fixed)]:.0e}")
    console = Console(width=130)
    console.print(table)
    console.print("grid of q/r:", ", ".join(f"{g:.1e}" for g in GRID))
    for name, column in zip(DESIGNS, np.array(ratios).T, strict=True):
        console.print(f"{name:16} worst {column.max():.2f}, within 10 % on {np.sum(column <= 1.1)} of {len(column)}")


if __name__ == "__main__":
    main("--quick" in sys.argv)

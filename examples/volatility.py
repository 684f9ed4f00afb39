"""Noise whose variance moves: `Kalman(volatility=...)` and the default tracker against GARCH(1, 1).

Records of 2000 returns about a level: settings are estimated on the first half, by maximum likelihood, and judged on
the second. Four are simulated, the mean of eight records each; with `pip install arch` daily returns of three markets
follow, in per cent, from the data sets of that package.
"""

import numpy as np
from scipy.optimize import minimize

from driftfit import AdaptiveKalman, Kalman, Regression, track

LEVEL = Regression(0, intercept=True)
T, RECORDS = 2000, 8
VOLATILITIES = 10.0 ** np.arange(-3.5, -0.9, 0.25)


def simulated(kind, rng):
    z, y, h, log_r = rng.normal(size=T), np.zeros(T), 1.0, 0.0
    for t in range(T):
        if kind == "random walk of log r":
            log_r += 0.1 * rng.normal()
        elif kind == "log r returns to a mean":
            log_r = 0.98 * log_r + 0.2 * rng.normal()
        y[t] = np.sqrt(h) * np.exp(0.5 * log_r) * z[t]
        h = 0.05 + 0.1 * y[t] ** 2 + 0.85 * h if kind == "GARCH(.1, .85)" else 1.0
    return y


KINDS = ("constant r", "GARCH(.1, .85)", "log r returns to a mean", "random walk of log r")


def garch(y, half):
    """Log densities and standardised innovations under the GARCH(1, 1) that is likeliest on the first half."""
    y = y - y[:half].mean()
    variance = y[:half].var()

    def recursion(x):
        a, b = np.exp(x[1:]) / (1.0 + np.exp(x[1:]).sum())
        h = np.empty(len(y))
        h[0] = variance
        for t in range(1, len(y)):
            h[t] = np.exp(x[0]) * (1.0 - a - b) + a * y[t - 1] ** 2 + b * h[t - 1]
        return -0.5 * (np.log(2.0 * np.pi * h) + y**2 / h), y / np.sqrt(h)

    start = np.log([variance, 2.0, 22.0])
    best = minimize(lambda x: -recursion(x)[0][:half].sum(), start, method="Nelder-Mead", options={"maxiter": 150})
    return recursion(best.x)


def scored(tracker, y):
    run = track(LEVEL, tracker, y, gate=False)
    return run.log_density, run.innovation / run.innovation_std


def moving(y, half):
    """The same with the volatility and the first r that are likeliest on the first half."""
    grid = [
        Kalman(q=0.0, r=r * y[:half].var(), volatility=v) for v in VOLATILITIES for r in (0.25, 0.5, 1.0, 2.0, 4.0)
    ]
    runs = track(LEVEL, grid, y[:half])
    best = max(runs, key=lambda run: run.loglik).tracker
    return scored(best, y)


def row(name, records):
    found = []
    for y in records:
        half = len(y) // 2
        for density, z in (
            scored(Kalman(q=0.0, r=y[:half].var()), y), garch(y, half), moving(y, half), scored(AdaptiveKalman(), y)
        ):
            found += [density[half:].mean(), np.mean(np.abs(z[half:]) < 1.96)]
    means = np.mean(np.reshape(found, (len(records), 4, 2)), axis=0)
    print(f"{name:26}" + "".join(f"{score:9.3f} ({inside:.3f})" for score, inside in means))


if __name__ == "__main__":
    print("mean log predictive density of the second half (share within 95 % bands)")
    print(f"{'':26}{'constant r':>17}{'GARCH(1, 1)':>17}{'volatility':>17}{'default':>17}")
    for kind in KINDS:
        row(kind, [simulated(kind, np.random.default_rng(seed)) for seed in range(RECORDS)])

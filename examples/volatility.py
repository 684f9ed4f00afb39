"""Noise whose variance moves: ``volatility`` of `Kalman` and of the default tracker against GARCH(1, 1).

Records of 2000 returns about a level: settings are estimated on the first half, by maximum likelihood, and judged on
the second. Four kinds are simulated; rows are means of four records. With `pip install arch` the data sets of that
package that are named as arguments, daily returns in per cent, take their place: sp500, nasdaq, wti.
"""

import sys
from importlib import import_module

import numpy as np
from scipy import stats
from scipy.optimize import minimize

from driftfit import AdaptiveKalman, Kalman, Regression, track

LEVEL = Regression(0, intercept=True)
T, RECORDS = 2000, 4
VOLATILITIES = 10.0 ** np.arange(-3.5, -0.9, 0.25)


def simulated(kind, rng):
    z, y, h, log_r = rng.normal(size=T), np.zeros(T), 1.0, 0.0
    for t in range(T):
        if kind == "random walk of log r":
            log_r += 0.05 * rng.normal()
        elif kind == "log r returns to a mean":
            log_r = 0.98 * log_r + 0.2 * rng.normal()
        y[t] = np.sqrt(h) * np.exp(0.5 * log_r) * z[t]
        h = 0.05 + 0.1 * y[t] ** 2 + 0.85 * h if kind == "GARCH(.1, .85)" else 1.0
    return y


KINDS = ("constant r", "GARCH(.1, .85)", "log r returns to a mean", "random walk of log r")


def garch(y, half, tail):
    """Log densities, and innovations over the half-widths of 95 % bands, under the GARCH(1, 1) that is likeliest on the
    first half; Student's with a ``tail``, normal without.
    """
    y = y - y[:half].mean()
    variance, squares = y[:half].var(), (y**2).tolist()

    def family(x):
        if not tail:
            return stats.norm
        nu = 2.05 + np.exp(x[3])
        return stats.t(nu, scale=np.sqrt(1.0 - 2.0 / nu))

    def recursion(x, T):
        a, b = np.exp(x[1:3]) / (1.0 + np.exp(x[1:3]).sum())
        h, rest = [variance], np.exp(x[0]) * (1.0 - a - b)
        for t in range(T - 1):
            h.append(rest + a * squares[t] + b * h[t])
        root = np.sqrt(h)
        return family(x).logpdf(y[:T] / root) - np.log(root), y[:T] / root

    start = [*np.log([variance, 2.0, 22.0]), *np.log([6.0] * tail)]
    best = minimize(lambda x: -recursion(x, half)[0].sum(), start, method="Nelder-Mead", options={"maxiter": 200}).x
    density, z = recursion(best, len(y))
    return density, z / family(best).ppf(0.975)


def scored(tracker, y):
    run = track(LEVEL, tracker, y, gate=False)
    return run.log_density, run.innovation / (1.96 * run.innovation_std)


def likeliest(grid, y, half):
    """The same with the settings that are likeliest on the first half."""
    runs = track(LEVEL, grid, y[:half], gate=False)
    return scored(max(runs.values(), key=lambda run: run.loglik).tracker, y)


def row(name, records):
    found = []
    for y in records:
        half, V = len(y) // 2, VOLATILITIES
        r = y[:half].var()
        for density, z in (
            scored(Kalman(q=0.0, r=r), y), garch(y, half, False), garch(y, half, True),
            likeliest([Kalman(q=0.0, r=r * k, volatility=v) for v in V for k in (0.25, 0.5, 1.0, 2.0, 4.0)], y, half),
            scored(AdaptiveKalman(), y), likeliest([AdaptiveKalman(volatility=v) for v in V], y, half),
        ):  # fmt: skip
            found += [density[half:].mean(), np.mean(np.abs(z[half:]) < 1.0)]
    means = np.mean(np.reshape(found, (len(records), 6, 2)), axis=0)
    print(f"{name:23}" + "".join(f"{score:8.3f} ({inside:.3f})" for score, inside in means))


def market(name):
    """Daily returns in per cent."""
    data = import_module(f"arch.data.{name}").load().dropna()
    prices = data["Adj Close"] if "Adj Close" in data else data.iloc[:, 0]
    returns = 100.0 * np.diff(np.log(prices[prices > 0.0].to_numpy()))
    return returns[np.isfinite(returns)]


print("mean log predictive density of the second half (share within 95 % bands)")
heads = "constant r", "GARCH(1, 1)", "with Student t", "volatility", "default", "its volatility"
print(" " * 23 + "".join(f"{head:>16}" for head in heads))
if sys.argv[1:]:
    for name in sys.argv[1:]:
        row(name, [market(name)])
else:
    for kind in KINDS:
        row(kind, [simulated(kind, np.random.default_rng(seed)) for seed in range(RECORDS)])

"""Counts and yes or no: constants beside statsmodels' GLM, and drifting parameters with their bands.

The first table is one record of 2000 samples with constant parameters: the estimates and standard errors of maximum
likelihood (statsmodels), and the last ones of `DynamicGLM` with q = 0 and a wide prior. In the second, parameters
drift, in 40 records: root mean square error of the best constant (the mean of the true path) and of the tracker, and
the share of 95 % bands that cover.
"""

import warnings

import numpy as np
import statsmodels.api as sm

from driftfit import DataWarning, DynamicGLM, Regression, track

ALPHA = 0.5
THEIRS = {
    "poisson": sm.families.Poisson(),
    "negative binomial": sm.families.NegativeBinomial(alpha=ALPHA),
    "logistic": sm.families.Binomial(),
}


def drawn(family, eta, rng):
    mu = np.exp(eta)
    if family == "poisson":
        return rng.poisson(mu)
    if family == "negative binomial":
        return rng.poisson(mu * rng.gamma(1.0 / ALPHA, ALPHA, len(mu)))
    return rng.random(len(eta)) < 1.0 / (1.0 + np.exp(-eta))


def main():
    warnings.simplefilter("ignore", DataWarning)  # a rare count looks like a fault code
    print(f"{'constants':20}{'statsmodels':>26}{'DynamicGLM':>26}")
    model = Regression(["b"], intercept=True)
    for family, theirs in THEIRS.items():
        rng = np.random.default_rng(0)
        x = rng.normal(size=2000)
        y = drawn(family, 0.5 * x - 0.5, rng).astype(float)
        fit = sm.GLM(y, np.c_[x, np.ones(2000)], family=theirs).fit()
        run = track(model, DynamicGLM(family, q=0.0, p0=100.0, alpha=ALPHA), y, x)
        for k, name in enumerate(run.names):
            ours = f"{run.theta[-1, k]:.4f} +- {run.std[-1, k]:.4f}"
            print(f"{family if k == 0 else '':18}{name:>10}{f'{fit.params[k]:.4f} +- {fit.bse[k]:.4f}':>22}{ours:>24}")
    print(f"\n{'drift':20}{'constant':>10}{'tracked':>10}{'in band':>10}")
    for family in THEIRS:
        found = []
        for seed in range(40):
            rng = np.random.default_rng(seed)
            x, T = rng.normal(size=500), 500
            theta = rng.normal(size=2) * 0.7 + np.cumsum(0.05 * rng.normal(size=(T, 2)), axis=0)
            y = drawn(family, theta[:, 0] * x + theta[:, 1] - 0.5, rng).astype(float)
            run = track(model, DynamicGLM(family, q=0.0025, p0=0.5, theta0=[0.0, -0.5], alpha=ALPHA), y, x)
            miss = run.theta - theta + [0.0, 0.5]
            inside = np.abs(miss) < 1.96 * run.std
            found.append([np.mean((theta - theta.mean(axis=0)) ** 2), np.mean(miss**2), inside.mean()])
        constant, tracked, inside = np.mean(found, axis=0)
        print(f"{family:20}{np.sqrt(constant):10.3f}{np.sqrt(tracked):10.3f}{inside:10.3f}")


if __name__ == "__main__":
    main()

"""Settings from a record: two coefficients, one a random walk and one constant.

Prints the estimates of each criterion and saves plots. Run: python examples/tuning.py [folder for pictures]
"""

import sys
from pathlib import Path

import numpy as np

from driftfit import FLS, RLS, AugmentedFLS, Kalman, Regression, frontier, tune


def simulate(T: int = 500, seed: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """y = theta1 u1 + theta2 u2 + noise: theta1 is a random walk with q = 0.01, theta2 is constant, r = 0.25."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, 2))
    theta = np.stack([np.cumsum(0.1 * rng.normal(size=T)), np.full(T, 1.0)], axis=1)
    return np.sum(u * theta, axis=1) + 0.5 * rng.normal(size=T), u


def main(folder: str | None = None) -> None:
    y, u = simulate()
    each = tune(Regression(2), Kalman(), y, u, groups="each")
    q, r = each.tracker.q, each.tracker.r
    print(f"Kalman, a drift each: q = {q[0]:.4f}, {q[1]:.1e}, r = {r:.3f}; log-likelihood {each.loglik:.1f}")
    for name in ("q[theta1]/r", "q[theta2]/r", "r"):
        low, high = each.interval[name]
        print(f"  95 % interval of {name}: {low:.2g} to {high:.2g}")
    one = tune(Regression(2), Kalman(), y, u)
    print(f"Kalman, one drift:    q = {one.tracker.q[0]:.4f}, r = {one.tracker.r:.3f}; log-likelihood {one.loglik:.1f}")
    for method in ("ml", "loo", "gcv", "h-step"):
        print(f"FLS, {method:6}: mu = {tune(Regression(2), FLS(), y, u, method=method).tracker.mu:.1f}")
    print(f"RLS, ml: forgetting = {tune(Regression(2), RLS(), y, u).tracker.forgetting:.3f}")
    ten = tune(Regression(2), AugmentedFLS(), y, u, method="h-step", h=10)
    print(f"AugmentedFLS for ten samples ahead: mu = {ten.tracker.mu:.1f}")
    if folder:
        each.plot().savefig(Path(folder) / "tuning.png", dpi=90)
        frontier(Regression(2), y, u).plot().savefig(Path(folder) / "frontier.png", dpi=90)


if __name__ == "__main__":
    main(*sys.argv[1:2])

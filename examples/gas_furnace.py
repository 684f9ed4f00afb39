"""A control record: the gas furnace of Box and Jenkins (series J), often shown as a record without drift.

Prints the verdict; then, for several orders, its p-value and that of an independent test, the largest
heteroscedasticity-robust Wald statistic of one break in all coefficients (Andrews, 1993) beside the same of constant
models driven by the record's own residuals with random signs (a wild bootstrap, which keeps their level over time).
Run: python examples/gas_furnace.py gas_furnace.csv (columns gas_rate and co2; not part of this package)
"""

import sys

import numpy as np
import polars as pl

from driftfit import ARX, AdaptiveKalman, track

DRAWS = 99
EDGE = 0.15


def rows(y: np.ndarray, u: np.ndarray, na: int, nb: int) -> tuple[np.ndarray, np.ndarray]:
    """Regressors and output of ARX(na, nb) with delay 3 and an intercept."""
    T, p = len(y), nb + 2
    lags = [*(y[p - k : T - k] for k in range(1, na + 1)), *(u[p - k : T - k] for k in range(3, p + 1))]
    return np.column_stack([*lags, np.ones(T - p)]), y[p:]


def fitted(X: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares: coefficients, residuals over their leverage, covariance that is robust to changing variance."""
    inverse = np.linalg.pinv(X.T @ X)
    theta = inverse @ X.T @ y
    e = (y - X @ theta) / (1.0 - np.einsum("ti,ij,tj->t", X, inverse, X))
    return theta, e, inverse @ (X.T @ (X * (e * e)[:, None])) @ inverse


def largest_wald(X: np.ndarray, y: np.ndarray) -> float:
    """Of all dates of a break that leave 15 % of the record on each side."""
    values = []
    for at in range(int(EDGE * len(y)), int((1.0 - EDGE) * len(y))):
        (before, _, left), (after, _, right) = fitted(X[:at], y[:at]), fitted(X[at:], y[at:])
        values.append((after - before) @ np.linalg.solve(left + right, after - before))
    return max(values)


def bootstrap(y: np.ndarray, u: np.ndarray, na: int, nb: int) -> tuple[float, float]:
    """The largest statistic, and the p-value."""
    X, later = rows(y, u, na, nb)
    theta, e, _ = fitted(X, later)
    rng, p, own = np.random.default_rng(0), nb + 2, largest_wald(X, later)
    exceeded = 0
    for _ in range(DRAWS):
        drawn, noise = y.copy(), e * rng.choice([-1.0, 1.0], size=len(e))
        for t in range(p, len(y)):
            lags = np.concatenate([drawn[t - na : t][::-1], X[t - p, na:]])
            drawn[t] = lags @ theta + noise[t - p]
        exceeded += largest_wald(*rows(drawn, u, na, nb)) >= own
    return own, (1 + exceeded) / (1 + DRAWS)


def main(path: str) -> None:
    data = pl.read_csv(path)
    y, u = data["co2"].to_numpy(), data["gas_rate"].to_numpy()
    for na, nb in ((2, 2), (3, 5), (4, 3)):
        run = track(ARX(na, nb, nk=3, intercept=True), AdaptiveKalman(), y="co2", u="gas_rate", data=data)
        found = run.verdict()
        if (na, nb) == (2, 2):
            print("\n".join(found.sentences))
        wald, p = bootstrap(y, u, na, nb)
        print(
            f"ARX({na}, {nb}): p = {found.p:.1g} with {found.lags} lags; largest Wald {wald:.0f}, bootstrap p = {p:.2g}"
        )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__.strip())
    main(sys.argv[1])

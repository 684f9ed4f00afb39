"""What a bank on `joint_noise().rows()` loses because its leaves do not share an unknown noise covariance.

Two outputs on one regressor, noises of correlation 0.96 and standard deviation 1.02, gains that change by (0.3, -0.3)
at 60 % of the record, or not at all. For every date of the change the evidence has a closed form: with R unknown
(matrix normal, inverse Wishart), with R as `joint_noise` estimates it from the whole record and known up to a factor,
which is what the leaves of a bank on its rows hold, and for an output alone. The change has the covariance R (x) 1 in
all of them. Prints how often the probability of a change passes one half, and how far log odds are from the exact ones.

Run: python benchmarks/joint_noise.py [--quick]
"""

import sys

import numpy as np

from driftfit import RLS, Regression, track

PRIOR = 0.01
"""Probability of a change at a sample."""


def odds(u: np.ndarray, Y: np.ndarray, score) -> float:
    """Log odds of one change at any date against none; ``score(S)`` is the log evidence of the rest S (ny, ny)."""
    ny, T = Y.shape[1], len(u)

    def evidence(X: np.ndarray, V: np.ndarray) -> float:
        inner = X.T @ X + np.diag(1.0 / V)
        S = Y.T @ Y - Y.T @ X @ np.linalg.solve(inner, X.T @ Y)
        return -0.5 * ny * (np.linalg.slogdet(inner)[1] + np.log(V).sum()) + score(S, T)

    none = evidence(u[:, None], np.array([1e6]))
    dates = range(1, T)
    each = [evidence(np.column_stack([u, u * (np.arange(T) >= d)]), np.array([1e6, 1.0])) for d in dates]
    top = max(each)
    return top + np.log(np.exp(np.array(each) - top).sum()) + np.log(PRIOR / (1.0 - PRIOR)) - none


def of_record(T: int, jump: float, seed: int) -> list[float]:
    """Log odds: exact, with an estimate of R, and of each output alone."""
    rng = np.random.default_rng(seed)
    u, common = rng.standard_normal(T), rng.standard_normal(T)
    gains = np.where(np.arange(T)[:, None] < 0.6 * T, [1.0, 2.0], [1.0 + jump, 2.0 - jump])
    Y = gains * u[:, None] + common[:, None] + 0.2 * rng.standard_normal((T, 2))
    R = track(Regression(1, ny=2), RLS(0.98), Y, u[:, None]).joint_noise().cov[-1]
    white = Y @ np.linalg.inv(np.linalg.cholesky(R)).T
    alone = lambda S, T: -0.5 * T * np.log(S[0, 0])  # noqa: E731
    return [
        odds(u, Y, lambda S, T: -0.5 * T * np.linalg.slogdet(S)[1]),
        odds(u, white, lambda S, T: -T * np.log(np.trace(S))),
        *(odds(u, Y[:, [k]], alone) for k in (0, 1)),
    ]


def main() -> None:
    runs = 1 if "--quick" in sys.argv else 100
    print("samples   change   R unknown   R estimated   outputs alone   log odds, median distance")
    for T in (30, 60, 120):
        for jump in (0.3, 0.0):
            found = np.array([of_record(T, jump, seed) for seed in range(runs)])
            exact, rows, first, second = (found > 0.0).mean(axis=0)
            away = np.median(np.abs(found[:, 1] - found[:, 0]))
            kind = "yes" if jump else "no"
            print(f"{T:7} {kind:>8} {exact:11.2f} {rows:13.2f} {first:9.2f} {second:5.2f} {away:22.1f}", flush=True)


if __name__ == "__main__":
    main()

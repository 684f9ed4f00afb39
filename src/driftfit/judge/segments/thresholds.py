"""The gain of log-likelihood that a break requires in correlated noise.

    g_b                                            gain from a break at b, chi-square with n degrees of freedom
    1, 1 - a_1, 1 - a_1 - a_2, ..., E, E, ...      a whitened step, E = 1 - sum a
    lambda_b = (1 + sum a_k^2) / 2 / (sum of the squares before E + E^2 b (N - b) / N)

lambda_b is one less the correlation of the steps at b and b + 1. In white noise it is N / (2 b (N - b)), and
neighbouring places are nearly the same test; if E is small each place is a test by itself. The probability that g_b
exceeds c anywhere is, for discrete places,

    P(chi2_n > c) c sum_b lambda_b nu(sqrt(2 c lambda_b))
    nu(x) = (2 / x) (Phi(x/2) - 1/2) / (x/2 Phi(x/2) + phi(x/2))

and for two breaks together P(chi2_2n > c) c^2 n / (4 (n + 1)) times the sum of the products over pairs, since on
average n / (4 (n + 1)) of a direction in 2 n dimensions is left for each of two moving halves. Both are larger by the
factor 1 + 4 (1 + sum a) / (1 - sum a) / N because a is estimated: (1 + sum a) / (1 - sum a) / N is the variance of
log(1 - sum a) for p = 1, and four of it is what simulated records with a of 0.3 to 0.9 need.

Source: Siegmund (1985), Siegmund and Yakir (2007). Departure: regressors other than a constant are treated as one,
which has the largest share in common with the noise. Cost: O(N).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import scipy

from driftfit.engine.kernel import Array

ESTIMATED = 4.0
LARGEST = 0.97


@lru_cache(4096)
def thresholds(N: int, n: int, least: int, quiet: float, ar: tuple[float, ...]) -> tuple[float, float]:
    """Gains, in units of the noise variance, that one break and two together exceed by chance in ``quiet`` records.

    ``least``: rows in a segment; ``ar`` (p,): autoregression of the noise.
    """
    a = np.array(ar)
    step = np.concatenate([[1.0], 1.0 - np.cumsum(a)])
    first, final, move = float(step[:-1] @ step[:-1]), float(step[-1] ** 2), 0.5 * (1.0 + float(a @ a))

    def chances(c: float, place: Array) -> Array:
        """lambda nu of a break with ``place`` samples before it or after."""
        rate = move / (first + final * place * (N - place) / N)
        x = np.sqrt(2.0 * c * rate)
        half = scipy.special.ndtr(0.5 * x)
        density = np.exp(-x * x / 8.0) / np.sqrt(2.0 * np.pi)
        return rate * (2.0 / x) * (half - 0.5) / (0.5 * x * half + density)  # type: ignore[no-any-return]

    places = np.arange(least, max(N - least, least + 1) + 1.0)
    lengths = places[: max(len(places) - least, 1)]

    def one(c: float) -> float:
        return float(scipy.special.gammaincc(0.5 * n, 0.5 * c) * c * chances(c, places).sum())

    def two(c: float) -> float:
        pairs = N * (chances(c, lengths) ** 2).sum() + 0.5 * chances(c, places).sum() ** 2
        return float(scipy.special.gammaincc(n, 0.5 * c) * c * c * pairs * n / (4.0 * (n + 1.0)))

    total = min(float(a.sum()), LARGEST)
    larger = 1.0 + ESTIMATED * (1.0 + total) / (1.0 - total) / N if total > 0.0 else 1.0
    return larger * _exceeded(one, quiet), larger * _exceeded(two, quiet)


def _exceeded(chance: Callable[[float], float], quiet: float) -> float:
    from scipy import optimize  # with ndimage a quarter of the time of importing the package

    return float(optimize.brentq(lambda c: chance(c) - quiet, 4.0, 1000.0))

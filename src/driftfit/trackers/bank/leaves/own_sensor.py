"""Sensors with a likelihood of the user's own: `driftfit.Sensor.own`.

A plain function of numbers says, for one leaf, what a reading y is worth,

    log p(y),  a,  clean = likelihood(y, y_hat, h, r, last)

y_hat = z'm and h = z'C z being the leaf's forecast without noise, r the noise variance of the nominal sensor (of this
leaf, where it is unknown) and last the last output seen. The leaf is updated as by a measurement with noise variance a,

    K = C z / (h + a),     m+ = m + K (y - y_hat),     C+ = C - K (C z)'

so that C stays a covariance whatever the function says; a = inf learns nothing of theta (counted as `LARGEST` (h + r)).
``clean`` goes into the leaf's output lags, if the sensor ``cleans``.

The function is compiled into a machine of its own, once on a computer: the machine of `advance` with `own_likelihood`
exchanged for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, core, kernel, part
from driftfit.trackers.bank.leaves.leaves import FIRST, NU, S

LARGEST = 1e12
"""Noise variances beyond this multiple of the forecast's count as this one, which moves nothing."""


@part
def own_likelihood(which: float, y: float, y_hat: float, h: float, r: float, last: float) -> tuple[float, float, float]:
    """The place of the functions that users give, numbered from 1."""
    return -np.inf, np.inf, y


@kernel
def judged(
    B: Array, at: int, l: int, expected: Array, h: float, y: float, noise: float, unknown: bool, last: float,
    which: float,
) -> tuple[float, float, float]:  # fmt: skip
    """What the function says of column l, its noise variance in the units of C."""
    unit = B[S, at + l] / (B[NU, at + l] - 2.0) if unknown else 1.0
    log_p, a, clean = own_likelihood(which, y, expected[1, l], h * unit, noise * unit, last)
    most = LARGEST * (h + noise)
    a = a / unit if a < most * unit else most
    return log_p if log_p == log_p else -np.inf, a, clean


@core
def add_noise(
    B: Array, at: int, columns: int, expected: Array, y: float, noise: float, unknown: bool, last: float, which: float,
    X: Array, row: int,
) -> None:  # fmt: skip
    """h + a in the place of h, which is kept in a row of X."""
    for l in range(columns):
        h = expected[0, l]
        _, a, _ = judged(B, at, l, expected, h, y, noise, unknown, last, which)
        X[row, l], expected[0, l] = h, h + a


@core
def weigh_own(
    B: Array, at: int, columns: int, expected: Array, y: float, noise: float, unknown: bool, last: float, which: float,
    X: Array, row: int,
) -> None:  # fmt: skip
    """The log densities in the place of what `add_noise` kept, which is given back."""
    for l in range(columns):
        expected[0, l] = X[row, l]
        X[row, l], _, _ = judged(B, at, l, expected, expected[0, l], y, noise, unknown, last, which)


@core
def clean_lags(
    B: Array, at: int, columns: int, n: int, expected: Array, y: float, noise: float, unknown: bool, last: float,
    which: float,
) -> None:  # fmt: skip
    """The newest output lag as the function has it."""
    lag = FIRST + n + n * (n + 1) // 2
    for l in range(columns):
        _, _, clean = judged(B, at, l, expected, expected[0, l], y, noise, unknown, last, which)
        B[lag, at + l] = clean if abs(clean) < np.inf else y


def chosen(functions: Sequence[Callable[..., Any]]) -> Any:
    """What takes the place of `own_likelihood`: the function by its number."""
    first = functions[0] if hasattr(functions[0], "identity") else kernel(functions[0])
    if len(functions) == 1:

        @part
        def one(
            which: float, y: float, y_hat: float, h: float, r: float, last: float
        ) -> tuple[float, float, float]:  # fmt: skip
            return first(y, y_hat, h, r, last)  # type: ignore[no-any-return]

        return one
    others = chosen(functions[1:])

    @part
    def one_of_them(
        which: float, y: float, y_hat: float, h: float, r: float, last: float
    ) -> tuple[float, float, float]:  # fmt: skip
        if which == 1.0:
            return first(y, y_hat, h, r, last)  # type: ignore[no-any-return]
        return others(which - 1.0, y, y_hat, h, r, last)  # type: ignore[no-any-return]

    return one_of_them

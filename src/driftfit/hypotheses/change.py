"""Change hypotheses: what may happen to theta between two samples.

    theta <- (1 - reset) theta + reset theta0,      C <- C / forget + Q        (reset: C <- P0)

Q is `q` in squared units of theta, or free of scale, Q_ii = size^2 r / c_i: with r the noise variance and c_i the mean
square of regressor i, a change of one standard deviation moves the output by `size` standard deviations of the noise.
r / c_i is what a single sample tells of parameter i alone, so `size` counts in the parameters' own uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.kernel import Array
from driftfit.settings import Settings, covariance, matrix, numbers, vector


@dataclass(frozen=True)
class Change(Settings):
    """One hypothesis of how theta develops.

    Parameters
    ----------
    q : number, (k,), (k, k)
        Drift covariance per nominal sample, k being the number of parameters that ``which`` lists (all by default).
    size : number, (k,) or None
        Free of scale, in place of q: standard deviation of the move in units of sqrt(r / c_i).
    prob : number or None
        Prior probability at every sample; None is what the others leave.
    which : indices or None
        The parameters that move; None is all.
    forget : number in (0, 1]
        Exponential forgetting: the covariance is divided by it.
    reset : bool
        A new segment: theta is forgotten, and its prior takes its place. q is then the covariance of that prior.
    name : str
        What tables and plots call it.

    Raises
    ------
    ValueError
        If q is no covariance, prob no probability, forget outside (0, 1], or both q and size are given.
    """

    q: Any = None
    prob: float | None = None
    which: Any = None
    size: Any = None
    forget: float = 1.0
    reset: bool = False
    name: str = ""

    def __post_init__(self) -> None:
        if self.q is not None and self.size is not None:
            raise ValueError(f"Change: give q or size, not both; got q={self.q!r} and size={self.size!r}.")
        if self.q is not None:
            self._set("q", covariance("Change", "q", self.q))
        if self.size is not None:
            self._set("size", numbers("Change", "size", self.size, low=0.0))
        if self.prob is not None:
            self._set("prob", probability("Change", self.prob))
        if self.which is not None:
            which = [self.which] if isinstance(self.which, int) else list(self.which)
            if not which or len(set(which)) < len(which) or any(int(i) != i or i < 0 for i in which):
                raise ValueError(f"Change: which must list different indices from 0; got {self.which!r}.")
            self._set("which", tuple(int(i) for i in which))
        self._set("forget", numbers("Change", "forget", self.forget, ndim=0, low=0.0, strict=True))
        if self.forget > 1.0:
            raise ValueError(f"Change: forget must be in (0, 1]; got {self.forget!r}.")
        if self.reset and self.q is None:
            raise ValueError("Change: reset=True needs q=, the covariance of the prior of the new segment.")

    def increments(self, n: int) -> tuple[Array, Array]:
        """(Q, squared sizes): the fixed increment (n, n), and (n,) in units of r / c_i."""
        which = list(range(n)) if self.which is None else list(self.which)
        if max(which) >= n:
            raise ValueError(f"Change: which names parameter {max(which)}, but the model has {n} (0 .. {n - 1}).")
        Q, sizes = np.zeros((n, n)), np.zeros(n)
        if self.q is not None:
            Q[np.ix_(which, which)] = matrix("Change", "q", self.q, len(which))
        if self.size is not None:
            sizes[which] = vector("Change", "size", self.size, len(which)) ** 2
        return Q, sizes


def probability(owner: str, value: Any) -> float:
    """Check a probability."""
    checked = float(numbers(owner, "prob", value, ndim=0, low=0.0))
    if checked > 1.0:
        raise ValueError(f"{owner}: prob must be within [0, 1]; got {value!r}.")
    return checked


DRIFT, JUMP, RARELY = 0.003, 5.0, 0.01
"""Sizes of the drift and of the jump of a bank that is given no changes, and how often that jumps."""


def usual() -> tuple[Change, ...]:
    """A small drift, and a jump once in a hundred samples."""
    return Change(size=DRIFT, name="drift"), Change(size=JUMP, prob=RARELY, name="jump")

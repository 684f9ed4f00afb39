"""Change hypotheses: a possible change of theta between two samples.

    theta <- theta,       C <- C + Q                  random walk ("linear forgetting"); Q = 0: nothing
    theta <- theta,       C <- C / forget + Q         exponential forgetting, and two other kinds of forgetting
    theta <- theta0,      C <- Q                      reset: a new segment

Q is `q` in squared units of theta, or scale-free, Q_ii = size^2 r / c_i. With r the noise variance and c_i the mean
square of regressor i, a change of one standard deviation then moves the output by `size` standard deviations of the
noise. r / c_i is the variance that a single sample leaves of parameter i alone, so `size` is in units of that
uncertainty. The formulas of forgetting are in `driftfit.bank.leaves.forget`.

With one change and one sensor the bank is a single filter: Change(q) is `Kalman`, Change(0) least squares,
Change(forget=lam) is `RLS`, Change(forget=lam, kind="directional") `RLS` with directional forgetting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from driftfit.bank.leaves import forget
from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, covariance, matrix, numbers, one_of, plain, vector


@dataclass(frozen=True)
class Change(Settings):
    """One hypothesis about how theta changes.

    Parameters
    ----------
    q : number, (k,), (k, k)
        Drift covariance per nominal sample, where k is the number of parameters in ``which`` (by default all).
    size : number, (k,) or None
        Scale-free, instead of q: standard deviation of the change in units of sqrt(r / c_i).
    prob : number or None
        Prior probability at every sample; None is the remainder of the others. If it is None for all of several
        changes, and there is no transition, they are learned (`driftfit.bank.prior`).
    which : indices or None
        The parameters that change; None is all.
    forget : number in (0, 1]
        Forgetting factor per nominal sample.
    kind : "exponential", "directional" or "stabilised"
        Forget in all directions alike; only in the direction of the last regressor; or in all directions, towards
        N(theta0, anchor).
    anchor : number, (n,), (n, n) or None
        For "stabilised": the positive definite covariance to which the parameters return; it bounds theirs.
    reset : bool
        A new segment: the parameters in ``which`` are forgotten and get a new prior with mean ``theta0`` of the bank
        and covariance q.
    name : str
        The name in tables and plots.

    Raises
    ------
    ValueError
        If q is not a covariance, prob not a probability, forget outside (0, 1], both q and size are given, or settings
        of different kinds of change are mixed.
    """

    q: Any = None
    prob: float | None = None
    which: Any = None
    size: Any = None
    forget: float = 1.0
    kind: str = "exponential"
    anchor: Any = None
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
        self._check_forgetting()
        if self.reset and self.q is None:
            raise ValueError("Change: reset=True needs q=, the covariance of the prior of the new segment.")

    def _check_forgetting(self) -> None:
        kind = one_of("Change", "kind", self.kind, ("exponential", "directional", "stabilised"))
        if (kind == "stabilised") != (self.anchor is not None):
            raise ValueError(
                f'Change: kind="stabilised" and anchor= belong together; got kind={kind!r}, anchor={self.anchor!r}.'
            )
        if self.anchor is not None:
            self._set("anchor", covariance("Change", "anchor", self.anchor))
            A = np.asarray(self.anchor)
            if not (np.linalg.eigvalsh(A) if A.ndim == 2 else A).min() > 0.0:
                raise ValueError(f"Change: anchor must be positive definite; got {self.anchor!r}.")
        if self.reset and self.forget != 1.0:
            raise ValueError(f"Change: give forget or reset, not both; got forget={self.forget!r}, reset=True.")

    @classmethod
    def unknown(cls, drift: float = 0.003, sizes: Sequence[float] = (0.5, 5.0, 50.0, 500.0)) -> tuple[Change, ...]:
        """Changes of a bank that learns how large jumps are and how often they happen: a scale-free drift, and jumps of
        sizes that are powers of ten apart.
        """
        return cls(size=drift, name="drift"), *(cls(size=size, name=f"jump {size:g}") for size in sizes)

    @property
    def forgets(self) -> bool:
        """Whether it is anything other than a random walk."""
        return self.reset or self.forget < 1.0

    @property
    def resets_some(self) -> bool:
        """Whether it resets some parameters, and not all."""
        return self.reset and self.which is not None

    def mapping(self) -> tuple[float, float, float, float]:
        """The row of `driftfit.bank.leaves.forget` for this change."""
        kinds = {
            "exponential": forget.EXPONENTIAL, "directional": forget.DIRECTIONAL, "stabilised": forget.STABILISED,
        }  # fmt: skip
        kind = kinds[self.kind] if self.forget < 1.0 else forget.WALK
        if self.resets_some:
            kind = forget.PARTIAL
        keep = 0.0 if self.reset and not self.resets_some else 1.0 / self.forget
        return keep, float(keep == 0.0), float(kind), float(np.log(self.forget))

    def anchors(self, n: int, unit: float) -> Array:
        """(n, n): the numbers that the module stores of it; covariances are multiplied by ``unit``."""
        rows = np.zeros((n, n))
        if self.anchor is not None:
            rows = forget.anchors_of(matrix("Change", "anchor", self.anchor, n) * unit)
        elif self.resets_some:
            rows = np.eye(n)
            rows[list(self.which), list(self.which)] = 0.0
        return rows

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

    def scales(self) -> tuple[Array, Array]:
        """q and sizes as given, 0 where they were not."""
        return np.asarray(self.q or 0.0, float), np.asarray(self.size or 0.0, float)

    def scaled(self, factor: float) -> Change:
        """The same change with standard deviations ``factor`` times as large."""
        q, size = self.scales()
        return replace(
            self, q=None if self.q is None else plain(factor * factor * q),
            size=None if self.size is None else plain(factor * size),
        )  # fmt: skip


def probability(owner: str, value: Any) -> float:
    """Check a probability."""
    checked = float(numbers(owner, "prob", value, ndim=0, low=0.0))
    if checked > 1.0:
        raise ValueError(f"{owner}: prob must be within [0, 1]; got {value!r}.")
    return checked


DRIFT, JUMP, RARELY = 0.003, 5.0, 0.01
"""Sizes of the drift and of the jump of a bank without given changes, and the probability of that jump."""


def usual() -> tuple[Change, ...]:
    """A small drift, and a jump once in a hundred samples."""
    return Change(size=DRIFT, name="drift"), Change(size=JUMP, prob=RARELY, name="jump")

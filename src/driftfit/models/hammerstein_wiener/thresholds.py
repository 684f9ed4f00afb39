"""Input curves with two thresholds p2 <= 0 <= p1, which are among their coefficients (1, p1, p2).

    DeadZone(u_max)      f = ([u>=p1] + [u<=p2]) u, -[u>=p1], -[u<=p2]
    Saturation(u_max)    f = [p2<u<p1] u, [u>=p1], [u<=p2]

The functions of an input take the thresholds from the estimates of the sample before it, limited to 0 .. 0.97 u_max and
-0.97 u_max .. 0: a Gauss-Newton step in p. Parameters learned while they are wrong are wrong, so the tracker must
forget: with q = 0 they approach the truth only as fast as the share of those samples falls.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, one_of
from driftfit.models.hammerstein_wiener import curve_kernels
from driftfit.models.hammerstein_wiener.basis import Basis
from driftfit.models.hammerstein_wiener.structure import Structure

INSIDE = 0.97
"""Limit of the thresholds, as a share of u_max."""


@dataclass(frozen=True)
class Thresholds(Basis):
    """The common part of dead zone and saturation."""

    u_max: float
    start: Any = None
    fed: str = "least-squares"

    adaptive: ClassVar[bool] = True
    begins: ClassVar[float]
    """Initial value of the thresholds, as a share of u_max, by default."""

    def __post_init__(self) -> None:
        owner = type(self).__name__
        self._set("u_max", numbers(owner, "u_max", self.u_max, ndim=0, low=0.0, strict=True))
        start = self.begins * self.u_max if self.start is None else self.start
        self._set("start", numbers(owner, "start", start, ndim=0, low=0.0))
        one_of(owner, "fed", self.fed, ("least-squares", "average"))

    @property
    def n(self) -> int:
        return 3

    @property
    def parameters(self) -> Array:
        return np.array([self.start, -self.start, self.u_max, float(self.fed == "average")])

    @property
    def expected(self) -> tuple[float, float]:
        return (-self.u_max, self.u_max)

    def for_coefficients(self, x: Any, c: Array) -> Array:
        u = np.asarray(x, dtype=float)
        return self.split(u, u >= c[..., 1] / c[..., 0], u <= c[..., 2] / c[..., 0])

    @abstractmethod
    def split(self, u: Array, above: Array, below: Array) -> Array:
        """The functions (.., 3), given which inputs are above and below the thresholds."""


@dataclass(frozen=True)
class DeadZone(Thresholds):
    """A dead zone between p2 < 0 < p1: v = u - p1 above it, u - p2 below, 0 inside; an input block only.

    A valve ends where it is fully open: u beyond ``limit`` acts as the limit does.

    Parameters
    ----------
    u_max : number
        The largest size of the input, above 0.
    start : number
        Initial size of both thresholds.
    fed : "least-squares" or "average"
        A filter of products has nb estimates of each threshold, the products b_j p1 together with the b_j. They are fed
        back as sum_j b_j (b_j p1) / sum_j b_j^2, or as the mean over j of (b_j p1) / b_j, as in Feng and Hong (2021),
        which fails for a b_j near zero. With minimal parameters (`ExtendedKalman`) p1 and p2 are estimated themselves.
    limit : number or None
        Known size beyond which the input has no further effect, as the 10 V of equation (61) of Feng and Hong (2021).

    Raises
    ------
    ValueError
        For a u_max or a limit that is not above 0, a start below 0, or another ``fed``.
    """

    start: Any = 0.01
    limit: float | None = None

    functions: ClassVar[Any] = staticmethod(curve_kernels.dead_zone)
    begins: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limit is not None:
            self._set("limit", numbers("DeadZone", "limit", self.limit, ndim=0, low=0.0, strict=True))

    @property
    def parameters(self) -> Array:
        return np.append(super().parameters, self.reach)

    @property
    def reach(self) -> float:
        """Size beyond which the input has no further effect."""
        return LARGEST if self.limit is None else self.limit

    @property
    def names(self) -> tuple[str, ...]:
        return ("outside", "p1", "p2")

    def split(self, u: Array, above: Array, below: Array) -> Array:
        known, held = np.where(np.isfinite(u), 0.0, np.nan), np.clip(u, -self.reach, self.reach)
        return np.stack([np.where(above | below, held, known), -1.0 * above, -1.0 * below], axis=-1)


@dataclass(frozen=True)
class Saturation(Thresholds):
    """A saturation at p2 < 0 < p1: v = u between them, p1 above, p2 below; an input block only.

    Parameters as for `DeadZone`; the thresholds begin at half of u_max unless ``start`` is given. A threshold that no
    input reaches converges to about the largest input.
    """

    functions: ClassVar[Any] = staticmethod(curve_kernels.saturation)
    begins: ClassVar[float] = 0.5

    @property
    def names(self) -> tuple[str, ...]:
        return ("inside", "p1", "p2")

    def split(self, u: Array, above: Array, below: Array) -> Array:
        known = np.where(np.isfinite(u), 0.0, np.nan)
        return np.stack([np.where(above | below, known, u), 1.0 * above, 1.0 * below], axis=-1)


PASSES = 20
STILL = 1e-6
"""The thresholds stay if they move by less than this share of u_max."""


def settled(
    phi: Array, y: Array, u: Array, at: Array, bases: Sequence[Basis], delays: Sequence[int], s: Structure
) -> Array:
    """The regressors of a record with the thresholds held at one value: see `driftfit.models.base.Model.settled`.

    In the stream the functions of the first inputs are those of wrong thresholds, and constants that explain the later
    rows do not explain these, which looks like a change. Here theta is fitted to all rows, the thresholds follow from
    its products, p_k = sum_j b_j (b_j p_k) / sum_j b_j^2, and the functions from the thresholds, until these stay. With
    thresholds at which a gain has no regressor, as those of a saturation at (0, 0), they begin again at their start.
    Cost: a least squares fit of N rows per pass.
    """
    phi = phi.copy()
    last = {i: np.full(2, np.inf) for i, basis in enumerate(bases) if isinstance(basis, Thresholds)}
    for _ in range(PASSES if len(at) else 0):
        theta = np.linalg.lstsq(phi, y)[0]
        moved, b, products = 0.0, s.na, s.starts[1]
        for i, basis in enumerate(bases):
            nb = s.nb[i]
            if isinstance(basis, Thresholds):
                unseen = not phi[:, b : b + nb].any()  # no input is where its gain can be learned
                gain, each = theta[b : b + nb], theta[products : products + 2 * nb].reshape(2, nb)
                limit = INSIDE * basis.u_max
                found = basis.parameters[:2] if unseen else each @ gain / max(float(gain @ gain), 1e-300)
                found = np.clip(found, [0.0, -limit], [limit, 0.0])
                moved = max(moved, float(np.max(np.abs(found - last[i]))) / basis.u_max)
                last[i] = found
                f = -basis.split(u[:, i], u[:, i] > found[0], u[:, i] < found[1])  # as in the rows of the model
                lagged = np.stack([f[at - delays[i] - j] for j in range(nb)], axis=1)
                phi[:, b : b + nb] = lagged[:, :, 0]
                phi[:, products : products + 2 * nb] = lagged[:, :, 1:].transpose(0, 2, 1).reshape(len(at), 2 * nb)
            b, products = b + nb, products + nb * (basis.n - 1)
        if moved < STILL:
            break
    return phi

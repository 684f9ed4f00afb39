"""The system behind a run in continuous time, and back, with bands.

    y_t = z^-k B(z) / A(z) u_t      <->      y(t) = B(s) / A(s) u(t - delay),   delay = (k - 1) dt

for inputs that are held between samples (zero-order hold). With companion matrices of the same order n,

    expm([[F, g], [0, 0]] dt) = [[Phi, gamma], [0, 1]]        logm goes back

A discrete pole p is exp(s dt): it needs p > 0 or a complex pair, and 0 <= w dt < pi for the logarithm to be the right
one. Standard deviations follow by the delta method (`driftfit.use.system`), on joint covariances, so that there
and back again is where it began.

Source: Astrom and Wittenmark, Computer-Controlled Systems (1997), section 2.4. Cost: O(n^4) for one sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers
from driftfit.models.continuous.sampling import matrices, polynomials, sampled
from driftfit.models.continuous.transfer import ContinuousTransfer
from driftfit.use.system import Followed, Response, input_of, jacobian, linear, taken


@dataclass(frozen=True, eq=False)
class Transfer:
    """B(p) / A(p), A = p^n + a_1 p^(n-1) + .., B = b_1 p^(n-1) + .. + b_n, with p = s or z, and a delay.

    Attributes
    ----------
    a, b : (n,)
        Coefficients.
    cov : (2 n, 2 n)
        Covariance of (a, b); NaN where it is not known.
    delay : float
        In the unit of dt; in discrete time whole samples times dt.
    dt : float or None
        Time between samples; None for continuous time.
    """

    a: Array
    b: Array
    cov: Array
    delay: float
    dt: float | None = None

    @property
    def a_std(self) -> Array:
        return np.asarray(np.sqrt(np.diag(self.cov)[: len(self.a)]))

    @property
    def b_std(self) -> Array:
        return np.asarray(np.sqrt(np.diag(self.cov)[len(self.a) :]))

    def _mapped(self, f: Any) -> tuple[Array, Array]:
        """f of (a, b), and its covariance."""
        x = np.concatenate([self.a, self.b])
        J = jacobian(lambda rows: np.array([f(row) for row in rows]), x[None], np.sqrt(np.abs(np.diag(self.cov)))[None])
        return f(x), J[0] @ self.cov @ J[0].T

    def time_constants(self) -> Response:
        """1 / |s| of every pole of a continuous system, the slowest first, with their standard deviations."""
        if self.dt is not None:
            raise ValueError("time_constants: convert to continuous time first.")
        n = len(self.a)
        value, cov = self._mapped(lambda x: np.sort(1.0 / np.abs(np.roots(np.append(1.0, x[:n]))))[::-1])
        return Response(value, np.sqrt(np.diag(cov)))

    def discrete(self, dt: float) -> Transfer:
        """The system for inputs held over dt; ValueError if it is discrete already."""
        step = float(numbers("discrete", "dt", dt, ndim=0, low=0.0, strict=True))
        if self.dt is not None:
            raise ValueError("discrete: this system is in discrete time already.")
        n = len(self.a)
        x, cov = self._mapped(lambda x: sampled(x[:n], x[n:], step))
        return Transfer(x[:n], x[n:], cov, self.delay, step)

    def continuous(self) -> Transfer:
        """The system whose samples these are; ValueError if there is none, or it is continuous already."""
        if self.dt is None:
            raise ValueError("continuous: this system is in continuous time already.")
        n, step = len(self.a), self.dt
        x, cov = self._mapped(lambda x: _between(x[:n], x[n:], step))
        return Transfer(x[:n], x[n:], cov, self.delay)


def _between(a: Array, b: Array, dt: float) -> Array:
    from scipy import linalg

    Phi, gamma = matrices(a, b)
    n = len(a)
    poles = np.linalg.eigvals(Phi)
    if np.any((np.abs(poles.imag) < 1e-12) & (poles.real <= 1e-12)):
        raise ValueError(
            f"continuous: no continuous system has a pole at {poles.real.min():.3g} when it is sampled; "
            "sample faster, or take a lower order."
        )
    whole = np.eye(n + 1)
    whole[:n, :n], whole[:n, n] = Phi, gamma
    moved = linalg.logm(whole).real / dt
    return polynomials(moved[:n, :n], moved[:n, n])


def _own(model: ContinuousTransfer, theta: Array, cov: Array, j: int) -> Transfer:
    """The system of a model that is in continuous time itself."""
    n, m = model.poles, model.zeros + 1
    places = np.r_[:n, n + j * m : n + (j + 1) * m]
    taken_from = np.zeros((2 * n, len(places)))
    taken_from[np.r_[:n, 2 * n - m : 2 * n], np.arange(len(places))] = 1.0
    x = taken_from @ theta[places]
    return Transfer(x[:n], x[n:], taken_from @ cov[np.ix_(places, places)] @ taken_from.T, model.delay * model.dt)


def transfer(run: Followed, dt: float = 1.0, input: int | str = 0, at: int = -1) -> Transfer:
    """The system of one sample from one input, in discrete time with its covariance; `Transfer.continuous` converts it.

    That of a `ContinuousTransfer` is in continuous time, and ``dt`` has no effect; `Transfer.discrete` converts it.

    Raises
    ------
    ValueError
        For a model without transfer functions, or one whose output depends on the present input (nk = 0).
    """
    model, j = linear(run), input_of(run, input)
    step = float(numbers("transfer", "dt", dt, ndim=0, low=0.0, strict=True))
    theta, cov = taken(run, at)
    if isinstance(model, ContinuousTransfer):
        return _own(model, theta[0], cov[0], j)
    B, A = model.transfers(theta)[1][j]
    size = B.shape[-1]
    delay = int(np.argmax(np.append(B[0] != 0.0, True)))
    if delay == 0 or size <= delay:
        raise ValueError(
            "transfer: the output must depend on past inputs only, and on one of them; use nk of at least 1."
        )
    n = max(A.shape[-1] - 1, size - delay)

    def coefficients(rows: Array) -> Array:
        b, a = model.transfers(rows)[1][j]
        found = np.zeros((len(rows), 2 * n))
        found[:, : a.shape[-1] - 1] = a[:, 1:]
        found[:, n : n + size - delay] = b[:, delay:]
        return found

    J = jacobian(coefficients, theta, np.sqrt(np.abs(np.einsum("tii->ti", cov))))[0]
    x = coefficients(theta)[0]
    return Transfer(x[:n], x[n:], J @ cov[0] @ J.T, (delay - 1) * step, step)

"""Which parameters move, once it is known that some do: steps are explained one after the other.

    1. of the parameters whose own path rejects constancy (Holm's correction), take the one with the furthest path
    2. give it a step at its date: one more regressor, phi_i from that sample on
    3. test again; until no parameter rejects, or MOST steps are there

A large move of one parameter changes the regressors of an ARX model and its residuals, and makes the paths of others
look moved too; once the step is in the regression those are still again. A slow drift takes several steps of the same
parameter. What is reported is the parameter before its first and after its last step. Bai and Perron (1998) estimate
several breaks in all parameters that way, one after the other; here each step belongs to one parameter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.judges.constancy import EDGE, Constancy, constancy, robust_fit
from driftfit.kernel import Array

MOST = 12
NEAR = 0.01
"""Steps of one parameter within this share of the record are the same step."""


class Step(NamedTuple):
    """A parameter of the n, and the sample (of the N) from which on it is another."""

    parameter: int
    at: int


class Attribution(NamedTuple):
    """What moves."""

    p: Array
    """(n,): p-value of each parameter when it was named, or at the end where it was not."""
    steps: tuple[Step, ...]
    """In the order in which they were found."""
    before: Array
    """(n,): value before its first step; constant value of those that have none."""
    after: Array
    """(n,): value after its last step."""
    std: Array
    """(n,): standard error of the difference."""

    def first(self, i: int) -> int | None:
        """The date of the step of parameter i that was found first; None where it has none."""
        return next((step.at for step in self.steps if step.parameter == i), None)


def holm(p: Array, level: float) -> Array:
    """Which of n hypotheses Holm's procedure rejects."""
    order = np.argsort(p)
    passed = p[order] < level / np.arange(len(p), 0, -1)
    rejected = np.zeros(len(p), bool)
    rejected[order] = np.logical_and.accumulate(passed)
    return rejected


def attribute(phi: Array, y: Array, test: Constancy, level: float, lags: int | None = None) -> Attribution:
    """Explain the moves in y (N,) on phi (N, n) by steps; ``test`` is `constancy(phi, y, lags)`."""
    N, n = phi.shape
    steps: list[Step] = []
    p, now = test.p_own.copy(), test
    while len(steps) < min(MOST, N // (4 * n + 8)):
        step = _next(now, n, level)
        if step is None or any(s.parameter == step.parameter and abs(s.at - step.at) <= NEAR * N for s in steps):
            break
        p[step.parameter] = min(p[step.parameter], now.p_own[step.parameter])
        steps.append(step)
        later = constancy(_with(phi, steps), y, lags)
        if np.isnan(later.p_joint):
            steps.pop()
            break
        now = later
    named = {step.parameter for step in steps}
    p = np.array([p[i] if i in named else now.p_own[i] for i in range(n)])
    return Attribution(p, tuple(steps), *_sizes(_with(phi, steps), y, steps, n))


def _next(test: Constancy, n: int, level: float) -> Step | None:
    rejected = holm(test.p_own[:n], level)
    if not rejected.any():
        return None
    N = len(test.path)
    inner = np.abs(test.path[int(EDGE * N) : int((1.0 - EDGE) * N) + 1, :n]).max(axis=0)
    i = int(np.argmax(np.where(rejected, inner, -1.0)))
    return Step(i, int(test.at[i]))


def _with(phi: Array, steps: list[Step]) -> Array:
    """The regressors with one more column a step."""
    later = [phi[:, step.parameter] * (np.arange(len(phi)) >= step.at) for step in steps]
    return np.column_stack([phi, *later])


def _sizes(X: Array, y: Array, steps: list[Step], n: int) -> tuple[Array, Array, Array]:
    """(before, after, standard error of the difference), heteroscedasticity-consistent."""
    fit = robust_fit(X, y)
    inverse = np.linalg.pinv(X.T @ (X * fit.inside[:, None]))
    scores = X * fit.psi[:, None]
    cov = inverse @ (scores.T @ scores) @ inverse
    of = np.zeros((n, X.shape[1]))
    for k, step in enumerate(steps):
        of[step.parameter, n + k] = 1.0
    before = fit.theta[:n]
    return before, before + of @ fit.theta, np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", of, cov, of), 0.0))

"""Which parameters move, if some do: changes are explained by steps, one at a time.

    1. among the parameters whose own path rejects constancy (Holm's correction), choose the one for which a step near
       the extreme point of its path explains most of y, with outliers limited
    2. add that step: one more regressor, phi_i from that sample on
    3. test again, until no parameter rejects, the steps leave too little noise for a test, or MOST steps are found;
       where all together still reject, step 4, and then the step of any parameter that explains most
    4. move each step to its most likely date between its neighbours, by the likelihood of its interval: it weighs rows
       by the noise at their time, and the path of 1. does not

A large change of one parameter alters the regressors of an ARX model and its residuals, so the paths of other
parameters seem to change too; once the step is in the regression they no longer do. A slow drift takes several steps of
the same parameter, a temporary fault two steps that return. The result contains the value before the first step, the
value furthest from it in units of its standard error, and the last value. A parameter whose furthest value is within
the error of the first is not named. Where regressors are nearly collinear, as lags of an output far from zero and an
intercept are, or meanwhile, while an input rests, steps of several parameters explain the same: these are reported
together (`driftfit.judge.statistics.parts.other_steps`). Bai and Perron (1998) estimate
several breaks in all parameters in this sequential way; here each step belongs to one parameter.

If the model has a constant and a regressor is far from zero, steps may also be those of slopes about its mean, and of
the level there: a slope through zero would need a step of the constant at the same sample. The steps of smaller BIC
count. Values are those of the model's own parameters all the same. A constant that changes with the slope is named too.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.statistics.break_dates import date_loglik, smallest
from driftfit.judge.statistics.constancy import Constancy, constancy, shortest, transformed
from driftfit.judge.statistics.noise import Noise, whitened
from driftfit.judge.statistics.parts.other_steps import ALIKE, instead
from driftfit.judge.statistics.robust import clipped, inverted, least_squares, noisy, orthonormal, robust_fit

MOST = 12
FAR = 10.0
"""A regressor whose mean is so many of its standard deviations from zero is far from zero."""
AROUND = 0.03
"""Share of the record on each side of the extreme point of a path in which the date of a step is searched."""
CLEAR = 1e-3
"""p-value of all parameters below which there is a further step although no parameter has one by itself."""
NEAR = 0.01
"""Steps of one parameter within this share of the record are the same step."""


class Step(NamedTuple):
    """A parameter (of the n), and the sample (of the N) from which its value is different."""

    parameter: int
    at: int


LEVEL = 0.95
"""Share of the likelihood in the interval of a date."""


class Attribution(NamedTuple):
    """The parameters that move, and their steps."""

    p: Array
    """(n,): p-value of each parameter when it was named, or at the end if it was not."""
    steps: tuple[Step, ...]
    """In the order in which they were found."""
    spans: tuple[tuple[int, int], ...]
    """First and last sample where each may have been: 95 % of the likelihood of its date between its neighbours."""
    before: Array
    """(n,): value before the first step; the constant value if there is none."""
    after: Array
    """(n,): the value furthest from that."""
    std: Array
    """(n,): standard error of the difference."""
    last: Array
    """(n,): value after its last step."""
    moves: Array
    """(n,): whether it has steps, and a significant difference."""
    similar: tuple[tuple[int, ...], ...]
    """For each step, the other parameters whose step near the date where it was found explains as much."""
    clear: Array
    """(steps,): size of each step in standard errors."""
    changed: Array
    """(n, steps): whether a step changes each parameter."""

    def _first(self, i: int) -> int | None:
        """The place of the clearest step of parameter i, or else of one that changes it."""
        own = [k for k, step in enumerate(self.steps) if step.parameter == i]
        return max(own or np.flatnonzero(self.changed[i]).tolist(), key=lambda k: float(self.clear[k]), default=None)

    def first(self, i: int) -> int | None:
        """The date of that step; None if there is none."""
        k = self._first(i)
        return None if k is None else self.steps[k].at

    def instead(self, i: int) -> tuple[int, ...]:
        """The other parameters to which that step may belong."""
        k = self._first(i)
        return () if k is None or self.steps[k].parameter != i else self.similar[k]

    def span(self, i: int) -> tuple[int, int] | None:
        """The interval of that date."""
        k = self._first(i)
        return None if k is None else self.spans[k]


def holm(p: Array, level: float) -> Array:
    """Which of n hypotheses Holm's procedure rejects."""
    order = np.argsort(p)
    passed = p[order] < level / np.arange(len(p), 0, -1)
    rejected = np.zeros(len(p), bool)
    rejected[order] = np.logical_and.accumulate(passed)
    return rejected


def attribute(
    phi: Array, y: Array, test: Constancy, level: float, lags: int | None = None, coarse: Array | None = None
) -> Attribution:
    """Explain the changes in y (N,) on phi (N, n) by steps; ``test`` is `constancy(phi, y, lags, step=coarse)`."""
    own, bic = _attributed(phi, y, test, np.eye(phi.shape[1]), level, lags, coarse)
    M = centring(phi)
    if M is None:
        return own
    centred, other = _attributed(phi @ M, y, transformed(test, phi, M, lags), M, level, lags, coarse)
    return centred if other <= bic else own


def _attributed(
    phi: Array, y: Array, test: Constancy, M: Array, level: float, lags: int | None, coarse: Array | None
) -> tuple[Attribution, float]:
    """The same for steps of the coefficients of phi, of which theta is M times; and BIC, a date and a size per step."""
    N, n = phi.shape
    steps: list[Step] = []
    similar: list[tuple[int, ...]] = []
    p, now = test.p_own.copy(), test
    at = None if test.noise is None else test.noise.at
    while len(steps) < min(MOST, N // (4 * n + 8)):
        step = _next(_with(phi, steps), now, n, level)
        if step is None and steps and now.p_joint < CLEAR:
            dates = list(steps)
            _redated(phi, steps, test.noise)
            now = now if steps == dates else constancy(_with(phi, steps), y, lags, at, coarse)
            step = _any(_with(phi, steps), now, n) if now.p_joint < CLEAR else None
        if step is None or any(s.parameter == step.parameter and abs(s.at - step.at) <= NEAR * N for s in steps):
            break
        p[step.parameter] = min(p[step.parameter], now.p_own[step.parameter])
        X = _with(phi, steps)
        steps.append(step)
        later = constancy(_with(phi, steps), y, lags, at, coarse)
        testable = not np.isnan(later.p_joint)
        if not testable and not orthonormal(_with(phi, steps)).distinct:
            steps.pop()
            break
        reach = int(AROUND * N)
        similar.append(tuple(i for i in _alike(X, now, n, step.at - reach, step.at + reach)[1] if i != step.parameter))
        if not testable:  # the steps leave too little noise to find a further change
            now = now._replace(p_own=np.ones(n), fit=robust_fit(_with(phi, steps), y))
            break
        now = later
    named = {step.parameter for step in steps}
    p = np.array([p[i] if i in named else now.p_own[i] for i in range(n)])
    own = np.array([step.parameter for step in steps], int)
    changed = M[:, own] != 0.0
    p = np.array([p[[i, *own[changed[i]]]].min() for i in range(n)])
    spans = _redated(phi, steps, test.noise)
    before, after, std, last, clear = _sizes(_with(phi, steps), y, steps, M, now.noise)
    far = np.abs(after - before) > scipy.special.ndtri(1.0 - 0.5 * level) * std
    moves = far & changed.any(axis=1)
    similar = _joined(similar, instead(*_white(phi, test.noise), steps)) if test.noise is not None else similar
    bic = 2.0 * N * np.log(max(now.fit.scale, 1e-300)) + 2.0 * len(steps) * np.log(N)
    return Attribution(p, tuple(steps), spans, before, after, std, last, moves, tuple(similar), clear, changed), float(
        bic
    )


def centring(phi: Array) -> Array | None:
    """M (n, n): the columns of phi M (N, n) that were far from zero have the mean 0, and theta is M times their
    coefficients. None without a constant column, or if no regressor is far from zero.
    """
    flat = np.flatnonzero((np.ptp(phi, axis=0) == 0.0) & (phi[:1] != 0.0).any(axis=0))
    mean, spread = phi.mean(axis=0), phi.std(axis=0)
    far = np.flatnonzero((np.abs(mean) > FAR * spread) & (spread > 0.0))
    if len(flat) != 1 or not len(far):
        return None
    M = np.eye(len(mean))
    M[flat[0], far] = -mean[far] / mean[flat[0]]
    return M


def _redated(phi: Array, steps: list[Step], noise: Noise | None) -> tuple[tuple[int, int], ...]:
    """Move each step to its most likely date between its neighbours, and return the intervals of these dates."""
    N, n = phi.shape
    edge = max(shortest(n) // 2, len(noise.ar) + 1 if noise is not None else 0)
    found, spans = [step.at for step in steps], []
    for k, (parameter, at) in enumerate(steps):
        # steps of two parameters at one event have one date
        near = [N * (NEAR if other.parameter == parameter else AROUND) for other in steps]
        a = max((steps[m].at for m, date in enumerate(found) if date < at - near[m]), default=0)
        b = min((steps[m].at for m, date in enumerate(found) if date > at + near[m]), default=N)
        first, last = a, b
        if noise is not None and b - a >= 4 * edge:
            c = noise.level[a:b] * noise.white
            loglik = date_loglik(phi[a:b] / c[:, None], noise.held[a:b] / c, noise.ar, edge, b - a - edge)
            first, last = (a + edge + place for place in smallest(loglik, LEVEL))
            steps[k] = Step(parameter, a + edge + int(np.argmax(loglik)))
        spans.append((first, last))
    return tuple(spans)


def _next(X: Array, test: Constancy, n: int, level: float) -> Step | None:
    """The step of a rejected parameter, near the extreme point of its path, that explains most."""
    rejected = np.flatnonzero(holm(test.p_own[:n], level))
    if not len(rejected) or test.noise is None:
        return None
    Q = np.linalg.qr(X)[0]
    e = test.noise.held - Q @ (Q.T @ test.noise.held)
    reach = int(AROUND * len(X))
    found = [_dated(Q, X[:, i], e, int(test.at[i]) - reach, int(test.at[i]) + reach) for i in rejected]
    most = int(np.argmax([gain for _, gain in found]))
    return Step(int(rejected[most]), found[most][0])


def _any(X: Array, test: Constancy, n: int) -> Step | None:
    """The step that explains most, of any parameter: all together are rejected, and none by its own path, as their
    regressors do not tell them apart meanwhile."""
    at, best = _alike(X, test, n, n, len(X) - n)
    return Step(best[0], at) if best else None


def alike(phi: Array, test: Constancy) -> tuple[int, tuple[int, ...]]:
    """The date of the single step that explains most of y, and the parameters whose steps do so about as well."""
    N, n = phi.shape
    return _alike(phi, test, n, n, N - n)


def _alike(X: Array, test: Constancy, n: int, first: int, last: int) -> tuple[int, tuple[int, ...]]:
    """The same for the first n columns of X (N, ..), and dates from ``first`` to ``last``."""
    if test.noise is None:
        return 0, ()
    X, held = _white(X, test.noise)
    Q = np.linalg.qr(X)[0]
    e = held - Q @ (Q.T @ held)
    found = [_dated(Q, X[:, i], e, first, last) for i in range(n)]
    best = max(range(n), key=lambda i: found[i][1])
    at, gain = found[best]
    noise = max(float(e @ e) - gain, 0.0) / len(X)
    return at, tuple(i for i in range(n) if gain - found[i][1] <= ALIKE * noise)


def _white(X: Array, noise: Noise) -> tuple[Array, Array]:
    """Rows of X and y, with outliers limited, of white noise with variance 1."""
    return whitened(X / noise.level[:, None], noise.held / noise.level, noise.ar, noise.at)


def _joined(one: list[tuple[int, ...]], other: tuple[tuple[int, ...], ...]) -> list[tuple[int, ...]]:
    return [tuple(sorted({*a, *b})) for a, b in zip(one, other, strict=True)]


def _dated(Q: Array, x: Array, e: Array, first: int, last: int) -> tuple[int, float]:
    """The position from first to last where a step of x explains most of e, orthogonal to Q, and how much."""
    N = len(x)
    places = np.arange(max(1, first), min(N - 1, last) + 1)
    later = np.cumsum((x * e)[::-1])[::-1][places]
    inside = np.cumsum((x[:, None] * Q)[::-1], axis=0)[::-1][places]
    left = np.cumsum((x * x)[::-1])[::-1][places] - np.sum(inside * inside, axis=1)
    gain = np.where(left > 1e-9 * (x @ x), later * later / np.maximum(left, 1e-300), 0.0)
    best = int(np.argmax(gain))
    return int(places[best]), float(gain[best])


def _with(phi: Array, steps: list[Step]) -> Array:
    """The regressors with one more column per step."""
    later = [phi[:, step.parameter] * (np.arange(len(phi)) >= step.at) for step in steps]
    return np.column_stack([phi, *later])


def _sizes(X: Array, y: Array, steps: list[Step], M: Array, noise: Noise | None) -> tuple[Array, ...]:
    """(before, after, standard error of their difference, last) of M times the coefficients of X (N, n + steps), and
    the steps in standard errors.

    Errors are heteroscedasticity-consistent.
    """
    n = len(M)
    if noise is not None and len(noise.ar):
        c = noise.level
        X, y = whitened(X / c[:, None], y / c, noise.ar, noise.at)
        X, y = X * c[:, None], y * c
    fit = robust_fit(X, y)
    if not noisy(fit, X, y):
        theta = least_squares(X, y)
        fit = clipped(theta, y - X @ theta, np.inf)
    inverse = inverted(X * fit.inside[:, None])
    scores = X * fit.psi[:, None]
    cov = inverse @ (scores.T @ scores) @ inverse
    before = M @ fit.theta[:n]
    after, std, last = before.copy(), np.zeros(n), before.copy()
    for i in range(n):
        own = sorted((k for k, step in enumerate(steps) if M[i, step.parameter] != 0.0), key=lambda k: steps[k].at)
        if not own:
            continue
        pairs = pairwise(steps[k] for k in own)
        levels = np.tril(np.ones((len(own), len(own)))) * [M[i, steps[k].parameter] for k in own]
        moved, columns = levels @ fit.theta[n:][own], np.ix_([n + k for k in own], [n + k for k in own])
        errors = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", levels, cov[columns], levels), 0.0))
        # between the steps of a slope and of the level at one date neither is the value of a constant
        soon = [later.at - step.at <= AROUND * len(X) and later.parameter != step.parameter for step, later in pairs]
        furthest = int(np.argmax(np.where([*soon, False], 0.0, np.abs(moved) / np.maximum(errors, 1e-300))))
        after[i], std[i], last[i] = before[i] + moved[furthest], errors[furthest], before[i] + moved[-1]
    clear = np.abs(fit.theta[n:]) / np.sqrt(np.maximum(np.diag(cov)[n:], 1e-300))
    return before, after, std, last, clear

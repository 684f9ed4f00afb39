"""theta with bounds and linear constraints: `run.constrain("b1 >= 0", "b1 + b2 == 1")`.

    p(theta_t | data, constraints) ~ N(theta_t; theta, P) prod_k 1[low_k <= g_k' theta_t <= high_k]

The filter runs free, and its Gaussian at each sample is cut to where theta is known to be: mean, standard deviation and
quantiles of what is left. For constant parameters this is Bayes' rule itself, because the constraint is the same at all
samples. For parameters that drift it is the distribution given the constraint *at that sample*; that it held before as
well could narrow it further. The cut is never fed back into the filter: a filter that learns from the same inequality
again at every sample shrinks its covariance without data, and leaves the bound for no reason.

``prob`` is the probability that the free filter gives to each constraint. Where it is small, data and constraint
contradict each other, and the constraint may be wrong. Cost per sample: O(k n^2) for each sweep, some ten sweeps for
several constraints that matter together.

A plane, low = high, is exact conditioning. Half-spaces are taken by expectation propagation: each is replaced by a
Gaussian factor exp(-tau z^2 / 2 + nu z) of z = g' theta, such that mean and variance of z are those of the cut Gaussian
that all other factors leave. With one half-space this is exact; with several it is accurate to a few per cent of a
standard deviation.

Source: Cunningham, Hennig, Lacoste-Julien, Gaussian probabilities and expectation propagation (2011); Simon and Simon,
Constrained Kalman filtering via density function truncation, Int. J. Systems Science 41 (2010), is its first sweep.
Departure: moments of the cut Gaussian by quadrature on the interval where it is, which no tail makes inaccurate.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.live.conformal import quantile
from driftfit.run.live.live import Live
from driftfit.run.result import Track
from driftfit.show.text import Printed, path_table


class Constrained(Printed):
    """Parameters within constraints, sample by sample.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    theta, std : (T, n)
        Mean and standard deviation within the constraints; as in the run where theta is not determined yet.
    prob : (T, k)
        Probability of each constraint in the free run; 0 for an equation, and NaN before theta is determined.
    """

    def __init__(self, names: tuple[str, ...], within: tuple[HalfSpace, ...], theta: Array, P: Array) -> None:
        from scipy.special import ndtr  # a tenth of a second to import

        self.names, self.within = names, within
        known = np.isfinite(P).all(axis=(1, 2))
        self.theta, self._P = theta.astype(float), P.astype(float)
        self._left, self._spread, self.prob = (np.full((len(theta), len(within)), np.nan) for _ in range(3))
        if not known.any():
            return
        free, S = self.theta[known], self._P[known]
        for k, one in enumerate(within):
            std = np.sqrt(np.einsum("i,tij,j->t", one.g, S, one.g))
            with np.errstate(divide="ignore", invalid="ignore"):
                self.prob[known, k] = ndtr((one.high - free @ one.g) / std) - ndtr((one.low - free @ one.g) / std)
        self.theta[known], self._P[known], self._left[known], self._spread[known] = cut(free, S, within)

    def __rich__(self) -> Any:
        return path_table(", ".join(one.text for one in self.within), self.names, self.theta, self.std)

    @cached_property
    def std(self) -> Array:
        return np.asarray(np.sqrt(np.maximum(np.einsum("tii->ti", self._P), 0.0)))

    def cov(self, t: int) -> Array:
        """Covariance (n, n) within the constraints after sample t."""
        return np.asarray(self._P[t].copy())

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n): equal-tailed bands, which never leave a bound of a single parameter."""
        half = quantile(level) * self.std
        from scipy import stats

        tails, low, high = (0.5 - 0.5 * level, 0.5 + 0.5 * level), self.theta - half, self.theta + half
        for k, one in enumerate(self.within):
            own = np.flatnonzero(one.g)
            if len(own) > 1 or one.low == one.high:
                continue
            i, factor = own[0], one.g[own[0]]
            limits = sorted((one.low / factor, one.high / factor))
            with np.errstate(invalid="ignore"):
                mean, std = self._left[:, k] / factor, np.sqrt(self._spread[:, k]) / abs(factor)
                cuts = [(limit - mean) / std for limit in limits]
                for tail, into in zip(tails, (low, high), strict=True):
                    found = stats.truncnorm.ppf(tail, *cuts, loc=mean, scale=std)
                    into[:, i] = np.where(np.isfinite(found) & (std > 0.0), found, into[:, i])
        return low, high


def constrain(run: Track | Live, *constraints: str) -> Constrained:
    """theta of a run within constraints, or of a stream now with T = 1; ValueError if it has no covariance, or a text
    is no constraint.
    """
    if not run.tracker.covariance:
        raise ValueError(f"constrain: {type(run.tracker).__name__} has no covariance to be cut; use RLS or Kalman.")
    if not constraints:
        raise ValueError('constrain: give at least one constraint, such as "b1 >= 0".')
    names: tuple[str, ...] = run.names
    theta, P = (run.theta, run.covariances()) if isinstance(run, Track) else (run.theta[None], run.cov[None])
    return Constrained(names, tuple(half_space(one, names) for one in constraints), theta, P)


class HalfSpace(NamedTuple):
    """low <= g' theta <= high; equal limits are a plane."""

    text: str
    g: Array
    low: float
    high: float


def half_space(text: str, names: Sequence[str], verb: str = "constrain") -> HalfSpace:
    """The constraint that a text describes; ValueError for one that is not linear, or cannot be met."""
    places = {f"_p{i}_": i for i in range(len(names))}
    code = text
    for i in sorted(range(len(names)), key=lambda i: -len(names[i])):  # a name may contain another, or brackets
        code = re.sub(rf"(?<![\w\]]){re.escape(names[i])}(?![\w\[])", f"_p{i}_", code)
    try:
        tree = ast.parse(code.strip(), mode="eval").body
    except SyntaxError:
        tree = None
    if not isinstance(tree, ast.Compare):
        raise ValueError(f'{verb}: {text!r} is not a constraint such as "b1 >= 0" or "b1 + b2 == 1".')
    try:
        sides = [_linear(side, places) for side in (tree.left, *tree.comparators)]
    except ValueError:
        raise ValueError(
            f"{verb}: {text!r} is not linear in the parameters {', '.join(names)}; use sums, differences, and "
            "products with numbers."
        ) from None
    g, low, high = np.zeros(0), -np.inf, np.inf
    for (a, b), sign in zip(pairwise(sides), tree.ops, strict=True):
        if not isinstance(sign, ast.Gt | ast.GtE | ast.Lt | ast.LtE | ast.Eq):
            raise ValueError(f"{verb}: {text!r} must compare by <=, >= or ==.")
        *rest, c = a - b if isinstance(sign, ast.Gt | ast.GtE) else b - a  # rest' theta + c >= 0
        g = g if len(g) else np.array(rest)
        above = np.array_equal(rest, g)
        if not np.any(rest) or not (above or np.array_equal(np.negative(rest), g)):
            raise ValueError(f"{verb}: {text!r} must be limits of one sum of parameters ({', '.join(names)}).")
        limit = -c if above else c
        if above or isinstance(sign, ast.Eq):
            low = max(low, limit)
        if not above or isinstance(sign, ast.Eq):
            high = min(high, limit)
    if not low <= high:
        raise ValueError(f"{verb}: no parameters satisfy {text!r}.")
    return HalfSpace(text, g, float(low), float(high))


def _linear(node: ast.expr, places: dict[str, int]) -> Array:
    """The coefficients of the parameters, and the constant, (n + 1,); ValueError for what is not linear."""
    unit = np.eye(len(places) + 1)
    match node:
        case ast.Constant(value=(int() | float()) as value):
            return np.asarray(value * unit[-1])
        case ast.Name(id=name) if name in places:
            return np.asarray(unit[places[name]])
        case ast.UnaryOp(op=ast.USub()):
            return -_linear(node.operand, places)
        case ast.BinOp(op=sign):
            a, b = _linear(node.left, places), _linear(node.right, places)
            if isinstance(sign, ast.Add | ast.Sub):
                return a + b if isinstance(sign, ast.Add) else a - b
            if isinstance(sign, ast.Mult) and not (a[:-1].any() and b[:-1].any()):
                return np.asarray(a[-1] * b if b[:-1].any() else a * b[-1])
            if isinstance(sign, ast.Div) and not b[:-1].any():
                return np.asarray(a / b[-1])
    raise ValueError


SWEEPS, SETTLED_MOVE = 100, 1e-10
NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)
EXPONENT = 80.0
"""Twice the exponent at which a tail ends."""
KNOWN_SHARE = 1e-14
"""Share of a variance below which a direction is known, and cannot be cut."""


def moments(low: Array, high: Array) -> tuple[Array, Array]:
    """Mean and variance of a standard normal variable within [low, high], (T,) each."""
    mode = np.clip(0.0, low, high)
    up = np.minimum(high - mode, np.sqrt(mode**2 + EXPONENT) - mode)
    down = np.minimum(mode - low, np.sqrt(mode**2 + EXPONENT) + mode)
    half, middle = 0.5 * (up + down), 0.5 * (up - down)
    t = middle[:, None] + half[:, None] * NODES
    density = np.exp(-t * (mode[:, None] + 0.5 * t)) * WEIGHTS
    total = density.sum(axis=1)
    mean = (density * t).sum(axis=1) / total
    variance = (density * (t - mean[:, None]) ** 2).sum(axis=1) / total
    return mode + mean, variance


def conditioned(mu: Array, S: Array, plane: HalfSpace) -> tuple[Array, Array]:
    """mu (T, n) and S (T, n, n) given g' theta = low."""
    Sg, v = S @ plane.g, np.einsum("i,tij,j->t", plane.g, S, plane.g)
    gain = np.where(v > 0.0, 1.0 / np.where(v > 0.0, v, 1.0), 0.0)[:, None] * Sg
    return mu + gain * (plane.low - mu @ plane.g)[:, None], S - gain[:, :, None] * Sg[:, None, :]


def cut(mu: Array, S: Array, within: Sequence[HalfSpace]) -> tuple[Array, Array, Array, Array]:
    """mu (T, n) and S (T, n, n) within half-spaces; and of every g' theta mean and variance without its own, (T, k)."""
    for plane in within:
        if plane.low == plane.high:
            mu, S = conditioned(mu, S, plane)
    cuts = [(k, one) for k, one in enumerate(within) if one.low < one.high]
    tau, nu, without, spread = np.zeros((4, len(mu), len(within)))
    scale = np.einsum("tii->ti", S).copy()
    for _ in range(SWEEPS if len(cuts) > 1 else 1):
        moved = 0.0
        for k, one in cuts:
            Sg = S @ one.g
            v, m = Sg @ one.g, mu @ one.g
            open_ = v > KNOWN_SHARE * (scale @ one.g**2)
            v = np.where(open_, v, 1.0)
            cavity = 1.0 / (1.0 / v - tau[:, k])
            left = cavity * (m / v - nu[:, k])
            std = np.sqrt(cavity)
            mean, variance = moments((one.low - left) / std, (one.high - left) / std)
            fresh = np.where(open_, (1.0 / variance - 1.0) / cavity, 0.0)
            shift = np.where(open_, (left + std * mean) / (cavity * variance) - left / cavity, 0.0)
            dt, dn = fresh - tau[:, k], shift - nu[:, k]
            gain = Sg / (1.0 + dt * v)[:, None]
            mu = mu + gain * (dn - dt * m)[:, None]
            S = S - dt[:, None, None] * gain[:, :, None] * Sg[:, None, :]
            tau[:, k], nu[:, k], without[:, k], spread[:, k] = fresh, shift, left, np.where(open_, cavity, 0.0)
            moved = max(moved, float(np.max(np.abs(dt) * v + np.abs(dn) * np.sqrt(v), initial=0.0)))
        if moved < SETTLED_MOVE:
            break
    return mu, S, without, spread

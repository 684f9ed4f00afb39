"""The most probable path of a Hammerstein-Wiener system, whose output is simulated and then measured.

    v_t = sum_k c_kt f_k(u_t)                                                   input curve, c_1 = 1
    w_t = -sum_i a_it w_{t-i} + sum_j b_jt v_{t-nk-j+1} - l_t + omega_t         omega_t ~ N(0, q_w)
    y_t = G(w_t; d_t) + v_t                                                     v_t ~ N(0, r / weight_t)
    x_t = (a, b, c_2 .., d_2 .., l) = x_{t-1} + eta_t,                          eta_tj ~ N(0, q_j drift_t dt_t)

G is the inverse of the model's output curve, sum_k d_k g_k(y) = w, or with ``forward`` a curve y = sum_k d_k g_k(w),
which need not be one-to-one; d_1 = 1. y is never a regressor, so its noise does not bias: r = 0 would be the equation
error of stage one, q_w = 0 the output error of identification. Knots of piecewise linear curves and centres of
sigmoids may be estimated as constants; thresholds are coefficients anyway.

The path of x, omega and the w before the record minimises the sum of all squares over their variances. Gauss-Newton
steps about a path are smoothed paths of the linearised problem (`driftfit.smooth.solvers.simulated`); w is simulated
again after each, and a step is halved until the sum falls. The log-likelihood is that of the linearised problem at the
minimum, which is Laplace's approximation. r, q_w and each q_j are multiplied by sqrt(sum moved / sum expected), which
cannot lower the likelihood of the linearised problem; a power of this factor is taken as long as it pays. c of a past
input is that of its own time, and its step is taken to be that of the present.

Bands are those of larger variances, because the mode of a variance is too small in short records: its mean given y,
sigma^2 + var(sigma), with sigma normal a priori, of the standard deviation with which it starts, and the curvature of
the log-likelihood in all sigma. On 24 records of 400 samples the bands of 95 % hold .86 of the truth with the mode,
.91 with the mean, and .92 if q is known.

Sources: Bell (1994) for the iterated smoother; Tierney and Kadane (1986); Zhou, Hu, Qiao and Lange (2019) for the
update of variances; Salakhutdinov and Roweis (2003) for its power. The path begins as the median of the coefficients
of a run; the prior of x_0 is as wide as its influence on y is small. Cost: some 100 passes of O(T (na + n)^3).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, vector, whole
from driftfit.models.hammerstein_wiener.basis import Basis, PiecewiseLinear, Sigmoid
from driftfit.models.hammerstein_wiener.blocks import Blocks
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_curve import Inverse
from driftfit.models.hammerstein_wiener.output_error import SLOPE_SHARE
from driftfit.run.result import Track, burn_in
from driftfit.show.text import table_of
from driftfit.smooth.smoothed import Bands
from driftfit.smooth.solvers.simulated import Problem, Solution, recursion, solve
from driftfit.use.blocks import blocks_of, of_minimal, reflected

if TYPE_CHECKING:
    from rich.table import Table

WEAK = 10.0
"""Standard deviation of x_0, in those by which each parameter alone would explain the error of constant ones."""
LEAST = 1e-8
"""Least variance of a drift or of noise, in those at the start."""
QUIET = 1e-4
"""Least noise of w at the start, as a share of that of y."""
STEPS, HALVINGS = 30, 12
STILL = 1e-6
"""Gauss-Newton steps end where the sum of squares falls by less; one unit is half of one in the log-likelihood."""
NUDGE = 0.1
"""Relative step of standard deviations by which the curvature of the likelihood is measured."""
RISE = 0.02
"""Variances stay where the log-likelihood rises by less."""
KNOTS = {PiecewiseLinear: "knots", Sigmoid: "centres"}
"""The setting of a basis with its knots."""


class Path(NamedTuple):
    """x (T, n), omega (T,), and the w before the record (max(na, 1),), the last one first."""

    x: Array
    omega: Array
    w: Array


class Simulation(NamedTuple):
    """w and y (T,); the derivatives of w by its lags and x, of y by w and x, (T, n_w + n); where w is lost (T,)."""

    w: Array
    y: Array
    of_w: Array
    of_e: Array
    lost: Array


@dataclass(frozen=True)
class System:
    """The equations over a record: the model, whether its output curve is ``forward``, and whether knots are free."""

    model: HammersteinWiener
    u: Array
    span: tuple[float, float]
    forward: bool = False
    knots: bool = False

    @cached_property
    def free(self) -> list[tuple[float, ...]]:
        """Free knots at the start of the curve of each input, and of the output."""
        curves = (*self.model.bases, self.model.out)
        return [getattr(one, KNOTS[type(one)]) if self.knots and type(one) in KNOTS else () for one in curves]

    @property
    def names(self) -> tuple[str, ...]:
        s = self.model.structure
        pairs = zip((*s.tags, "[y]"), self.free, strict=True)
        return self.model.called(
            (*s.minimal_names, *(f"knot{k + 1}{tag}" for tag, own in pairs for k in range(len(own))))
        )

    def of_curves(self, x: Array) -> list[Array]:
        """The knots among one x (n,), of each curve."""
        return np.split(x[self.model.structure.n_x :], np.cumsum([len(own) for own in self.free])[:-1])

    def at(self, x: Array) -> HammersteinWiener:
        """The model with the knots of one x (n,)."""
        bases: list[Any] = [replace(one, **{KNOTS[type(one)]: tuple(own.tolist())}) if len(own) else one  # type: ignore[type-var]
                 for one, own in zip((*self.model.bases, self.model.out), self.of_curves(x), strict=True)]  # fmt: skip
        return replace(self.model, input=bases[:-1], output=bases[-1]) if self.knots else self.model

    def __call__(self, path: Path) -> Simulation:
        model, (T, n), x, nw = self.at(path.x[0]), path.x.shape, path.x, len(path.w)
        s, lost = model.structure, np.zeros(T, bool)
        spans, at, (a, _, c, d) = s.spans(False), s.n_x, s.groups(x[:, : s.n_x])
        drive, of_w, of_e = path.omega.copy(), np.zeros((T, nw + n)), np.zeros((T, nw + n))
        for i, (own, nk) in enumerate(zip(s.of_inputs(c, s.n_in), model.delays, strict=True)):
            u, basis, more = self.u[:, i], model.bases[i], len(self.free[i])
            f = np.hstack([basis.for_coefficients(u, own), by_knots(basis, u, own, more)])
            unknown, f = np.isnan(f).any(axis=1), np.nan_to_num(f)
            v = np.sum(f[:, : basis.n] * own, axis=1)
            entries = nw + np.concatenate([spans.c[i], np.arange(at, at + more)])
            for j, b in enumerate(spans.b[i]):
                lost |= late(unknown, nk + j)
                of_w[:, nw + b] = late(v, nk + j)
                of_w[:, entries] += x[:, b, None] * late(f[:, 1:], nk + j)
                drive += x[:, b] * of_w[:, nw + b]
            at += more
        of_w[:, nw + spans.rest] = -1.0
        of_w[:, : s.na] = -a
        w = np.concatenate([path.w[::-1], np.empty(T)])
        recursion(of_w[:, :nw], drive - np.sum(x[:, spans.rest], axis=1), w)
        for k in range(s.na):
            of_w[:, nw + k] = -w[nw - 1 - k : nw - 1 - k + T]
        w = w[nw:]
        y = w if self.forward or model.linear else Inverse(model, d, self.span)(w)
        slope, g, scale = np.sum(model.out.derivative(y) * d, axis=1), model.out.value(y), np.ones(T)
        of_e[:, 0] = slope
        if not self.forward:
            of_e[:, 0] = 1.0 / np.maximum(slope, SLOPE_SHARE * model.out.steepness)
            scale = -of_e[:, 0]
        of_e[:, nw + spans.d] = scale[:, None] * g[:, 1:]
        of_e[:, nw + at :] = scale[:, None] * by_knots(model.out, y, d, n - at)
        return Simulation(w, np.sum(g * d, axis=1) if self.forward else y, of_w, of_e, lost)


def by_knots(basis: Basis, x: Array, c: Array, count: int) -> Array:
    """The derivatives of a curve by its knots (T, count), its last functions being h_k(x - knot_k) - h_k(-knot_k)."""
    last = slice(basis.n - count, basis.n)
    return np.asarray(c[:, last] * (basis.derivative(np.zeros(1)) - basis.derivative(x))[:, last])


def late(x: Any, k: int) -> Array:
    """x (T, ..) delayed by k samples, 0 before."""
    return np.concatenate([np.zeros_like(x[: min(k, len(x))]), x[: max(len(x) - k, 0)]])


class Fit:
    """A record with its variances (2 + n,), r, q_w and q, and the most probable path."""

    def __init__(self, system: System, record: tuple[Array, Array, Array], path: Path, fixed: Array) -> None:
        """``record``: y and the factors of noise and of drift, (T,); ``fixed`` (2 + n,) variances, NaN if unknown."""
        self.system, (self.y, self.noise, self.drift), sim = system, record, system(path)
        self.used, n, known = np.isfinite(self.noise), path.x.shape[1], self.y[np.isfinite(self.noise)]
        slope, size = float(np.mean(sim.of_e[:, 0] ** 2)) or 1.0, float(np.mean(sim.w**2)) or 1.0
        q_w = float(np.mean(path.omega**2))
        r = float(np.mean((known - sim.y[self.used]) ** 2)) + slope * q_w
        r = max(r, LEAST * (float(np.var(known)) or 1.0))
        gain = sim.of_e[self.used, -n:] + sim.of_e[self.used, :1] * sim.of_w[self.used, -n:]
        effect = np.mean(gain**2, axis=0)
        effect[effect == 0.0] = slope * size
        self.mean, self.lost = path.x[0], size * sim.lost
        self.var = np.concatenate([np.full(len(path.w), size), WEAK**2 * r / effect])
        guess = np.concatenate([[r, max(q_w, QUIET * r / slope)], r / (len(self.y) * effect)])
        self.free = np.isnan(fixed)
        self.variances = self.start = np.where(self.free, guess, fixed)
        self.path, self.sim, self.found = self.minimise(path)

    def tried(self, path: Path) -> tuple[float, Simulation]:
        """The sum of squares over their variances; inf where w is unstable."""
        (r, q_w), q, nw = self.variances[:2], self.variances[2:], len(path.w)
        with np.errstate(over="ignore", invalid="ignore"):
            sim = self.system(path)
            squares = (
                ((self.y - sim.y)[self.used], r * self.noise[self.used]), (path.omega, q_w + self.lost),
                (np.diff(path.x, axis=0), self.drift[1:, None] * q), (path.w, self.var[:nw]),
                (path.x[0] - self.mean, self.var[nw:]),
            )  # fmt: skip
            total = sum(float(np.sum(off[var > 0.0] ** 2 / var[var > 0.0])) for off, var in squares)
        return (total if np.isfinite(total) else np.inf), sim

    def linearised(self, sim: Simulation, path: Path, variances: Array) -> Solution:
        """The smoothed deviation from a path."""
        off = np.where(self.used, self.y - sim.y, 0.0)
        signals = np.column_stack([off, self.noise, self.drift, self.lost, -path.omega])
        mean, shift = np.concatenate([-path.w, self.mean - path.x[0]]), -np.diff(path.x, axis=0, prepend=path.x[:1])
        return solve(Problem(signals, sim.of_w, sim.of_e, shift, mean, self.var), variances)

    def minimise(self, path: Path) -> tuple[Path, Simulation, Solution]:
        """Gauss-Newton steps from a path."""
        cost, sim = self.tried(path)
        for _ in range(STEPS):
            found, before = self.linearised(sim, path, self.variances), cost
            step = Path(found.z[:, len(path.w) :], found.omega, found.begin[: len(path.w)])
            for k in range(HALVINGS):
                trial = Path(*(one + 0.5**k * move for one, move in zip(path, step, strict=True)))
                if any(np.any(np.diff(own) <= 0.0) for own in self.system.of_curves(trial.x[0])):
                    continue
                cost, other = self.tried(trial)
                if cost < before:
                    path, sim = trial, other
                    break
            if not cost < before - STILL:
                break
        return path, sim, self.linearised(sim, path, self.variances)

    def estimate(self, rounds: int) -> None:
        """The variances that are free, as many times as the likelihood rises."""
        power, least = 0.5, LEAST * self.variances * self.free
        for _ in range(rounds if self.free.any() else 0):
            before, found = self.variances, self.found
            with np.errstate(divide="ignore", invalid="ignore"):
                factor = np.where(self.free & (found.expected > 0.0), found.moved / found.expected, 1.0)
            self.variances = np.maximum(before * factor**power, least)
            trial = self.minimise(self.path)
            rise = trial[2].loglik - found.loglik
            if rise > 0.0:
                (self.path, self.sim, self.found), power = trial, 1.5 * power
            else:
                self.variances = before
            if rise < RISE and power <= 0.75:
                break
            power = power if rise >= RISE else 0.5

    def spread(self) -> Solution:
        """The solution with the mean of each variance given y, by the curvature of the likelihood."""
        mode, start, k = np.sqrt(self.variances), np.sqrt(self.start[self.free]), np.flatnonzero(self.free)
        scores = np.array([self._scored(mode + step)[1] for step in (0.0 * mode, *NUDGE * np.diag(mode)[k])])[:, k]
        curvature = np.outer(start, start) * (scores[0] - scores[1:]) / (NUDGE * mode[k, None])
        values, vectors = np.linalg.eigh(np.eye(len(k)) + 0.5 * (curvature + curvature.T))
        var = np.zeros(len(mode))
        var[k] = start**2 * np.sum(vectors**2 / np.maximum(values, 1.0), axis=1)
        return self._scored(np.sqrt(mode**2 + var))[0]

    def _scored(self, sigma: Array) -> tuple[Solution, Array]:
        """The solution for standard deviations (2 + n,), and the derivatives of the log-likelihood by them."""
        found = self.linearised(self.sim, self.path, sigma**2)
        return found, sigma * (found.moved - found.expected)


class OutputErrorPath(Bands):
    """The most probable path of a Hammerstein-Wiener system, with bands.

    Attributes
    ----------
    theta, std : (T, n)
        The minimal parameters (a, b, c_2 .., d_2 .., l) and free knots, and their standard deviations.
    cov : (T, n, n)
        Their covariances, with those of r, q_w and q that are estimated at their means given y.
    names : tuple of str
    w, prediction : (T,)
        Output of the linear block, and the simulated output.
    r, q_w : float
        Variances of the noise of y and of w.
    q : (n,)
        Variances of the drift per nominal sample.
    loglik : float
        Log-likelihood by Laplace's approximation.
    """

    def __init__(self, run: Track, fit: Fit) -> None:
        self.run, self.system, self.names = run, fit.system, fit.system.names
        self.theta, self.cov, self.loglik = fit.path.x, fit.spread().cov, fit.found.loglik
        self.std = np.sqrt(np.maximum(np.einsum("tii->ti", self.cov), 0.0))
        self.w, self.prediction = fit.sim.w, fit.sim.y
        (self.r, self.q_w), self.q = fit.variances[:2].tolist(), fit.variances[2:]

    def blocks(self, input: str | None = None, output: str = "d1", at: float = 0.0) -> Blocks:
        """a, b, c and d with standard deviations, as `Track.blocks`, with free knots at their estimates.

        d is of the curve y = sum_k d_k g_k(w) if that was estimated, whose gauge is "d1".
        """
        if self.system.forward and output != "d1":
            raise ValueError(f'blocks: a curve of w has output="d1"; got {output!r}.')
        n_x, model = self.system.model.structure.n_x, self.system.at(self.theta[0])
        found = of_minimal(model, self.theta[:, :n_x], self.std[:, :n_x] ** 2, self.cov[:, :n_x, :n_x])
        return found.gauge(input or "c1", output, at)

    def __rich__(self) -> Table:
        """Where each parameter begins and ends, its standard deviation there, and its drift."""
        shown = table_of("Output error", "parameter", "first", "std", "last", "std", "drift a sample")
        for j, name in enumerate(self.names):
            ends = (f"{value[t, j]:.4g}" for t in (0, -1) for value in (self.theta, self.std))
            shown.add_row(name, *ends, f"{self.q[j] ** 0.5:.2g}")
        shown.caption = f"noise {self.r**0.5:.3g} of y, {self.q_w**0.5:.3g} of w; log-likelihood {self.loglik:.1f}"
        return shown


def output_error(
    run: Track,
    forward: Basis | None = None,
    *,
    knots: bool = False,
    start: Any = None,
    q: Any = None,
    r: float | None = None,
    q_w: float | None = None,
    rounds: int = 100,
) -> OutputErrorPath:
    """Estimate the path of a Hammerstein-Wiener system, and its noise and drift, by the likelihood of y.

    Parameters
    ----------
    run : Track
        A run of a `HammersteinWiener` model by any tracker, of which the record, its weights and intervals of time are
        used. The path begins at the median of its coefficients after the first samples.
    forward : Basis or None
        Functions g_k of an output curve y = sum_k d_k g_k(w), in the place of the model's; the run needs none.
    knots : bool
        Estimate the knots of `PiecewiseLinear` and the centres of `Sigmoid` curves, as constants.
    start : (n_x,) or None
        Minimal parameters at which the path begins.
    q, r, q_w : numbers, q also (n_x,), or None
        Variances of drift, of the noise of y and of that of w, where they are known.
    rounds : int
        Largest number of updates of the variances.

    Raises
    ------
    ValueError
        For another model, several outputs (take one, run["level"]), a run with a warm start or without samples, and
        knots where no curve has any.
    """
    whole_run = isinstance(run, Track) and run.start is None
    if not whole_run or not isinstance(given := run.model, HammersteinWiener):
        raise ValueError(
            "output_error: needs the run of a HammersteinWiener model with one output, over a whole record."
        )
    record, model = run.used_record, given if forward is None else replace(given, output=forward)
    used = np.isfinite(record.y)
    if not used.any():
        raise ValueError("output_error: no sample of this run was used.")
    span = (float(record.y[used].min()), float(record.y[used].max()))
    system = System(model, record.u, span, forward is not None, knots)
    if knots and len(system.names) == model.structure.n_x:
        raise ValueError("output_error: knots= needs a curve that is PiecewiseLinear or a Sigmoid.")
    noise, drift = np.where(used, record.noise, np.inf), record.known.drift * record.known.interval * np.ones(len(run))
    drift[0] = 0.0
    fixed = np.zeros(2 + len(system.names))
    fixed[:2] = [np.nan if one is None else numbers("output_error", name, one, ndim=0, low=0.0)
                 for name, one in (("r", r), ("q_w", q_w))]  # fmt: skip
    n_x = model.structure.n_x
    fixed[2 : 2 + n_x] = vector("output_error", "q", np.nan if q is None else q, n_x)
    xi = _median(run, given, system) if start is None else vector("output_error", "start", start, n_x)
    path = Path(
        np.tile(np.concatenate([xi, *system.free]), (len(run), 1)), np.zeros(len(run)), np.zeros(max(model.na, 1))
    )
    paths = [path]
    if system.forward and start is None:
        paths += _bent(system, record.y[used].std(), path)
    elif not system.forward and q_w != 0.0:
        paths += [_following(system, record.y, path)]
    fits = [Fit(system, (record.y, noise, drift), one, fixed) for one in paths]
    best = max(fits, key=lambda fit: fit.found.loglik)
    best.estimate(whole("output_error", "rounds", rounds, 0))
    return OutputErrorPath(run, best)


def _median(run: Track, given: HammersteinWiener, system: System) -> Array:
    """The median of the coefficients of a run, (n_x,), with its poles inside the unit circle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        xi = blocks_of(run).xi[min(burn_in(run.model.n), len(run) // 2) :]
    xi, s = np.median(xi[np.isfinite(xi).all(axis=1)], axis=0), system.model.structure
    xi[: s.na] = reflected(xi[: s.na])
    if system.forward:
        d = s.spans(False).d
        xi = np.concatenate([xi[: d[0]], np.zeros(len(d)), xi[d[0] + given.out.n - 1 :]])
    return np.asarray(xi)


def _bent(system: System, height: float, path: Path) -> Iterator[Path]:
    """Paths of a third of the gain, whose curve is mostly one of its functions, up or down, of the height of y."""
    spans, x = system.model.structure.spans(False), path.x.copy()
    x[:, np.concatenate(spans.b)] /= 3.0
    g = system.model.out.value(system(path._replace(x=x)).w)[:, 1:]
    for j, size in zip(spans.d, g.std(axis=0), strict=True):
        for sign in (1.0, -1.0) if size > 0.0 else ():
            bent = x.copy()
            bent[:, j] = sign * height / size
            yield path._replace(x=bent)


def _following(system: System, y: Array, path: Path) -> Path:
    """The path with the omega that make w the measured level F(y)."""
    T, nw, sim, known = len(y), len(path.w), system(path), np.flatnonzero(np.isfinite(y))
    g = system.at(path.x[0]).out.value(np.interp(np.arange(T), known, y[known]))
    levels = np.sum(g * system.model.structure.groups(path.x[:, : system.model.structure.n_x])[3], axis=1)
    off = np.concatenate([np.full(nw, levels[0]), levels - sim.w])
    omega = off[nw:] - sum(sim.of_w[:, i] * off[nw - 1 - i : nw - 1 - i + T] for i in range(nw))
    return Path(path.x, omega, np.full(nw, levels[0]))

"""The blocks of a run or of its smoothed path, and their diagnostics sample by sample.

theta is separated by a method, or is that of the tracker's minimal parameters. Diagnostics are

    excitation   least eigenvalue of the windowed Gram matrix of phi, its columns scaled to unit norm: 0 to 1
    nis          e^2 / s, 1 on average if q and r are correct
    quality      sigma_2 / sigma_1 of [b, BC] and [a, AD]: the distance of theta from products
    slope        smallest F'(y; d_t) over the outputs of the window
    radius       largest pole of the estimated linear block
    trace, condition   of the covariance P of theta (scaled to unit diagonal for the condition)
    memory       samples, (p + q) / q with p the largest eigenvalue of P: the averaging length of the filter
    trusted      excitation above a limit, slope above 0 and radius below 1

The boundedness constants of Feng and Hong (2021), theorem 1, are not useful as error bounds: they hold, but are too
large by factors of 1e4 and more, as `python -m lab reproduce hammerstein-wiener` measures.

Source: specification of the persistent excitation condition (42) there. Cost: O(n^3) per diagnosed sample.

Free run: the output from the inputs alone, with the separated parameters of a run and no measured output.

    v_t = sum_k c_k f_k(u_t),   w_t = -sum_i a_i w_{t-i} + sum_j b_j v_{t-nk-j+1} (- l),   y_t = F^-1(w_t)

Sample t uses the coefficients that were known after sample t - 1. F is inverted on the range of the outputs observed
until then, widened by a fifth; where it does not increase, its monotone envelope is inverted and the sample is flagged.
Poles on or outside the unit circle are flagged, and reflected for that sample (z -> 1 / z). With measurement noise a
free run predicts better than the one-step prediction, which feeds noisy outputs back. Cost per sample: O(64 n_out).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of, warn, whole
from driftfit.models.hammerstein_wiener.blocks import Blocks, deviations
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_curve import Inverse
from driftfit.models.hammerstein_wiener.separation import METHODS, Groups, LeastSquares, split
from driftfit.run.program import lanes_of
from driftfit.run.result import burn_in
from driftfit.smooth.problem import replay

if TYPE_CHECKING:
    from driftfit.run.result import Track


BLOCK = 512
"""Number of samples whose covariances, or curves to be inverted, are in memory at a time."""
WEAK = 1e-3
"""If 1 / |(1, c)| is below this, the first coefficient is close to zero relative to the others, and a bad gauge."""


def blocks_of(
    run: Track,
    method: str = "svd-joint",
    input: str | None = None,
    output: str = "d1",
    at: float = 0.0,
    smoothed: tuple[Array, Callable[[], Array]] | None = None,
) -> Blocks:
    """The blocks of a run, see `Track.blocks`; or of its ``smoothed`` theta (T, n), whose covariances (T, n, n) are
    computed if the method needs them.
    """
    model = run.model
    if not isinstance(model, HammersteinWiener):
        raise ValueError(f"blocks: {type(model).__name__} has no blocks; use a HammersteinWiener model.")
    one_of("blocks", "method", method, METHODS)
    theta = run.theta if smoothed is None else smoothed[0]
    if run.names == model.structure.minimal_names:
        found = of_minimal(model, run.theta, run.var, run.written("P") if run.keeps_cov else None)
    elif method == "gls":
        found = _by_least_squares(run, model, theta, covariances(run) if smoothed is None else [(0, smoothed[1]())])
    else:
        a, b, c, d, quality = split(model, theta, method)
        none = Groups(*(np.full(part.shape, np.nan) for part in (a, b, c, d)))
        found = Blocks(model, method, a, b, c, d, quality, none, _intercept(model, theta))
    _warn(found, run, theta, input)
    return found.gauge(found.gauged[0] if input is None else input, output, at)


def _intercept(model: HammersteinWiener, theta: Array) -> Array | None:
    return theta[:, -1].copy() if model.intercept else None


def _warn(found: Blocks, run: Track, theta: Array, input: str | None) -> None:
    """Warn of separations that are not reliable."""
    used, n = int(run.ok.sum()), run.model.n
    if used < n:
        warn(
            f"blocks: {used} usable samples cannot determine {n} products; the blocks are mostly the initial values.",
            UserWarning,
        )
    late = slice(min(len(found) // 2, 5 * run.model.n), None)
    minimal = found.gauged[0] == "c1"
    curves = [found.of_input(i)[1] for i in range(found.model.m)] if input == "c1" or minimal else []
    ways = ("follow the products, with Kalman" if minimal else 'use input="unit"', "use Legendre on the range of y")
    for group, name, way in (*((c, "c_1", ways[0]) for c in curves), (found.d, "d_1", ways[1])):
        size = np.linalg.norm(group[late], axis=1)
        head = np.divide(np.abs(group[late, 0]), size, out=np.full(len(size), np.nan), where=size > 0.0)
        usual = float(np.nanmedian(head)) if np.isfinite(head).any() else 1.0
        if usual < WEAK:
            warn(
                f"blocks: {name} = 1 is a bad gauge here, the other coefficients are {1.0 / usual:.3g} times as large; "
                f"order the functions so that the first matters, or {way}.",
                UserWarning,
            )
    if found.method == "average" and found.c.shape[1] > 1:
        near = np.abs(theta[late, found.a.shape[1] : found.a.shape[1] + found.b.shape[1]])
        small = near < 0.05 * near.max(axis=1, initial=0.0, keepdims=True)
        if small.any():
            warn(
                f'blocks: a b_j is close to zero in {int(small.any(axis=1).sum())} samples, where "average" has '
                'spikes; use "svd-joint".',
                UserWarning,
            )


def of_minimal(model: HammersteinWiener, xi: Array, var: Array, cov: Array | None) -> Blocks:
    """The blocks of minimal parameters xi (T, n_x) with their variances, and covariances if they are known."""
    structure = model.structure
    at = structure.na + sum(structure.nb)
    leads = at + structure.leads - np.arange(model.m)
    fixed = [*leads, at + sum(structure.n_in) - model.m]  # entries of xi before which c_1 and d_1 are inserted
    if cov is not None:
        cov = np.insert(np.insert(cov, fixed, 0.0, axis=1), fixed, 0.0, axis=2)
    a, b, c, d = structure.groups(xi)
    exact, std = np.zeros((len(xi), 2)), deviations(model, np.insert(var, fixed, 0.0, axis=1))
    return Blocks(model, "minimal", a, b, c, d, exact, std, _intercept(model, xi), cov, gauged=("c1", "d1"))


def _by_least_squares(run: Track, model: HammersteinWiener, path: Array, pieces: Iterable[tuple[int, Array]]) -> Blocks:
    """Refine the separation of a path (T, n), whose covariances come in pieces: (first sample, P (k, n, n))."""
    if not run.tracker.covariance:
        raise ValueError(f'blocks: "gls" needs a covariance, but {type(run.tracker).__name__} carries none.')
    a, b, c, d, quality = split(model, path, "svd-joint")
    rest, at = _intercept(model, path), a.shape[1] + b.shape[1] + c.shape[1]
    zeta = np.concatenate([a, b, c, d[:, 1:], *([] if rest is None else [rest[:, None]])], axis=1)
    fit, found = LeastSquares(model.structure), []
    for first, P in pieces:
        part = slice(first, first + len(P))
        found.append(fit.refine(path[part], P, zeta[part]))
    zeta, cov, cost = (np.concatenate(part) for part in zip(*found, strict=True))
    cov = np.insert(np.insert(cov, at, 0.0, axis=1), at, 0.0, axis=2)  # the row and column of d_1
    x = np.insert(zeta, at, 1.0, axis=1)
    a, b, c, d, more = np.split(x, np.cumsum([a.shape[1], b.shape[1], c.shape[1], d.shape[1]]), axis=1)
    std, intercept = deviations(model, np.einsum("tii->ti", cov)), more[:, 0] if model.intercept else None
    return Blocks(model, "gls", a, b, c, d, quality, std, intercept, cov, cost, ("free", "d1")).gauge()


def covariances(run: Track) -> Iterator[tuple[int, Array]]:
    """(first sample, P (k, n, n)) for the pieces of a run, replayed unless the run kept them."""
    T = len(run)
    if run.keeps_cov:
        yield 0, np.ascontiguousarray(run.written("P"))
        return
    tile = run.fresh()
    out = run.program.written(tile, min(BLOCK, T), "cov")
    drive = run.program.drivers("cov").run
    for first in range(0, T, BLOCK):
        last = min(first + BLOCK, T)
        drive(tile, *lanes_of(run.record.part(slice(first, last))), out[: last - first])
        yield first, np.ascontiguousarray(out["P"][: last - first, ..., 0])


LEAST = 1e-8
"""Excitation below which samples are not trusted, because some product is not determined."""


@dataclass(frozen=True)
class Diagnostics:
    """The result of `diagnose_blocks`; each field (samples,), ``quality`` (samples, 2), ``unexcited`` (samples, n).

    ``at`` are the diagnosed samples; ``unexcited`` is how much of each scaled column, 0 to 1, is in the directions of
    theta whose excitation is at most ``limit``.
    """

    names: tuple[str, ...]
    at: Array
    excitation: Array
    nis: Array
    quality: Array
    slope: Array
    radius: Array
    trace: Array
    condition: Array
    memory: Array
    unexcited: Array
    limit: float

    @property
    def trusted(self) -> Array:
        """(samples,) bool."""
        return (self.excitation > self.limit) & (self.slope > 0.0) & (self.radius < 1.0)

    def dull(self, k: int = -1) -> tuple[str, ...]:
        """Names of the columns that sample ``at[k]`` does not distinguish; empty if all are excited."""
        share = self.unexcited[k]
        return tuple(name for name, part in zip(self.names, share, strict=True) if part > 0.2 * share.max())


def diagnose_blocks(run: Track, window: int | None = None, every: int = 1, limit: float = LEAST) -> Diagnostics:
    """Diagnose every ``every``-th sample over a window of samples, by default and at least 3 n.

    Raises
    ------
    ValueError
        For a run of another model, or a window shorter than 3 n.
    """
    model = run.model
    if not isinstance(model, HammersteinWiener):
        raise ValueError(f"diagnose_blocks: the run must be of a HammersteinWiener; got {type(model).__name__}.")
    whole("diagnose_blocks", "every", every, 1)
    span = whole("diagnose_blocks", "window", 3 * model.n if window is None else window, 3 * model.n)
    replayed = replay(run)
    phi = np.where(replayed["ok"][:, :1] > 0.0, replayed["phi"][..., 0], 0.0)
    at = np.arange(every - 1, len(run), every)
    excitation, unexcited = excitation_of(phi, at, span, limit)
    found = blocks_of(run)
    slope = np.array([_least_slope(model, found.d[t], run.y[max(t - span + 1, 0) : t + 1]) for t in at])
    trace, condition, largest = _covariance(run, at)
    q = getattr(run.tracker, "q", None)
    drift = float(np.mean(np.diag(q) if np.ndim(q) == 2 else q)) if q is not None else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        nis = run.innovation[at] ** 2 / run.innovation_std[at] ** 2
        memory = np.divide(largest + drift, drift)
    return Diagnostics(
        model.names, at, excitation, nis, found.quality[at], slope, found.radius[at], trace, condition, memory,
        unexcited, limit,
    )  # fmt: skip


def excitation_of(phi: Array, at: Array, span: int, limit: float) -> tuple[Array, Array]:
    """Smallest eigenvalue of the scaled Gram matrix of each window, and the part of each column in the eigenvectors of
    eigenvalues up to the limit: together they are one space, whatever basis of it is computed.
    """
    n = phi.shape[1]
    least, unexcited = np.zeros(len(at)), np.zeros((len(at), n))
    for k, t in enumerate(at):
        rows = phi[max(t - span + 1, 0) : t + 1]
        G = rows.T @ rows
        size = np.sqrt(np.diag(G))
        scale = np.where(size > 0.0, 1.0 / np.where(size > 0.0, size, 1.0), 0.0)
        values, vectors = np.linalg.eigh(G * scale * scale[:, None])
        least[k] = max(values[0], 0.0)
        unexcited[k] = np.linalg.norm(vectors[:, values <= limit], axis=1)
    return least, unexcited


def _least_slope(model: HammersteinWiener, d: Array, y: Array) -> float:
    """The smallest F' over the span of the outputs of a window."""
    outputs = y[np.isfinite(y)]
    if not outputs.size:
        return float("nan")
    return float(np.min(model.out.derivative(np.linspace(outputs.min(), outputs.max(), 33)) @ d))


def _covariance(run: Track, at: Array) -> tuple[Array, Array, Array]:
    """Trace, scaled condition and largest eigenvalue of P; NaN without a covariance."""
    found = np.full((3, len(at)), np.nan)
    if run.tracker.covariance:
        for first, P in covariances(run):
            for k in np.flatnonzero((at >= first) & (at < first + len(P))):
                one = P[at[k] - first]
                if np.isfinite(one).all() and (np.diag(one) > 0.0).all():
                    scale = 1.0 / np.sqrt(np.diag(one))
                    values = np.linalg.eigvalsh(one * scale * scale[:, None])
                    found[:, k] = np.trace(one), values[-1] / max(values[0], 1e-300), np.linalg.eigvalsh(one)[-1]
    return found[0], found[1], found[2]


@dataclass(frozen=True)
class FreeRun:
    """``y``, ``w`` and ``v`` (T,), v the sum over all inputs; ``rising`` and ``stable`` (T,) bool: whether F increased,
    and whether no pole was reflected.
    """

    y: Array
    w: Array
    v: Array
    rising: Array
    stable: Array


def free_run(run: Track, method: str = "svd-joint", start: int | None = None) -> FreeRun:
    """Simulate the output of a record from sample ``start`` on (by default after max(50, 5 n) samples).

    The earlier w are taken from the measured outputs; results before ``start`` are NaN.
    """
    found = blocks_of(run, method)
    T, na = len(run), found.a.shape[1]
    begin = min(burn_in(run.model.n), T) if start is None else max(int(start), 1)
    y, rising, stable = np.full(T, np.nan), np.ones(T, bool), np.ones(T, bool)
    curves = [_curve(found, run.u[:, i], i) for i in range(found.model.m)]
    levels = np.sum(found.model.out.value(run.y) * found.d, axis=1)
    w = np.where(np.isfinite(levels), levels, 0.0)
    drive, radius = _drive(found, curves), found.radius
    for t in range(begin, T):
        a = found.a[t - 1]
        if radius[t - 1] >= 1.0:
            a, stable[t] = reflected(a), False
        lags = w[max(t - na, 0) : t][::-1]
        w[t] = drive[t] - a[: len(lags)] @ lags
    low, high = _ranges(run.y, found.model.out.scale)
    for first in range(begin, T, BLOCK):
        now, before = slice(first, first + BLOCK), slice(first - 1, min(first + BLOCK, T) - 1)
        inverse = Inverse(found.model, found.d[before], (low[before], high[before]))
        y[now], rising[now] = inverse(w[now]), inverse.rising
    w[:begin] = np.nan
    return FreeRun(y, w, np.sum(curves, axis=0), rising, stable)


def _curve(found: Blocks, u: Array, i: int) -> Array:
    """v (T,) of input i, each with the coefficients of the previous sample; a missing input is 0."""
    c = found.of_input(i)[1]
    late = np.concatenate([c[:1], c[:-1]])
    v = np.sum(found.model.bases[i].for_coefficients(u, late) * late, axis=1)
    return np.where(np.abs(v) < LARGEST, v, 0.0)


def _drive(found: Blocks, curves: list[Array]) -> Array:
    """The contribution of the inputs to w (T,), with the coefficients of the previous sample."""
    T, at = len(found), 0
    total = np.zeros(T) if found.intercept is None else -found.intercept[np.maximum(np.arange(T) - 1, 0)]
    for v, nb, nk in zip(curves, found.model.structure.nb, found.model.delays, strict=True):
        for j in range(nb):
            first = max(nk + j, 1)
            total[first:] += found.b[first - 1 : -1, at + j] * v[first - nk - j : T - nk - j]
        at += nb
    return total


def _ranges(y: Array, scale: float) -> tuple[Array, Array]:
    """Least and largest output up to each sample; around one number, or none, the scale of the basis at both sides."""
    known = np.where(np.abs(y) < LARGEST, y, np.nan)
    low, high = np.fmin.accumulate(known), np.fmax.accumulate(known)
    alone = np.where(high > low, 0.0, scale or 1.0)
    low, high = (np.where(np.isfinite(end), end, 0.0) for end in (low, high))
    return low - alone, high + alone


def reflected(a: Array) -> Array:
    """Coefficients with poles outside the unit circle moved to 1 / conj(z), and poles on it to just inside."""
    poles = np.roots(np.concatenate([[1.0], a]))
    size = np.abs(poles)
    moved = np.where(size >= 1.0, poles / np.maximum(size, 1.0 + 1e-6) ** 2, poles)
    return np.asarray(np.poly(moved).real[1:])

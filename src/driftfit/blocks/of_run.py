"""The blocks of a run: its theta separated by a method, or the minimal parameters that a tracker followed."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.blocks.least_squares import refine
from driftfit.blocks.paths import Blocks, Groups, split
from driftfit.blocks.separate import METHODS
from driftfit.drivers import drivers, output_type
from driftfit.kernel import Array
from driftfit.models.hammerstein_wiener import HammersteinWiener
from driftfit.settings import one_of

if TYPE_CHECKING:
    from driftfit.result import Track

BLOCK = 512
"""Samples whose covariances are held at a time."""
WEAK = 1e-3
"""1 / |(1, c)| below this: the first coefficient is next to nothing beside the others, and a bad gauge."""


def blocks_of(run: Track, method: str = "svd-joint", input: str = "c1", output: str = "d1", at: float = 0.0) -> Blocks:
    """The blocks of a run; see `Track.blocks`."""
    model = run.model
    if not isinstance(model, HammersteinWiener):
        raise ValueError(f"blocks: {type(model).__name__} has none; they belong to HammersteinWiener.")
    one_of("blocks", "method", method, METHODS)
    if run.names == model.structure.minimal_names:
        found = _of_minimal(run, model)
    elif method == "gls":
        found = _by_least_squares(run, model)
    else:
        a, b, c, d, quality = split(model, run.theta, method)
        none = Groups(*(np.full(part.shape, np.nan) for part in (a, b, c, d)))
        found = Blocks(model, method, a, b, c, d, quality, none, _intercept(run))
    _warn(found, run)
    return found if (input, output) == ("c1", "d1") else found.gauge(input, output, at)


def _intercept(run: Track) -> Array | None:
    return run.theta[:, -1].copy() if getattr(run.model, "intercept", False) else None


def _warn(found: Blocks, run: Track) -> None:
    """Say where a separation cannot be relied on."""
    used, n = int(run.ok.sum()), run.model.n
    if used < n:
        warnings.warn(
            f"blocks: {used} usable samples cannot tell {n} products apart; what is shown is mostly the start.",
            UserWarning,
            stacklevel=4,
        )
    late = slice(min(len(found) // 2, 5 * run.model.n), None)
    with np.errstate(invalid="ignore"):
        heads = 1.0 / np.linalg.norm(found.c[late], axis=1), 1.0 / np.linalg.norm(found.d[late], axis=1)
    for head, name, other in zip(heads, ("c_1", "d_1"), ('input="b1"', 'output="slope"'), strict=True):
        usual = float(np.nanmedian(head)) if np.isfinite(head).any() else 1.0
        if usual < WEAK:
            warnings.warn(
                f"blocks: {name} = 1 is a bad gauge here, the other coefficients are {1.0 / usual:.3g} times as large; "
                f"order the functions so that the first matters, or use {other}.",
                UserWarning,
                stacklevel=4,
            )
    if found.method == "average" and found.c.shape[1] > 1:
        near = np.abs(run.theta[late, found.a.shape[1] : found.a.shape[1] + found.b.shape[1]])
        small = near < 0.05 * near.max(axis=1, initial=0.0, keepdims=True)
        if small.any():
            warnings.warn(
                f'blocks: a b_j is next to zero in {int(small.any(axis=1).sum())} samples, where "average" has spikes; '
                'use "svd-joint".',
                UserWarning,
                stacklevel=4,
            )


def _groups_std(model: HammersteinWiener, var: Array) -> Groups:
    """Standard deviations of the groups from variances of xi; those of the leading 1 are 0."""
    parts = model.structure.groups(np.sqrt(np.maximum(var, 0.0)))
    zero = [np.concatenate([np.zeros((*part.shape[:-1], 1)), part[..., 1:]], axis=-1) for part in parts[2:]]
    return Groups(parts[0], parts[1], *zero)


def _of_minimal(run: Track, model: HammersteinWiener) -> Blocks:
    """The blocks of a tracker that follows the minimal parameters themselves."""
    a, b, c, d = model.structure.groups(run.theta)
    P = run._written("P") if "P" in (run._out.dtype.names or ()) else None
    std = _groups_std(model, run._written("var"))
    exact = np.zeros((len(run), 2))
    return Blocks(model, "minimal", a, b, c, d, exact, std, _intercept(run), P)


def _by_least_squares(run: Track, model: HammersteinWiener) -> Blocks:
    """Replay the run in pieces, with covariances, and refine the separation of each."""
    if not run.tracker.covariance:
        raise ValueError(f'blocks: "gls" weighs by the covariance, and {type(run.tracker).__name__} carries none.')
    a, b, c, d, quality = split(model, run.theta, "svd-joint")
    xi = np.ascontiguousarray(model.structure.minimal(a, b, c, d, _intercept(run)))
    T, n_x = xi.shape
    cov, cost = np.empty((T, n_x, n_x)), np.empty(T)
    for first, P in covariances(run):
        part = slice(first, first + len(P))
        theta = np.ascontiguousarray(run.theta[part])
        refine(theta, P, tuple(model.structure[:4]), xi[part], cov[part], cost[part])
    a, b, c, d = model.structure.groups(xi)
    std = _groups_std(model, np.einsum("tii->ti", cov))
    intercept = xi[:, -1] if model.intercept else None
    return Blocks(model, "gls", a, b, c, d, quality, std, intercept, cov, cost)


def covariances(run: Track) -> Any:
    """(first sample, P (k, n, n)) for the pieces of a run, replayed unless the run kept them."""
    T = len(run)
    if "P" in (run._out.dtype.names or ()):
        yield 0, np.ascontiguousarray(run._written("P"))
        return
    tile = run._fresh_tile()
    out = np.empty(min(BLOCK, T), output_type(tile, run.tracker.outputs, "cov"))
    drive = drivers(run.model.steps, run.tracker.steps_for(run.model), "cov").run
    for first in range(0, T, BLOCK):
        last = min(first + BLOCK, T)
        known = run._known if len(run._known) == 1 else run._known[first:last]
        drive(tile, run.y[first:last, None], run.u[first:last, :, None], known[:, :, None], out[: last - first])
        yield first, np.ascontiguousarray(out["P"][: last - first, ..., 0])

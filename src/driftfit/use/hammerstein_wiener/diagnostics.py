"""Diagnostics of the blocks of a run, sample by sample.

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
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.smooth.problem import replay
from driftfit.use.hammerstein_wiener.run_blocks import blocks_of, covariances

if TYPE_CHECKING:
    from driftfit.run.result import Track

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

"""A drift covariance with the structure of products, for stage one: Q = J Q_xi J' + eps I.

    J = dg/dxi at the separated xi,   Q_xi = diag(one variance per group a, b, c, d),   eps = 1e-3 of the largest

If b_j drifts, so do all b_j c_k: the drift of theta is far from a multiple of the identity, and four numbers describe
it better than a full matrix of unknown entries. J changes with xi, so the record is tracked in pieces, each with J at
the end of the previous piece; the filter continues from its state. In a stream, calling `renewed` between two samples
does the same and gives the same bits. On example 1 of Feng and Hong (2021) pieces of 20 samples are as accurate as
pieces of 100.

Source: the covariance of a product to first order. Cost per sample: that of `Kalman` with a full q.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.arguments import as_inputs, as_output
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, whole
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.results.run_blocks import blocks_of
from driftfit.models.hammerstein_wiener.separation.paths import Separator, minimal
from driftfit.run.live.live import Live
from driftfit.run.result import Track
from driftfit.run.track import track_one
from driftfit.trackers.kalman import Kalman

FLOOR = 1e-3
"""eps divided by the largest variance."""


class ProductTrack(NamedTuple):
    """``xi`` (T, n_x) by generalised least squares, ``theta`` (T, n), and the runs of the pieces."""

    xi: Array
    theta: Array
    runs: tuple[Track, ...]


def product_drift(model: HammersteinWiener, xi: Array, q: Any) -> Array:
    """Q (n, n) at xi (n_x,), from one variance q, or four: those of a, b, c and d per nominal sample."""
    given = numbers("product_drift", "q", q, low=0.0)
    four = given if isinstance(given, tuple) else (given,) * 4
    if len(four) != 4:
        raise ValueError(f"product_drift: q must be one variance, or four for a, b, c and d; got {q!r}.")
    na, nb, n_in, n_out, intercept = model.structure
    counts = [na, sum(nb), sum(n_in) - len(n_in), n_out - 1, int(intercept)]
    variances = np.repeat([*four, max(four)], counts)
    J = model.structure.jacobian(xi)
    Q: Array = (J * variances) @ J.T + FLOOR * max(four) * np.eye(model.n)
    return 0.5 * (Q + Q.T)


def track_products(
    model: HammersteinWiener, y: Any, u: Any, *, q: Any, r: float, start: Any = None, p0: float = 1e8,
    theta0: Any = 0.01, every: int = 100,
) -> ProductTrack:  # fmt: skip
    """Track a record with a drift that has the structure of products, renewed at regular intervals.

    Parameters
    ----------
    model : HammersteinWiener
    y, u : (T,)
    q : number or four
        Drift variances of a, b, c and d per sample.
    r : number
        Variance of the equation error.
    start : (n_x,) or None
        xi for the first piece; None: a first piece with q I.
    p0, theta0
        Initial covariance and mean of the products.

    Raises
    ------
    ValueError
        For another model, or variances below 0.
    """
    if not isinstance(model, HammersteinWiener):
        raise ValueError(f"track_products: needs a HammersteinWiener model; got {type(model).__name__}.")
    whole("track_products", "every", every, 1)
    output = as_output(y)
    inputs = as_inputs(u, len(output))
    xi, run, runs, paths = start, None, [], []
    for first in range(0, len(output), every):
        part = slice(first, first + every)
        Q = float(np.max(q)) * np.eye(model.n) if xi is None else product_drift(model, xi, q)
        tracker = Kalman(q=Q, r=r, p0=p0, theta0=theta0)
        with warnings.catch_warnings():  # a piece is too short for warnings that concern records
            warnings.simplefilter("ignore", UserWarning)
            run = track_one(model, tracker, output[part], inputs[part], keep="cov", warm_start=run)
            paths.append(blocks_of(run, "gls").xi)
        runs.append(run)
        xi = _separated(model, run.theta[-1], xi)
    return ProductTrack(np.concatenate(paths), np.concatenate([one.theta for one in runs]), tuple(runs))


def renewed(live: Live, q: Any) -> Live:
    """Continue a stream with the drift of products at its present separated parameters.

    Parameters
    ----------
    live : Live
        A `Kalman` with a full q on a `HammersteinWiener`; initially with the largest of ``q`` times the identity.
    q : number or four
        Drift variances of a, b, c and d per sample.

    Returns
    -------
    Live, which continues from the state of the given one; that one is no longer needed. Cost: that of making a `Live`,
    about a millisecond; the compiled steps are the same.
    """
    model, tracker = live.model, live.tracker
    if not isinstance(model, HammersteinWiener) or not isinstance(tracker, Kalman) or np.ndim(tracker.q) != 2:
        raise ValueError(
            "renewed: needs a stream of a HammersteinWiener model and a Kalman filter with a full matrix q."
        )
    xi = _separated(model, live.theta, None)
    if xi is None:
        return live
    return Live(model, replace(tracker, q=product_drift(model, xi, q)), dt=live.dt, warm_start=live)


def _separated(model: HammersteinWiener, theta: Array, before: Any) -> Any:
    """xi of one theta (n,) by "svd-joint", or the previous value if that is not finite."""
    groups = Separator(model, model.names)(theta, "svd-joint")
    xi = minimal(model, groups, np.asarray(theta[-1]) if model.intercept else None)
    return xi if np.isfinite(xi).all() else before

"""The regression behind a run, and constant least squares on it, sample by sample."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from driftfit.drivers import drivers, output_type
from driftfit.kernel import Array
from driftfit.models.base import Model
from driftfit.smoothers.walk import COLLECTED, collect
from driftfit.trackers.rls import RLS
from driftfit.warm import fresh_tile

if TYPE_CHECKING:
    from driftfit.result import Track


class Rows(NamedTuple):
    """The N samples that can be used, scaled to the noise variance of weight 1."""

    at: Array
    """(N,): their places in the record."""
    phi: Array
    """(N, n)"""
    y: Array
    """(N,)"""


def constant_least_squares(model: Model, y: Array, u: Array, known: Array) -> Array:
    """RLS(1) over a record, y (T,), u (T, m), known (T, 3): (T,) records of phi, y, dt, valid, e, s, ok and more.

    Lags that are missing are filled by these constants.
    """
    steady = RLS(1.0)
    tile = fresh_tile(model, steady)
    out = np.empty(len(y), output_type(tile, COLLECTED))
    steps = steady.steps._replace(store=collect)
    drivers(model.steps, steps).run(tile, y[:, None], u[:, :, None], known[:, :3, None], out)
    return out


def regressors(run: Track) -> Rows:
    """The samples of a regression that a record makes for the model of a run."""
    out = constant_least_squares(run.model, run.y, run.u, run._known)
    at = np.flatnonzero(out["ok"][:, 0] > 0.0)
    noise = run._known[:, 1] if len(run._known) == 1 else run._known[at, 1]
    root = 1.0 / np.sqrt(noise)
    return Rows(at, out["phi"][at, :, 0] * np.reshape(root, (-1, 1)), out["y"][at, 0] * root)

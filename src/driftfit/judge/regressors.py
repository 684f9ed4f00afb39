"""The regression behind a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.constant_fit import constant_least_squares

if TYPE_CHECKING:
    from driftfit.run.result import Track


class Rows(NamedTuple):
    """The N usable samples, scaled to the noise variance of weight 1."""

    at: Array
    """(N,): their sample numbers in the record."""
    phi: Array
    """(N, n)"""
    y: Array
    """(N,)"""


def regressors(run: Track) -> Rows:
    """The record as samples of a regression for the model of a run."""
    out = constant_least_squares(run.model, run.y, run.u, run._known)
    at = np.flatnonzero(out["ok"][:, 0] > 0.0)
    noise = run._known[:, 1] if len(run._known) == 1 else run._known[at, 1]
    root = 1.0 / np.sqrt(noise)
    return Rows(at, out["phi"][at, :, 0] * np.reshape(root, (-1, 1)), out["y"][at, 0] * root)

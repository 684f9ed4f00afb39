"""The regression behind a run."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.constant_fit import constant_least_squares
from driftfit.models.base import Model
from driftfit.run.result import Track


class Rows(NamedTuple):
    """The N usable samples, scaled to the noise variance of weight 1."""

    at: Array
    """(N,): their sample numbers in the record."""
    phi: Array
    """(N, n)"""
    y: Array
    """(N,)"""


def refuse_hidden(verb: str, model: Model, instead: str) -> None:
    """ValueError for a model with hidden states, whose samples are not those of a regression."""
    if model.hidden is not None:
        raise ValueError(
            f"{verb}: a {type(model).__name__} moves hidden states, so there is no regression of which it could judge "
            f"the coefficients; use {instead}."
        )


def regressors(run: Track, steady: Array | None = None) -> Rows:
    """The record as samples of a regression for the model of a run; ``steady`` are its constants, if they are known."""
    out = constant_least_squares(run.model, run.record) if steady is None else steady
    at = np.flatnonzero(out["ok"][:, 0] > 0.0)
    noise = run.known.part(at).noise
    root = 1.0 / np.sqrt(noise)
    y = out["y"][at, 0]
    phi = run.model.settled(out["phi"][at, :, 0], y, run.u, at)
    return Rows(at, phi * np.reshape(root, (-1, 1)), y * root)

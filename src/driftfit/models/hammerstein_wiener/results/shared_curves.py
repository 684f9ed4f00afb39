"""Input curves that several outputs share: the products of all outputs separated together.

    [b_o, BC_o] = b_o c',  o = 1 .. ny        one c for each input:   [b_1, BC_1; b_2, BC_2; ..] = [b_1; b_2; ..] c'

A valve has one characteristic, whatever is measured behind it. Each output has its own products, so its regression is
unchanged. The common curves are the nearest matrix of rank one to the products of all outputs, each divided by the
standard deviation of its innovation, so that the result does not depend on units.

Source: the nearest product as in Bai (1998), on stacked outputs. Cost per sample: O(ny nb n_in^2).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.results.run_blocks import blocks_of
from driftfit.models.hammerstein_wiener.separation.paths import Blocks, split
from driftfit.run.keyed_results import KeyedResults

METHODS = ("svd", "svd-joint")


def shared_curves(run: Any, method: str = "svd-joint") -> dict[str, Blocks]:
    """The blocks of every output of a run, by name, with one curve for each input: their c are equal.

    Parameters
    ----------
    run : the result of `track` for a `HammersteinWiener` with several outputs
    method : "svd-joint" or "svd"
        How a and d of each output are separated.

    Raises
    ------
    ValueError
        For a run of another model, a tracker of minimal parameters, whose curves are separate, or another method.
    """
    one_of("shared_curves", "method", method, METHODS)
    runs = list(run.values()) if isinstance(run, KeyedResults) else []
    model = runs[0].model if len(runs) > 1 else None
    if not isinstance(model, HammersteinWiener) or any(one.names != one.model.names for one in runs):
        raise ValueError(
            "shared_curves: needs a run of the products of a HammersteinWiener model with several outputs."
        )
    structure, ny = model.structure, len(runs)
    weights = np.stack([_weight(one.innovation_std) for one in runs], axis=1)
    stacked = HammersteinWiener(0, [ny * nb for nb in structure.nb], input=list(model.bases))
    rows = np.stack([one.theta for one in runs], axis=1) * weights[:, :, None]
    _, b, c, _, quality = split(stacked, _stack(model, rows), "svd")
    apart = stacked.structure.of_inputs(b, stacked.structure.nb)
    found = {}
    for o, one in enumerate(runs):
        own = [all_b[:, o * nb : (o + 1) * nb] for all_b, nb in zip(apart, structure.nb, strict=True)]
        blocks = blocks_of(one, method)
        worst = np.column_stack([quality[:, 0], blocks.quality[:, 1]])
        found[run.outputs[o]] = replace(
            blocks, b=np.concatenate(own, axis=1) / weights[:, o, None], c=c.copy(), quality=worst
        )
    return found


def _weight(std: Array) -> Array:
    """1 / std where that is a number, else 1."""
    known = np.isfinite(std) & (std > 0.0)
    return np.where(known, 1.0 / np.where(known, std, 1.0), 1.0)


def _stack(model: HammersteinWiener, theta: Array) -> Array:
    """The products (T, ..) of one model whose b are those of all outputs, from theta (T, ny, n)."""
    structure, T = model.structure, len(theta)
    at_b, at_bc = structure.na, structure.starts[1]
    b, products = [], []
    for nb, n_in in zip(structure.nb, structure.n_in, strict=True):
        b.append(theta[:, :, at_b : at_b + nb].reshape(T, -1))
        products += [theta[:, :, at_bc + k * nb : at_bc + (k + 1) * nb].reshape(T, -1) for k in range(n_in - 1)]
        at_b, at_bc = at_b + nb, at_bc + nb * (n_in - 1)
    return np.concatenate([*b, *products], axis=1)

"""Structures of models with several outputs: each output is a regression, and its columns are known by their names.

Every candidate is run once with constant parameters, which gives the regressors of its outputs with missing lags
filled. The union for an output holds each of them once, so all structures are scored on the same rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from driftfit.data.record import Reading
from driftfit.engine.kernel import Array
from driftfit.judge.constant_fit import constant_least_squares, constant_outputs
from driftfit.judge.structures.candidates import Candidate, Pool
from driftfit.models.base import Model
from driftfit.run.result import Track

Candidates = tuple[Pool, list[Candidate]]


def pools_of(models: Sequence[Model], y: Any, u: Any, reading: Reading, data: Any, by: Any) -> dict[str, Candidates]:
    """The union of the candidates' regressors, and the candidates, for each output; one entry if they share a theta."""
    found = [constant_outputs(model, y, u, reading, data, by) for model in models]
    for model, runs in zip(models, found, strict=True):
        if runs.keys() != found[0].keys() or model.implicit:
            raise ValueError(
                f"select: several outputs are compared for ARX or Regression models with the same outputs; got "
                f"{models[0]!r} and {model!r}."
            )
    return {name: _pool(models, [runs[name] for runs in found]) for name in found[0]}


def _pool(models: Sequence[Model], candidates: Sequence[Sequence[Track]]) -> Candidates:
    """The pool of one output; every candidate has a run for each record."""
    columns: dict[str, Array] = {}
    gaps = []
    for runs in candidates:
        rows = np.concatenate([constant_least_squares(run.model, run.record) for run in runs])
        phi = np.where(rows["valid"] > 0.0, rows["phi"][..., 0], np.nan)
        columns = dict(zip(runs[0].names, phi.T, strict=True)) | columns
        gaps.append(rows["dt"][:, 0])
    names, records = tuple(columns), tuple(replace(run.record, time=None) for run in candidates[0])
    pool = Pool(records, np.column_stack(list(columns.values())), names, np.min(gaps, axis=0))
    places = [tuple(names.index(name) for name in runs[0].names) for runs in candidates]
    return pool, [Candidate(repr(one), len(at), one, at) for one, at in zip(models, places, strict=True)]

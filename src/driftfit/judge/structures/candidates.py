"""Structures as columns of one regression: the union of the regressors of models that declare them (`Model.terms`).

    phi_t of a structure = its columns of the union's phi_t

The union is run once to collect its regressors (missing lags are filled by constant least squares on all of
them), so all structures use the same rows. They run in parallel, in lanes of the driver of the union: a structure has
columns of zeros after its own, whose parameters are known to be 0 (`Tracker.partly_known`). Trackers that do not allow
that take a driver for each number of columns. Several records are run separately, each from the start, and written one
after the other.

Of models with several outputs each output is a regression on the same columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.record import Known, Reading, Record, Records
from driftfit.engine.kernel import Array
from driftfit.judge.constant_fit import constant_least_squares, constant_outputs, decided_by
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.parallel_lanes import run_lanes
from driftfit.run.program import Program
from driftfit.run.result import Track, burn_in, track_record
from driftfit.run.track import Decisions
from driftfit.trackers.base import Tracker

TOGETHER = 32
Candidates = tuple["Pool", list["Candidate"]]


class Candidate(NamedTuple):
    """A candidate: a model, columns of the union (None: the model runs by itself), or columns without a model."""

    name: str
    n: int
    model: Model | None
    columns: tuple[int, ...] | None


def unscored(T: int, n: int) -> int:
    """Number of first samples that are not scored: with at most n parameters 100, or half of a short record."""
    return max(burn_in(n), min(100, T // 2))


def price(n: int, starts: Sequence[int]) -> float:
    """The cost of n parameters in the log-likelihood of the first samples of every record, which are not scored."""
    return 0.5 * n * float(np.sum(np.log(np.maximum(starts, 1))))


class Predicted(NamedTuple):
    """The predictions of a structure before each output was observed; NaN where it has none."""

    y_hat: Array
    s: Array
    loglik: Array


@dataclass(frozen=True)
class Pool:
    """Records of T samples together, and the regressors (T, N) of the union of structures that are made of columns."""

    records: tuple[Record, ...]
    phi: Array
    names: tuple[str, ...]
    gaps: Array

    @property
    def y(self) -> Array:
        """(T,): the records one after the other."""
        return np.concatenate([record.y for record in self.records])

    @property
    def spans(self) -> list[slice]:
        """The samples of every record."""
        ends = np.cumsum([len(record) for record in self.records]).tolist()
        return [slice(end - len(record), end) for end, record in zip(ends, self.records, strict=True)]

    def starts(self, n: int) -> list[int]:
        """Number of first samples of every record that are not scored."""
        return [unscored(len(record), n) for record in self.records]

    def after(self, starts: Sequence[int]) -> Array:
        """(T,) bool: the samples of every record after its start."""
        return np.concatenate(
            [np.arange(len(record)) >= start for record, start in zip(self.records, starts, strict=True)]
        )

    def predict(self, tracker: Tracker, structures: Sequence[Candidate]) -> list[Predicted]:
        """Run structures and return their predictions."""
        found: dict[int, Predicted] = {}
        columns = [k for k, s in enumerate(structures) if s.columns is not None]
        together: dict[int, list[int]] = {}
        for k in columns:
            n, most = structures[k].n, len(self.names)
            size = next((N for N in range(most, n, -1) if tracker.partly_known(n, N) is not None), n)
            together.setdefault(size, []).append(k)
        for size, same in together.items():
            for first in range(0, len(same), TOGETHER):
                part = same[first : first + TOGETHER]
                predictions = self._lanes(tracker, [structures[k] for k in part], size)
                found |= dict(zip(part, predictions, strict=True))
        for k, structure in enumerate(structures):
            if structure.columns is None:
                assert structure.model is not None
                program = Program(structure.model, tracker)
                found[k] = joined([predicted(track_record(program, record)) for record in self.records])
        return [found[k] for k in range(len(structures))]

    def _lanes(self, tracker: Tracker, structures: Sequence[Candidate], size: int) -> list[Predicted]:
        """Run structures of at most ``size`` columns in drivers of that size."""
        count, T, R = len(structures), len(self.gaps), len(self.records)
        u = np.zeros((count * T, size))
        for k, structure in enumerate(structures):
            u[k * T : k * T + T, : structure.n] = self.phi[:, list(structure.columns or ())]
        spans = self.spans
        first = np.array([k * T + span.start for k in range(count) for span in spans])
        length = np.array([span.stop - span.start for _ in range(count) for span in spans])
        rows = [np.broadcast_to(r.known.columns, (len(r), *r.known.columns.shape[1:])) for r in self.records]
        known = Known(np.concatenate(rows)).changed(interval=self.gaps)
        records = Records(
            tuple(range(len(first))), first, length, np.tile(self.y, count), u,
            Known(np.tile(known.columns, (count, 1))),
        )  # fmt: skip
        program = Program(Regression(size), tracker)
        starts = {n: state for n in {s.n for s in structures} if n < size and (state := tracker.partly_known(n, size))}
        begun = {k * R + r: starts[s.n] for k, s in enumerate(structures) if s.n in starts for r in range(R)}
        lanes = run_lanes([program] * len(first), records, "std", begun)
        if not lanes.done.all():
            raise KeyboardInterrupt
        runs = [Track(program, records.part(k), lane) for k, lane in enumerate(lanes)]
        return [joined([predicted(run) for run in runs[k * R : (k + 1) * R]]) for k in range(count)]


def joined(parts: Sequence[Predicted]) -> Predicted:
    """The predictions of several records, one after the other."""
    return Predicted(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def predicted(run: Track) -> Predicted:
    """The predictions of a run, and the log-likelihood of each sample."""
    s = run.innovation_std**2
    known = run.ok & np.isfinite(s) & (s > 0.0)
    return Predicted(run.prediction, np.where(known, s, np.nan), run.log_density)


def pool_of(
    models: Sequence[Model], names: Sequence[str], records: Sequence[Record], union: Model | None, own: Model | None
) -> Candidates:
    """The records with the regressors of the union of bound models, and the models as structures.

    ``own`` is the regression that has these regressors: the union, or that of one of its outputs.
    """
    phi, gaps, order = np.zeros((sum(map(len, records)), 0)), np.ones(sum(map(len, records))), {}
    if union is not None and own is not None:
        rows = np.concatenate([constant_least_squares(own, record) for record in records])
        phi, gaps = np.where(rows["valid"] > 0.0, rows["phi"][..., 0], np.nan), rows["dt"][:, 0].copy()
        order = {term: i for i, term in enumerate(union.terms or ())}
    columns = [tuple(order[term] for term in model.terms or ()) if linear(model) else None for model in models]
    structures = [
        Candidate(name, model.n if at is None else len(at), model, at)
        for name, model, at in zip(names, models, columns, strict=True)
    ]
    return Pool(tuple(records), phi, () if own is None else own.names, gaps), structures


def linear(model: Model) -> bool:
    """Whether the regressors of a model are columns of known signals."""
    return model.terms is not None and not model.implicit


def union_of(models: Sequence[Model]) -> Model | None:
    """The smallest model that contains the regressors of all models that are `linear`; None without any."""
    models = [model for model in models if linear(model)]
    terms = {term for model in models for term in model.terms or ()}
    constant = ("1", 0, 0) in terms
    static = [model for model in models if isinstance(model, Regression)]
    if len(static) == len(models):
        return replace(static[0], intercept=constant) if static else None
    nb, nk = [], []
    for j in range(models[0].m):
        lags = [lag for what, i, lag in terms if what == "u" and i == j]
        nk.append(min(lags, default=0))
        nb.append(max(lags) - nk[-1] + 1 if lags else 0)
    start = next((model.start for model in models if isinstance(model, ARX)), "drop")
    na = max((lag for what, _, lag in terms if what == "y"), default=0)
    ny = models[0].outputs if len(models[0].outputs) > 1 else 1
    inputs = models[0].input_names or models[0].m
    return ARX(na, tuple(nb), nk=tuple(nk), inputs=inputs, intercept=constant, start=start, ny=ny)


def pools_of(
    models: Sequence[Model], names: Sequence[str], y: Any, u: Any, reading: Reading, data: Any, by: Any
) -> dict[str, tuple[Candidates, Decisions]]:
    """The same for each output of bound models that have several, and what a gate left out of each record; one entry if
    these share a theta."""
    if any(one.outputs != models[0].outputs or one.shared != models[0].shared or not linear(one) for one in models):
        raise ValueError(
            f"select: several outputs are compared for ARX or Regression models with the same outputs; got "
            f"{', '.join(map(repr, models))}."
        )
    union = union_of(models)
    assert union is not None
    return {
        name: (pool_of(models, names, decided_by(runs)[0], union, runs[0].model), decided_by(runs)[1])
        for name, runs in constant_outputs(union, y, u, reading, data, by).items()
    }

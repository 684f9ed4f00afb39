"""Select: orders, delays and regressors by how well each structure predicted; and averages over structures.

    loglik of a structure = sum over t > m of log p(y_t | past) - (n / 2) log m

Every term is a prediction made before the output was observed, so a structure with superfluous parameters pays for them
without a penalty term (Dawid's prequential principle), and the drift of the parameters is part of the comparison. log p
is the tracker's predictive density, a mixture if it has several modes. All structures are scored on the same samples:
those after the first m that all of them could predict, m = max(50, 5 n of the largest, min(100, T / 2)). The term
(n / 2) log m is the cost of learning n parameters in the first m samples, which are not scored (Rissanen, 1986).

* `select(grid(ARX, na=[1, 2, 3], nb=[1, 2], nk=[0, 1]), y, u)` compares a list of models. ARX and Regression models are
  columns of one regression, the union of their regressors. It is built once, its rows are shared, and structures run
  in parallel as lanes of one compiled driver, as wide as the largest of them. Other models, such as
  Hammerstein-Wiener, run one by one, in one driver for all orders of the same bases; a model whose regressors contain
  the present output supplies its Jacobian (`Implicit`).
* `select(model, y, u)` with one model searches for the best subset of its regressors: all subsets of up to 5
  regressors, and from there to 30 a search that adds the best and drops the worst, with p runs per round instead of
  2^p in all.

The table gives for each structure the loglik, its distance from the best with a standard error (Newey and West), and
the root mean square error. ``best`` has the highest loglik; ``simplest`` has the fewest parameters of those within one
standard error of it. `Selection.average` is dynamic model averaging.

Source: Dawid (1984); Rissanen (1986); Raftery, Karny and Ettler (2010). Departures: the search instead of all 2^p; the
recursion of the weights in closed form. Cost: one run per structure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.data.arguments import check_ready, check_roles
from driftfit.data.arrays import columns_as_outputs
from driftfit.data.record import Reading, Records
from driftfit.engine.kernel import Array
from driftfit.engine.settings import factor
from driftfit.judge.plots import plot_selection
from driftfit.judge.statistics.paired import newey_west
from driftfit.judge.structures.candidates import Candidate, Pool, Predicted, pool_of, pools_of, price, union_of
from driftfit.judge.structures.subsets import subsets
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.readings.left_out import remarks_of
from driftfit.run.track import Decisions, decide, records_of
from driftfit.show.text import ByOutput, Printed, table_of
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    import polars
    from matplotlib.figure import Figure

    from driftfit.judge.structures.average import Average
    from driftfit.judge.structures.switches import Switch

MOST = 30
"""Largest number of regressors that can be searched."""


@dataclass(frozen=True)
class Row:
    """One structure: its loglik, its distance from the best with a standard error, and its root mean square error."""

    name: str
    n: int
    loglik: float
    below: float
    std: float
    rms: float


@dataclass(frozen=True)
class Selection(Printed):
    """The result of `select`; printing it shows the table.

    Attributes
    ----------
    rows : tuple of Row
        Every structure that was tried, best first.
    best, simplest : str
        Names of the structure with the highest loglik, and of the one with the fewest parameters within one standard
        error of it.
    scored : int
        Samples in the loglik.
    left_out : mapping from records to LeftOut
        What a gate left out for all structures; empty without a gate.
    """

    rows: tuple[Row, ...]
    scored: int
    tracker: Tracker
    pool: Pool = field(repr=False, compare=False)
    structures: tuple[Candidate, ...] = field(repr=False, compare=False)
    predictions: tuple[Predicted, ...] = field(repr=False, compare=False)
    judged: Array = field(repr=False, compare=False)
    left_out: Decisions = field(default_factory=dict, compare=False)

    @property
    def best(self) -> str:
        return self.rows[0].name

    @property
    def simplest(self) -> str:
        within = [row for row in self.rows if row.below <= row.std]
        return min(within or self.rows, key=lambda row: (row.n, row.below)).name

    def model(self, name: str | None = None) -> Model:
        """The model of a structure, the best by default; ValueError for a subset, which is not a model by itself."""
        found = self._structure(name).model
        if found is None:
            raise ValueError(
                "select: a subset of regressors is not a model by itself; regressors(name) lists its regressors."
            )
        return found

    def regressors(self, name: str | None = None) -> tuple[str, ...]:
        """Names of the regressors of a structure, the best by default."""
        structure = self._structure(name)
        if structure.columns is None:
            assert structure.model is not None
            return structure.model.names
        return tuple(self.pool.names[i] for i in structure.columns)

    def _structure(self, name: str | None) -> Candidate:
        wanted = self.best if name is None else name
        for structure in self.structures:
            if structure.name == wanted:
                return structure
        raise ValueError(f"select: there is no structure {wanted!r}; the table has {len(self.rows)}.")

    def average(self, forgetting: float = 0.99) -> Average:
        """Average all structures; ``forgetting`` in (0, 1] determines how fast past predictions lose weight."""
        if not 0.0 < forgetting <= 1.0:
            raise ValueError(f"average: forgetting must be in (0, 1]; got {forgetting!r}.")
        from driftfit.judge.structures.average import averaged

        names = self.pool.names if all(s.columns is not None for s in self.structures) else ()
        return averaged(list(self.structures), list(self.predictions), self.pool.y, self.judged, forgetting, names)

    def switches(self, level: float = 0.05) -> list[Switch]:
        """When the structure changed, with dates; ``level`` is the probability of one where nothing changes.

        See `driftfit.judge.structures.switches`. ValueError for structures that are not made of the same regressors, or
        a level that is not a probability.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"switches: level must be between 0 and 1, such as 0.05; got {level!r}.")
        if any(one.columns is None for one in self.structures):
            raise ValueError("switches: structures must be columns of one regression, as those of ARX and Regression.")
        from driftfit.judge.structures.switches import switches

        columns = [list(one.columns or ()) for one in self.structures]
        return switches([one.name for one in self.structures], self.pool.y, self.pool.phi, columns, level)

    @property
    def table(self) -> polars.DataFrame:
        """The rows as a table."""
        import polars

        heads = ("name", "n", "loglik", "below", "std", "rms")
        return polars.DataFrame({head: [getattr(row, head) for row in self.rows] for head in heads})

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = table_of("Structures", "", "n", "loglik", "below", "+-", "rms")
        table.columns[0].no_wrap, table.columns[0].overflow, table.columns[0].ratio = False, "fold", 5
        for row in self.rows[:20]:
            numbers = (f"{row.loglik:.1f}", f"{row.below:.1f}", f"{row.std:.1f}", f"{row.rms:.3g}")
            table.add_row(Text(row.name), str(row.n), *numbers)
        yield table
        if len(self.rows) > 20:
            yield Text(f" and {len(self.rows) - 20} more", "dim")
        yield Text(" below: log-likelihood below the best, +- its standard error", "dim")
        if not np.isfinite(self.rows[0].rms):
            yield Text(" nothing can be compared: no output could be used, or there is nothing to predict")
            return
        yield Text(f" best: {self.best}")
        yield Text(f" simplest within one standard error: {self.simplest}")
        yield Text(f" on {self.scored} samples that all could predict", "dim")
        for name, said in remarks_of(self.left_out):
            yield Text(f" {name.lower()}: {said}", "dim")

    def plot(self, most: int = 20, ax: Any = None) -> Figure:
        """Distances from the best structure, with standard errors, and where in time the structures lost.

        ``ax`` as for `Track.plot`.
        """
        rows, order = self.rows[:most], dict(zip([s.name for s in self.structures], self.predictions, strict=True))
        terms = [np.where(self.judged, order[row.name].loglik, 0.0) for row in rows[:6]]
        below, std = (np.array(part) for part in zip(*((row.below, row.std) for row in rows), strict=True))
        return plot_selection([row.name for row in rows], below, std, terms, ax)


def grid(kind: type[Model], **choices: Any) -> list[Model]:
    """Every combination of settings: ``grid(ARX, na=[1, 2], nb=[1, 2], intercept=True)`` is four models.

    A list is a choice; anything else, including a tuple, is one value for all. Combinations that the model does not
    accept are left out; ValueError if none remains.
    """
    if not (isinstance(kind, type) and issubclass(kind, Model)):
        raise TypeError(f"grid: give the class of the models, as in grid(ARX, na=[1, 2]); got {kind!r}.")
    options = [value if isinstance(value, list | range) else [value] for value in choices.values()]
    models: list[Model] = []
    refused = ""
    for values in product(*options):
        try:
            models.append(kind(**dict(zip(choices, values, strict=True))))
        except ValueError as error:
            refused = str(error)
    if not models:
        raise ValueError(f"grid: no combination makes a {kind.__name__}: {refused or 'a choice is empty'}")
    return models


def select(
    models: Model | Sequence[Model],
    y: Any,
    u: Any = None,
    *,
    tracker: Tracker | None = None,
    keep: Sequence[str] = (),
    most: int | None = None,
    data: Any = None,
    by: Any = None,
    time: Any = None,
    dt: Any = None,
    weights: Any = 1.0,
    drift: Any = 1.0,
    limits: Any = None,
    exclude: Any = None,
    missing: Any = (),
    gate: Any = None,
) -> Selection | ByOutput[Selection]:
    """Compare structures by predictive likelihood.

    Parameters
    ----------
    models : sequence of models, or one model
        Candidates; or one model whose regressors are to be selected, at most 30.
    y, u, data, time, dt, weights, drift, limits, exclude, missing
        As for `track`: with ``data`` the others name its columns. One number or (T,) for drift.
    by : names of columns, "row" or None
        As for `track`: several records, for which one structure is sought. Parameters are estimated for each of them
        from the start, the logliks are added, and the first m samples of each are not scored.
    tracker : Tracker
        Estimates their parameters; by default AdaptiveKalman(). Its settings must fit every number of parameters: one
        q, not a vector.
    gate : bool, `Gate`, decisions of a run or None
        As for `track`. The gate decides once, by a run of `AdaptiveKalman` on the largest model, and what it leaves out
        is left out for all structures: ``selection.left_out``, by record.
    keep : names
        Regressors that every subset contains, such as ("intercept",).
    most : int or None
        Largest number of regressors in a subset.

    Returns
    -------
    Selection. Models with several outputs give one for each, by name (if they share one theta, one for all).

    Raises
    ------
    ValueError
        If there is no candidate, for a tracker without a variance, more than 30 regressors or unknown names, and for
        everything that `track` does not accept.
    """
    tracker = AdaptiveKalman() if tracker is None else tracker
    candidates = list(models) if isinstance(models, Iterable) and not isinstance(models, str) else [models]
    for model in candidates:
        check_roles("select", model, tracker)
    check_ready(tracker)
    if not tracker.covariance:
        raise ValueError(f"select: {type(tracker).__name__} has no variance, so there is no likelihood to compare.")
    if not candidates:
        raise ValueError("select: there is no candidate; grid(ARX, na=[1, 2], nb=[1, 2]) makes some.")
    reading = Reading(time, dt, weights, drift, limits=limits, exclude=exclude, missing=missing)
    search = (keep, most) if isinstance(models, Model) else None
    columns = [(model, y) if data is None else columns_as_outputs(model, y) for model in candidates]
    candidates, y = [model for model, _ in columns], columns[0][1]
    _, records, _ = records_of(candidates[0], y, u, reading, data, by)
    names = [repr(model) for model in candidates]
    if any(len(model.outputs) > 1 for model in candidates):
        reading = reading._replace(gate=tracker.gated if gate is None else gate)
        pools = pools_of(_bound(candidates, records), names, y, u, reading, data, by)
        found = {
            name: replace(_selected(*pool, tracker, search), left_out=left) for name, (pool, left) in pools.items()
        }
        return found["rows"] if candidates[0].shared else ByOutput(found)
    if data is None and by is None:
        factor("drift", drift, len(records.y))
    elif records.drifts is not None:
        raise ValueError("select: drift is one number or one column: candidates have different numbers of parameters.")
    named = max(candidates, key=lambda model: len(model.input_names))
    records = records.for_model(named, reading, max(model.reach for model in candidates))
    bound, gate = _bound(candidates, records), tracker.gated if gate is None else gate
    records, left_out = decide(max(bound, key=lambda model: model.n), records, gate)
    union, each = union_of(bound), [replace(records.part(k), time=None) for k in range(len(records.keys))]
    pool, structures = pool_of(bound, names, each, union, union)
    return replace(_selected(pool, structures, tracker, search), left_out=left_out)


def _selected(
    pool: Pool,
    structures: list[Candidate],
    tracker: Tracker,
    search: tuple[Sequence[str], int | None] | None,
) -> Selection:
    """Rank structures on the samples that all could predict, or with ``search`` = (keep, most) subsets of the
    regressors of the first.
    """
    if search is None:
        predictions = pool.predict(tracker, structures)
    elif structures[0].n > MOST:
        raise ValueError(f"select: at most {MOST} regressors can be searched; there are {structures[0].n}.")
    else:
        structures, predictions = subsets(pool, tracker, structures[0], *search)
    y, starts = pool.y, pool.starts(max(s.n for s in structures))
    judged = pool.after(starts)
    for prediction in predictions:
        judged &= np.isfinite(prediction.loglik)
    terms = [prediction.loglik[judged] for prediction in predictions]
    totals = np.array([float(np.sum(term)) - price(s.n, starts) for s, term in zip(structures, terms, strict=True)])
    top, count = int(np.argmax(totals)), int(judged.sum())
    rows = []
    for structure, prediction, total in zip(structures, predictions, totals, strict=True):
        lost = predictions[top].loglik - prediction.loglik
        parts = [lost[span][judged[span]] for span in pool.spans]  # records are independent: their variances add up
        variance = sum(len(part) * max(float(newey_west(part)), 0.0) for part in parts if len(part) > 1)
        spread = float(np.sqrt(variance)) if count > 10 else float("nan")
        error = (y - prediction.y_hat)[judged]
        rms = float(np.sqrt(np.mean(error * error))) if count else float("nan")
        rows.append(Row(structure.name, structure.n, float(total), float(totals[top] - total), spread, rms))
    rows.sort(key=lambda row: -row.loglik)
    return Selection(tuple(rows), count, tracker, pool, tuple(structures), tuple(predictions), judged)


def _bound(models: Sequence[Model], records: Records) -> list[Model]:
    """The candidates for the inputs of the records; an ARX model of a grid with nb = 0 has no inputs."""
    inputs, m, bound = records.labels.u, records.u.shape[-1], []
    for model in models:
        if inputs and model.input_names not in ((), tuple(inputs)):
            raise ValueError(
                f"select: all candidates must name the same inputs in the same order; {model!r} does not have "
                f"{', '.join(inputs)}."
            )
        whole = replace(model, inputs=m) if isinstance(model, ARX) and model.inputs == 0 and m > 0 else model
        bound.append(whole.bind(inputs or m))
    return bound

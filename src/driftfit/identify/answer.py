"""identify: from a table to an answer. What moves, since when, by how much, and is it time or the working point?

The steps are `driftfit.identify.roles`, `structure`, `working_point` and `judgement`; each has its equations. The
structure is chosen from the whole record, so p-values are those of a test after a selection: parameters move only if
those that came next say so, too. Errors are always those of predictions made before the sample. Cost: for T rows and p
columns of lags, O(T p^2) for the search, and that of up to four verdicts.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any

import numpy as np

from driftfit.data.columns import Wanted
from driftfit.engine.settings import numbers, whole
from driftfit.identify.judgement import effects, errors_of, feedback, moves, with_lags
from driftfit.identify.page import KINDS, Identification, ManyIdentified
from driftfit.identify.roles import BACK, Roles, roles
from driftfit.identify.structure import Shape, Structure, search
from driftfit.identify.working_point import cause, products
from driftfit.judge.changes.words import events
from driftfit.judge.evidence import REJECTED, Evidence, judged_rows
from driftfit.judge.on_all_cores import compiling_beside
from driftfit.judge.verdict import Verdict, judged, p_equals
from driftfit.models.arx import ARX
from driftfit.results import Track
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.tracking import track

LEFT_OUT = 0.01
"""Share of the readings left out above which there is no answer without ``gate``."""
RATE, LEAST = 50_000.0, 500
"""Samples times parameters that the tracker and the verdict judge in a second; samples that are judged in any case."""
WORST = 3
"""Records of a fleet that have a page."""


def identify(
    data: Any, y: str | None = None, *, u: Sequence[str] | None = None, not_u: Sequence[str] = (),
    time: str | None = None, dt: float | str | None = None, by: str | None = None,
    limits: Mapping[str, tuple[float | None, float | None]] | None = None, max_lag: int = 30, forecast: bool = False,
    horizon: int = 10, level: float = 0.05, gate: bool | None = None, budget: float = 45.0, seed: int = 0,
    reading: Wanted | None = None, progress: Callable[[str], None] = lambda text: None,
) -> Identification | ManyIdentified:  # fmt: skip
    """From a table to an answer: roles, structure, drift and its cause; `ManyIdentified` for several records.

    Parameters
    ----------
    data : table, mapping of columns, path, pattern or list of paths
    y, u, not_u : names
        The output, which may be left out if only one column of numbers is left; the inputs to choose from, by default
        every other column of numbers; columns that are none.
    time, dt, by : names, number or text
        The column of the time, its nominal interval, the column that identifies records; found if not given.
    limits : mapping from columns to (low, high)
        Valid ranges; what is outside is missing.
    max_lag, horizon : int
        Longest lag of an input; steps ahead of the second comparison of errors.
    forecast : bool
        Only inputs of earlier samples. By default one of the same sample may explain y; a forecast is said beside it.
    level : number
        Error rate of the statement that parameters move.
    gate : bool or None
        As for `track`. None: that of the default tracker, and no answer if more than `LEFT_OUT` of the readings go.
    budget : number
        Seconds. The search stops after a third of them; then as many of the last samples of every record are judged as
        are expected to take what is left, but at least `LEAST`.
    seed, progress : int, callable
        Seed of the displaced copies of inputs; told what is being done.
    reading : Wanted or None
        How a CSV file is read: decimal sign, separator, form of dates, words for missing values.

    Raises
    ------
    ValueError
        For columns that do not exist, an output that is not named and not obvious, and what `track` does not accept.
    driftfit.identify.roles.NoAnswerError
        For a record that cannot answer: fewer than 60 rows with all lags, a constant output, text.
    """
    end = monotonic() + numbers("identify", "budget", budget, low=0.0)
    max_lag, horizon = whole("identify", "max_lag", max_lag, 1), whole("identify", "horizon", horizon, 1)
    if not 0.0 < level < 1.0:
        raise ValueError(f"identify: level must be between 0 and 1, such as 0.05; got {level!r}.")
    progress("reading")
    found = roles(data, y, u=u, not_u=not_u, time=time, dt=dt, by=by, limits=limits, codes=gate is not False,
                  wanted=reading)  # fmt: skip
    paths = [data] if isinstance(data, str) or hasattr(data, "__fspath__") else data if isinstance(data, list) else []
    source = tuple(map(str, paths)) or ("data.csv",)
    found = replace(found, options=found.options + ("" if gate is None else " --gate" if gate else " --no-gate"))
    with compiling_beside() as compiled:
        task = _Task(end, int(forecast), horizon, level, gate, seed, progress, compiled, source)
        structure = task.structure(found, max_lag)
        model = model_of(found, structure.shape)
        found, structure = task.affordable(found, structure, model.n)
        if found.by is None:
            return task.judged(found, structure)
        progress("tracking")
        fleet = track(model, AdaptiveKalman(), **found.signals(model.input_names), by=found.by, gate=gate)
        compiled()
        verdicts, worst, by = fleet.verdict(level), {}, "" if found.by == BACK else f" --by {shlex.quote(found.by)}"
        for key in (row.key for row in verdicts.rows[:WORST] if row.drifts is not None):
            at = np.flatnonzero([one == key for one in found.key])
            own = replace(found.rows(at), by=None, options=found.options + by)
            worst[key] = task.judged(own, structure)
        return ManyIdentified(model, fleet, verdicts, worst, found, _notes(found, structure), source)


def chosen(data: Any, y: str, time: str | None, reading: Wanted) -> tuple[Roles, ARX]:
    """Roles and structure alone, with the defaults of `identify`."""
    found = roles(data, y, time=time, wanted=reading)
    return found, model_of(found, _Task(monotonic() + 45.0).structure(found, 30, forecast=False).shape)


def model_of(found: Roles, shape: Shape) -> ARX:
    """The ARX model of a structure."""
    inputs, nb, nk = (tuple(one[i] for one in shape[1]) for i in range(3))
    return ARX(shape[0], nb or 0, nk or 1, inputs=tuple(found.inputs[j] for j in inputs) or None, intercept=True)


@dataclass(frozen=True)
class _Task:
    """The settings of a call."""

    end: float
    first: int = 0
    horizon: int = 1
    level: float = REJECTED
    gate: bool | None = None
    seed: int = 0
    progress: Callable[[str], None] = lambda text: None
    compiled: Callable[[], object] = lambda: None
    source: tuple[str, ...] = ("data.csv",)

    def structure(self, found: Roles, max_lag: int, forecast: bool = True) -> Structure:
        """The structure of all records, and beside it that of a forecast."""
        self.progress("searching the structure")
        y, U, _ = (found.centred() if found.by else found).spread(max_lag + 1)  # levels of records may differ
        rng, now = np.random.default_rng(self.seed), monotonic()
        end = now + (self.end - now) / 3.0
        best = search(y, U, max_lag, self.first, end, rng)
        if forecast and any(nk == 0 for _, nk in best.lags.values()):
            self.progress("searching a forecast")
            best = replace(best, forecast=search(y, U, max_lag, 1, end, rng))
        return best

    def affordable(self, found: Roles, structure: Structure, n: int) -> tuple[Roles, Structure]:
        """As many of the last samples of every record as can be judged in what is left of the budget, and the note."""
        sizes = [len(part) for part in found.parts]
        most = max(LEAST, int(RATE * (self.end - monotonic()) / n / len(sizes)))
        of = str(sizes[0]) if found.by is None else "every record"
        note = [f"only the last {most} samples of {of} were judged (--budget)"] if most < max(sizes) else []
        return found.last(most) if note else found, replace(structure, narrowed=(*structure.narrowed, *note))

    def judged(self, found: Roles, structure: Structure) -> Identification:
        """The answer for one record."""
        model = model_of(found, structure.shape)
        self.progress("tracking")
        run: Track = track(model, AdaptiveKalman(), **found.signals(model.input_names), gate=self.gate)
        known = Evidence(run, level=self.level)
        self.progress("time or working point")
        y, U, place = replace(found, y=run.used_record.y).spread(structure.na + 40)
        rows, (Z, made) = known.rows, products(y, U, structure, found.inputs, found.output, self.first)
        why_not = cause(rows.phi, rows.y, Z[place][rows.at] * np.reshape(np.asarray(rows.root), (-1, 1)), made)
        errors, (memory, own) = errors_of(known, self.horizon), effects(known)
        self.compiled()
        verdict = judged(known)
        besides, again = bool(verdict.drifts), None
        if besides and why_not.products:
            more = rows._replace(phi=np.hstack([rows.phi, why_not.columns]), lags=None)  # products of lags are given
            curved = more.only(np.flatnonzero(np.isfinite(more.phi).all(axis=1)), range(more.phi.shape[1]))
            again = judged_rows(curved, self.level)
            besides = again is None or again.rejected
        others = (
            judged_rows(with_lags(rows, y, U, place, shape), self.level) for shape, *_ in structure.second if besides
        )
        least = next((one.test.p for one in others if one is not None and not one.rejected), 0.0)
        other = f"with the chosen structure ({p_equals(verdict.p)}), but not with one of the next ({p_equals(least)})"
        why = f"constants are rejected {other}" if least else verdict.untested
        share = 100.0 * max(len(run.left_out), *found.refused.values(), 0) / len(run)
        if share > 100.0 * LEFT_OUT and self.gate is None:
            why = f"{share:.1f} % of the readings look like fault codes or spikes and were left out; "
            why += "if they are, say so with --gate, and if not, with --no-gate"
        moving = {"working point": 1, "both": 2}.get(why_not.kind(besides), 0)
        if found.dropped > LEFT_OUT * (len(run) + found.dropped):
            why = f"{found.dropped} rows without a time of their own were left out; see --by and --time"
        kind = KINDS[4 if why else moving if verdict.drifts or moving == 1 else 3]
        happened, told, curve = verdict.events if kind in ("moves", "both") else (), rows, why_not.of[:0]
        if kind == "both" and again is not None:
            told, curve = curved, why_not.of
            happened = events(again, [*model.names, *curve], told.at, run.time_text)
        moved = moves(happened, run, told, curve, memory.root)
        fed = [j for j in structure.lags if feedback(y, U[:, j])]
        notes = _notes(found, structure, len(y) - len(found.y), run.left_out.counts, fed)
        return Identification(kind, why, model, run, verdict, found, structure, why_not, own, moved, memory, errors,
                              notes, _undecided(structure, found.inputs, verdict), self.source)  # fmt: skip


def _notes(found: Roles, structure: Structure, gaps: int = 0, counts: Mapping[str, int] | None = None,
           fed: Sequence[int] = ()) -> tuple[str, ...]:  # fmt: skip
    """Problems of the data: ``counts`` are readings that the gate left out, ``fed`` inputs on which the output acts."""
    at_once = {j: ", so what it explains at once may be its response" for j in fed if structure.lags[j][1] == 0}
    return (
        *([] if found.inputs else [f"no input moves, so only its own past can explain {found.output}"]),
        *(f"{name}: {count} left out as codes or spikes" for name, count in found.refused.items()),
        *([f"missing readings: {found.missing}"] if found.missing else []),
        *([f"rows without a time of their own, left out: {found.dropped}"] if found.dropped else []),
        *structure.narrowed,
        *(f"{count} {reason}, left out by the gate" for reason, count in (counts or {}).items()),
        *([f"gaps in time of {gaps} samples in all"] if gaps else []),
        *(f"{found.output} acts on {found.inputs[j]} (feedback){at_once.get(j, '')}" for j in fed),
    )


def _undecided(structure: Structure, names: Sequence[str], verdict: Verdict) -> tuple[str, ...]:
    """What the record does not decide, each in a few words."""
    return (
        *(f"the delay of {names[j]}: {low} to {high} samples are as good"
          for j, (low, high) in structure.delays.items() if low < high),
        *(f"{names[j]} or {' with '.join(names[i] for i in of)}: either explains the record"
          for j, of in structure.instead),
        *(f"{names[j]}: useful, but so are copies of it at other times" for j in structure.doubtful),
        *(["a level that wanders, or noise that does"] if verdict.nearly_walk else []),
    )  # fmt: skip

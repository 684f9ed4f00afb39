"""Verdict and diagnosis of many runs at once, a fleet or the outputs of one record, in one table with a row for each.

    q_(k) = min over j >= k of  p_(j) N / j         (p in ascending order, N runs that can be tested)

A level of 5 % for each of 200 sensors would accuse about ten whose parameters are constant. Here the level is the false
discovery rate: among the runs that are reported to move (q below the level), the share with constant parameters is at
most the level on average, if the tests are independent or positively dependent. The same holds for "tracking pays".
Each run is judged separately, on all cores.

Source: Benjamini and Hochberg (1995). Cost: that of a verdict for each run.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.kernel import Array
from driftfit.judge.diagnose import Diagnosis, diagnose, diagnosis
from driftfit.judge.evidence import Evidence
from driftfit.judge.on_all_cores import on_all_cores
from driftfit.judge.verdict import Moved, Verdict, change, judged, p_text, verdict
from driftfit.run.fleet import table_by_key
from driftfit.show.text import Printed, key_text, table_of

if TYPE_CHECKING:
    from driftfit.run.result import Track

SHOWN = 20
COLUMNS = {
    **{"p": "double", "q": "double", "drifts": "boolean", "moving": "string", "change": "string"},
    **{"parameter": "string", "sample": "bigint", "when": "string", "before": "double", "after": "double"},
    **{"change_std": "double", "relative": "double", "rms": "double", "constant_ls": "double", "pays": "boolean"},
    **{"samples": "bigint", "coverage": "double", "left_out": "bigint", "untested": "string"},
}
"""Columns of the table, and their types in Spark."""


def discoveries(p: Array) -> Array:
    """q-values (N,) of p-values (N,): the smallest false discovery rate at which each is found; NaN where p is NaN."""
    p = np.asarray(p, float)
    known = np.flatnonzero(np.isfinite(p))
    q = np.full(len(p), np.nan)
    q[known] = scipy.stats.false_discovery_control(p[known])
    return q


@dataclass(frozen=True)
class Judgement:
    """One run among many: its verdict, and the q-values of "the parameters move" and of "tracking them pays".

    ``drifts`` and ``pays`` are None where this was not tested. ``coverage`` is the share of readings within the 95 %
    band of their prediction, and ``left_out`` the number of readings that a gate left out.
    """

    key: Hashable
    verdict: Verdict
    q: float
    q_pays: float
    drifts: bool | None
    pays: bool | None
    coverage: float
    left_out: int

    @property
    def moves(self) -> tuple[Moved, ...]:
        """The parameters that move, the clearest first."""
        named = (one for one in self.verdict.parameters if one.moves and self.drifts)
        return tuple(sorted(named, key=lambda one: -abs(one.after - one.before) / one.std if one.std > 0.0 else 0.0))

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the parameters that move."""
        return self.verdict.moving if self.drifts else ()

    @property
    def relative(self) -> float:
        """Largest change of a parameter that moves, as a share of its value before; 0 where none is named.

        If the value before is smaller than the standard error of the change, that standard error replaces it.
        """
        return max(
            (abs(m.after - m.before) / max(abs(m.before), np.nan_to_num(m.std), 1e-300) for m in self.moves),
            default=0.0,
        )

    @property
    def change(self) -> str:
        """The change of the parameter that moves most clearly, in words."""
        moved = self.moves
        more = f" and {len(moved) - 1} more" if len(moved) > 1 else ""
        if not moved:
            return ""
        when = f"from {moved[0].when} on" if np.isnan(moved[0].std) else f"at {moved[0].when}"
        return f"{moved[0].name} {change(moved[0], 3)} {when}{more}"

    @property
    def columns(self) -> dict[str, Any]:
        """A row of `ManyVerdicts.table`, by the names in `COLUMNS`."""
        one, first = self.verdict, self.moves[0] if self.moves else None
        named = (getattr(first, name, None) for name in ("name", "at", "when", "before", "after", "std"))
        values = (
            *(one.p, self.q, self.drifts, ", ".join(self.moving), self.change, *named, self.relative, one.rms),
            *(one.rivals[1].rms, self.pays, one.samples, self.coverage, self.left_out, one.untested),
        )
        return dict(zip(COLUMNS, values, strict=True))

    @property
    def cells(self) -> tuple[str, ...]:
        """A row of a table: what moves or why this is not tested, p, q, error, that of constants, and whether it pays.

        A number that is not known is an empty cell.
        """
        judged = (p_text(p) if np.isfinite(p) else "" for p in (self.verdict.p, self.q))
        errors = (f"{one:.4g}" if np.isfinite(one) else "" for one in (self.verdict.rms, self.verdict.rivals[1].rms))
        return (self.change or self.verdict.untested, *judged, *errors, "yes" if self.pays else "")


@dataclass(frozen=True)
class ManyVerdicts(Printed):
    """Verdicts of many runs; printing them shows the twenty that move most clearly.

    Attributes
    ----------
    rows : tuple of Judgement
        The clearest first; runs that cannot be tested come last.
    level : float
        False discovery rate.
    by : tuple of str
        Names of the parts of a key.
    """

    rows: tuple[Judgement, ...]
    level: float
    by: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, key: Hashable) -> Judgement:
        for row in self.rows:
            if row.key == key:
                return row
        raise KeyError(f"there is no verdict for {key!r}.")

    def ranked(self, by: str = "clearest") -> ManyVerdicts:
        """The same rows in another order: the "clearest" first, or the largest relative "change" first."""
        if by not in ("clearest", "change"):
            raise ValueError(f"ranked: by must be 'clearest' or 'change'; got {by!r}.")
        clear = sorted(self.rows, key=lambda row: (np.isnan(row.q), row.verdict.p, -row.verdict.statistic))
        if by == "change":
            clear.sort(key=lambda row: -row.relative)
        return replace(self, rows=tuple(clear))

    @property
    def drifting(self) -> tuple[Hashable, ...]:
        """Keys of the runs whose parameters move."""
        return tuple(row.key for row in self.rows if row.drifts)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in sentences."""
        tested, paying = (int(np.isfinite([getattr(row, q) for row in self.rows]).sum()) for q in ("q", "q_pays"))
        drifting, pays = len(self.drifting), sum(bool(row.pays) for row in self.rows)
        found = (
            f"Parameters move in {drifting} of {tested}, those whose q is below {self.level:g}: at most "
            f"{100.0 * self.level:g} % of them are constant, on average (false discovery rate)."
            if drifting
            else f"No drift is found in any of {tested}: no q is below {self.level:g} (false discovery rate). A drift "
            "much smaller than the noise cannot be ruled out."
            if tested
            else ""
        )
        names = Counter(name for row in self.rows for name in row.moving).most_common(3)
        which = f"The most frequent: {', '.join(f'{name} ({count})' for name, count in names)}." if names else ""
        gain = f"Tracking pays in {pays} of {paying}." if paying else ""
        rest = len(self.rows) - tested
        short = (
            f"{rest} cannot be tested: they have too few samples, hidden states, no noise, or "
            "regressors that do not span."
            if rest
            else ""
        )
        return tuple(filter(None, (found, which, gain, short)))

    @property
    def table(self) -> Any:
        """One row per run, as a polars table that joins to others by the columns of its keys.

        ``drifts`` and ``pays`` are null where this was not tested; ``untested`` is the reason. Of the first parameter
        that moves there are its name, the sample and the time of the change, its values before and after, and the
        standard error of the change.
        """
        rows = [row.columns for row in self.rows]
        columns = {name: [row[name] for row in rows] for name in COLUMNS}
        return table_by_key(self.by, [row.key for row in self.rows], [1] * len(self.rows), columns)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for sentence in self.sentences:
            yield Text(f" {sentence}")
        table = table_of("The clearest first", "", "what moves most", "p", "q", "error", "LS", "pays", names=2)
        table.columns[1].no_wrap = False  # words are wrapped before numbers
        for column, width in zip(table.columns[2:], (8, 8, 7, 7, 4), strict=True):
            column.ratio, column.min_width = None, width
        for row in self.rows[:SHOWN]:
            table.add_row(Text(key_text(row.key)), *map(Text, row.cells))
        yield table
        if len(self.rows) > SHOWN:
            yield Text(f" and {len(self.rows) - SHOWN} more", "dim")


@dataclass(frozen=True)
class ManyDiagnoses(Printed):
    """Diagnoses of many runs; printing them shows how often each number is out of bounds, and the worst runs.

    Attributes
    ----------
    of : dict
        The Diagnosis of every run, by key.
    by : tuple of str
        Names of the parts of a key.
    """

    of: dict[Hashable, Diagnosis] = field(repr=False)
    by: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.of)

    def __getitem__(self, key: Hashable) -> Diagnosis:
        return self.of[key]

    @property
    def ok(self) -> bool:
        """Whether everything is within its limits everywhere."""
        return all(one.ok for one in self.of.values())

    @property
    def counts(self) -> dict[str, int]:
        """How many runs are out of bounds, by number."""
        names = dict.fromkeys(check.name for one in self.of.values() for check in one.checks)
        return {name: sum(not c.ok for one in self.of.values() for c in one.checks if c.name == name) for name in names}

    @property
    def computed(self) -> dict[str, int]:
        """For how many runs each number can be computed."""
        return {
            name: sum(np.isfinite(c.value) for one in self.of.values() for c in one.checks if c.name == name)
            for name in self.counts
        }

    @property
    def known(self) -> tuple[Hashable, ...]:
        """Keys of the runs for which some number can be computed."""
        return tuple(key for key, one in self.of.items() if any(np.isfinite(c.value) for c in one.checks))

    @property
    def worst(self) -> tuple[Hashable, ...]:
        """Keys of the runs; those with the most numbers out of bounds come first."""
        return tuple(sorted(self.of, key=lambda key: -len(self.of[key].sentences)))

    @property
    def table(self) -> Any:
        """One row per run with every number, as a polars table."""
        values = [{check.name: check.value for check in one.checks} for one in self.of.values()]
        columns: dict[str, list[Any]] = {name: [row.get(name) for row in values] for name in self.counts}
        columns["out_of_bounds"] = [len(one.sentences) for one in self.of.values()]
        return table_by_key(self.by, self.of, [1] * len(values), columns)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = table_of("Out of bounds", "", "runs", "of")
        computed = self.computed
        for name, count in self.counts.items():
            table.add_row(name, str(count), str(computed[name]))
        yield table
        table = table_of("The worst first", "", "what is out of bounds", names=2)
        for key in [key for key in self.worst if not self.of[key].ok][:SHOWN]:
            table.add_row(Text(key_text(key)), Text(", ".join(c.name for c in self.of[key].checks if not c.ok)))
        yield table


Judged = tuple[Verdict, float, int]
"""A verdict, with `coverage` and the number of readings left out."""


def verdicts(
    runs: Mapping[Hashable, Track], by: tuple[str, ...], level: float, lags: int | None = None, burn: int | None = None
) -> ManyVerdicts:
    """Judge runs by key, whose parts ``by`` names; see `driftfit.judge.verdict.verdict` for the settings and errors."""
    return ranked(on_all_cores(runs, lambda key: (runs[key], level, lags, burn), _one, "verdict"), by, level)


def verdicts_and_diagnoses(
    runs: Mapping[Hashable, Track], by: tuple[str, ...], level: float
) -> tuple[ManyVerdicts, ManyDiagnoses]:
    """The verdicts and the diagnoses, which share the test of constancy of each run."""
    pairs = on_all_cores(runs, lambda key: (runs[key], level), _both, "report")
    judgements = ranked({key: one for key, (one, _) in pairs.items()}, by, level)
    return judgements, ManyDiagnoses({key: health for key, (_, health) in pairs.items()}, by)


def _one(run: Track, level: float, lags: int | None, burn: int | None) -> Judged:
    return verdict(run, level, lags, burn), coverage(run), len(run.left_out)


def _both(run: Track, level: float) -> tuple[Judged, Diagnosis]:
    known = Evidence(run, level=level)
    return (judged(known), coverage(run), len(run.left_out)), diagnosis(known)


def ranked(found: Mapping[Hashable, Judged], by: tuple[str, ...], level: float) -> ManyVerdicts:
    """What was found of runs by key, with q-values, the clearest first."""
    truths = [one for one, _, _ in found.values()]
    q, q_pays = (discoveries(np.array(p)) for p in ([v.p for v in truths], [v.constants.p for v in truths]))
    rows = []
    for (key, (one, inside, lost)), a, b in zip(found.items(), q.tolist(), q_pays.tolist(), strict=True):
        drifts, pays = (None if np.isnan(value) else value < level for value in (a, b))
        rows.append(Judgement(key, one, a, b, drifts, pays, inside, lost))
    return ManyVerdicts(tuple(rows), level, by).ranked("clearest")


def coverage(run: Track) -> float:
    """The share of used readings within their 95 % band; NaN without any, and for models that have no band of y."""
    if run.model.implicit and not run.tracker.output_error:
        return float("nan")
    low, high = run.output_band(0.95)
    known = run.ok & np.isfinite(high)
    return float(np.mean((low <= run.y)[known] & (run.y <= high)[known])) if known.any() else float("nan")


def diagnoses(runs: Mapping[Hashable, Track], by: tuple[str, ...]) -> ManyDiagnoses:
    """Diagnose runs by key."""
    return ManyDiagnoses(on_all_cores(runs, lambda key: (runs[key],), diagnose, "diagnosis"), by)

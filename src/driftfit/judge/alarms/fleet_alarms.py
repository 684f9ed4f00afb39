"""Alarms of many runs at once: a fleet, or the outputs of one record; `driftfit.judge.alarms.detect` treats one run.

N series, each with one false alarm in ``every`` samples, together give N alarms in that time. Here ``every`` refers to
all of them together: each gets one alarm in N every samples. Rates add up whether or not the series are independent.

An alarm says when. Which series had a fault is a separate question for the complete records: `Alarms.p` is the
probability that a record without a fault is as extreme as this one, and

    q_(k) = min over j >= k of  p_(j) N / j         (p in ascending order)

is below ``level`` for the series in ``faulty``. On average at most that share of them has no fault, if the series are
independent or positively dependent. A series can have an alarm and not be among them, and vice versa.

The limits of "glr" come from simulated records. A series is first judged by those of a group of like series, and by
limits of its own if an alarm or a fault is possible then. Series are alike if their reference models have the same
parameters and a similar length, and if their noise is similar: its tails (the share of small residuals, and where
scores are clipped), and whether its variance changes. The deviates of like series have nearly the same distribution, so
records that are simulated from many of them serve for each, at the cost of a single one. So every alarm and every fault
that is reported is one by the limits that the series has as a single run.

Source: Benjamini and Hochberg (1995); Besag and Clifford (1991) for a simulation that ends when the answer is clear.
Cost: that of the reference model and the statistics of each run, of the bootstrap of each group, and of `detect` for
each series in doubt. Memory: two kilobytes for each series; its statistics are computed again when `Watch.alarms` is
read.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, plain
from driftfit.judge.alarms.bootstrap import RECORDS, Normal, drawn_in_blocks, limits, simulated
from driftfit.judge.alarms.detect import Alarms, asked_for, chance_of, detect, findings_of, highest, judged
from driftfit.judge.alarms.frozen import CLIPS
from driftfit.judge.alarms.reference import Reference, in_samples, modelled
from driftfit.judge.fleet_verdict import SHOWN, discoveries
from driftfit.judge.on_all_cores import on_all_cores
from driftfit.judge.verdict import p_text
from driftfit.run.fleet import table_by_key
from driftfit.run.live.reference_model import ALPHA, CLIP, CONSTANT
from driftfit.run.live.rule import AlarmRule
from driftfit.show.text import Printed, facts, key_text, table_of

if TYPE_CHECKING:
    from driftfit.run.result import Track


MARGIN = 4.0
"""A series is in doubt if its p-value could be this many times smaller by the limits of the series itself."""
TAILS = 100.0
"""Groups differ by 1 / TAILS in the share of residuals below the smallest of `CLIPS`."""


@dataclass(frozen=True)
class Watch:
    """One series among many: its alarms, its q-value, and whether it is reported as faulty."""

    key: Hashable
    run: Track = field(repr=False)
    rule: AlarmRule
    start: int
    p: float
    onsets: tuple[int, ...]
    first: str
    """The beginning of its first alarm and the cause; empty if there is none."""
    q: float
    faulty: bool

    @property
    def alarms(self) -> Alarms:
        """All that `Track.detect` gives for this series, computed when it is asked for."""
        return replace(judged(self.run, self.rule, self.start), p=self.p)


@dataclass(frozen=True)
class ManyAlarms(Printed):
    """The result of `detect` for a fleet; printing it shows the twenty most extreme series.

    Attributes
    ----------
    rows : tuple of Watch
        Sorted by how extreme they are; series without judged samples come last.
    every : float
        Samples in which one false alarm may begin, in all series together.
    level : float
        False discovery rate.
    failed : dict
        Reasons why some could not be judged.
    by : tuple of str
        Names of the parts of a key.
    """

    rows: tuple[Watch, ...]
    kind: str
    every: float
    level: float
    failed: dict[Hashable, str] = field(repr=False)
    by: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, key: Hashable) -> Alarms:
        for row in self.rows:
            if row.key == key:
                return row.alarms
        raise KeyError(f"there are no alarms for {key!r}{': ' + self.failed[key] if key in self.failed else '.'}")

    @property
    def faulty(self) -> tuple[Hashable, ...]:
        """Keys of the series with a fault."""
        return tuple(row.key for row in self.rows if row.faulty)

    @property
    def alarmed(self) -> tuple[Hashable, ...]:
        """Keys of the series with an alarm."""
        return tuple(row.key for row in self.rows if row.onsets)

    @property
    def expected(self) -> float:
        """Expected number of false alarms in all series together, if none had a fault."""
        return float(sum((len(row.run) - row.start) / row.rule.every for row in self.rows))

    @property
    def table(self) -> Any:
        """One row per alarm, as a polars table: the key, the columns of `Alarms.table`, and p, q, faulty."""
        import polars

        begun = [row for row in self.rows if row.onsets]
        alarms = polars.concat((row.alarms.table for row in begun or self.rows[:1]), how="diagonal")
        often = [len(row.onsets) for row in self.rows]
        series = {name: np.repeat([getattr(row, name) for row in self.rows], often) for name in ("p", "q", "faulty")}
        return table_by_key(self.by, [row.key for row in self.rows], often, alarms.to_dict() | series)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        begun = sum(len(row.onsets) for row in self.rows)
        yield facts(
            ("Alarm", f"{self.kind}, one false alarm of all {len(self.rows)} series in {self.every:g} samples"),
            ("Alarms", f"{begun} in {len(self.alarmed)} series; {self.expected:.2g} false alarms expected"),
            (
                "Series",
                f"{len(self.faulty)} with a fault; at most {100.0 * self.level:g} % of those are false, on average",
            ),
        )
        table = table_of("The most extreme first", "", "alarms", "the first", "p", "q", "", names=1)
        for row in self.rows[:SHOWN]:
            numbers = (p_text(row.p), p_text(row.q), "fault" if row.faulty else "")
            table.add_row(Text(key_text(row.key)), str(len(row.onsets)), Text(row.first), *numbers)
        yield table
        if len(self.rows) > SHOWN:
            yield Text(f" and {len(self.rows) - SHOWN} more", "dim")
        for key, reason in list(self.failed.items())[:SHOWN]:
            yield Text(f" not judged, {key_text(key)}: {reason}")


def alarms(
    runs: Mapping[Hashable, Track], by: tuple[str, ...], kind: str, *, every: float, level: float, reference: Any,
    **settings: Any,
) -> ManyAlarms:  # fmt: skip
    """Watch runs by key, whose parts ``by`` names; ``reference`` is the same for all, or a mapping from every key to
    its own.
    """
    if not runs:
        raise ValueError("detect: no series has a result to watch.")
    level = numbers("detect", "level", level, ndim=0)
    if not 0.0 < level < 1.0:
        raise ValueError(f"detect: level must lie between 0 and 1; got {level!r}.")
    every = numbers("detect", "every", every, ndim=0, low=1.0, strict=True)
    own = isinstance(reference, Mapping) and any(key in reference for key in runs)
    lacking = [key_text(key) for key in runs if own and key not in reference]
    if lacking:
        raise ValueError(
            f"detect: reference is missing for {', '.join(lacking[:SHOWN])}; give one for every key, or one for all."
        )

    each = {key: reference[key] if own else reference for key in runs}
    settings = {"every": every * len(runs)} | settings
    settled = _by_groups(runs, kind, each, level, settings) if kind == "glr" and "records" not in settings else {}
    rest = [key for key in runs if key not in settled]
    alarms = settled | on_all_cores(rest, lambda key: (runs[key], kind, each[key], settings), _judged, "alarms")
    good = {key: one for key in runs if isinstance(one := alarms[key], Judged)}
    errors = {key: one for key in runs if isinstance(one := alarms[key], ValueError)}
    if not good:
        raise next(iter(errors.values()))
    q = discoveries(np.array([one.p for one in good.values()]))
    rows = [
        Watch(key, runs[key], *one, float(a), bool(a < level)) for (key, one), a in zip(good.items(), q, strict=True)
    ]
    rows.sort(key=lambda row: (np.isnan(row.q), row.p))
    return ManyAlarms(tuple(rows), kind, float(every), level, {key: str(error) for key, error in errors.items()}, by)


class Judged(NamedTuple):
    """What is kept of the alarms of a series: fields of `Watch`."""

    rule: AlarmRule
    start: int
    p: float
    onsets: tuple[int, ...]
    first: str


def _judged(run: Track, kind: str, reference: Any, settings: dict[str, Any]) -> Judged | ValueError:
    """The alarms of a series by its own limits, or why there are none."""
    try:
        alarms = detect(run, kind, reference=reference, **settings)
    except ValueError as error:
        return error
    begun = tuple(map(int, alarms.onsets))
    first = f"{run.time_text(begun[0])}, {alarms.cause(begun[0])}" if begun else ""
    return Judged(alarms.rule, alarms.start, alarms.p, begun, first)


def _by_groups(
    runs: Mapping[Hashable, Track], kind: str, each: dict[Hashable, Any], level: float, settings: dict[str, Any]
) -> dict[Hashable, Judged | ValueError]:
    """The series that the limits of their groups show to be without a fault, and those that cannot be judged."""
    asked, seed = asked_for(kind, settings["every"]), int(settings.get("seed", 0))
    first = on_all_cores(runs, lambda key: (runs[key], asked, each[key]), _first_look, "reference models")
    looks = {key: one for key, one in first.items() if isinstance(one, Look)}
    groups: dict[Hashable, list[Hashable]] = {}
    for key, one in looks.items():
        groups.setdefault(one.like, []).append(key)

    def chosen(like: Hashable) -> tuple[list[tuple[Track, AlarmRule, Reference]], int]:
        members, few = groups[like], min(len(groups[like]), RECORDS)  # evenly spaced
        keys = [members[k * len(members) // few] for k in range(few)]
        return [(runs[key], looks[key].rule, each[key]) for key in keys], seed

    found, settled = on_all_cores(groups, chosen, _limits_of, "limits"), {}
    rules = {
        key: replace(looks[key].rule, limits=plain(found[like][0]), growth=plain(found[like][1]), unsure=found[like][2])
        for like, members in groups.items()
        for key in members
    }
    nan = float("nan")
    p = {key: chance_of(rules[key], one.extreme, one.samples) if one.samples else nan for key, one in looks.items()}
    q = dict(zip(p, discoveries(np.array(list(p.values()))), strict=True))
    for key, one in looks.items():
        alarm = -np.expm1(-one.samples / asked.every)  # the p-value of a series whose largest statistic is at its limit
        if not (q[key] <= MARGIN * level or p[key] <= MARGIN * alarm):
            settled[key] = Judged(rules[key], one.start, p[key], (), "")
    return settled | {key: one for key, one in first.items() if isinstance(one, ValueError)}


class Look(NamedTuple):
    """A series before its limits are known: its reference model and its largest statistics."""

    rule: AlarmRule
    start: int
    extreme: Array
    """(c,)"""
    samples: int
    """Number of samples with a statistic."""
    like: Hashable
    """A key that is equal for series that are alike."""


def _first_look(run: Track, asked: AlarmRule, reference: Reference) -> Look | ValueError:
    try:
        rule, normal, start, rows = modelled(run, asked, in_samples(run, reference))
    except ValueError as error:
        return error
    statistic = findings_of(rule, rows, start)[0][:, : len(rule.names)]
    count = int(np.isfinite(statistic[start:]).any(axis=1).sum())
    return Look(rule, start, highest(statistic, start), count, like(rule, normal))


def like(rule: AlarmRule, normal: Normal) -> Hashable:
    """A key that is equal for references that are alike."""
    frozen, x = normal.frozen, normal.known.x
    length, tails = round(2.0 * np.log2(len(x))), round(TAILS * np.mean(np.abs(x) < CLIPS[0]))
    noise = length, tails, frozen.numbers[CLIP], bool(frozen.numbers[ALPHA] > 0.0), drawn_in_blocks(normal)
    return rule.parameters, *noise, frozen.numbers[CONSTANT] if len(frozen.mean) else None


def _limits_of(chosen: Sequence[tuple[Track, AlarmRule, Reference]], seed: int) -> tuple[Array, Array, float]:
    """`limits`, from RECORDS or a few more records simulated from the chosen runs."""
    each, parts = -(-RECORDS // len(chosen)), []
    for k, (run, asked, reference) in enumerate(chosen):
        parts.append(simulated(modelled(run, asked, in_samples(run, reference)).normal, seed + k, each))
    return limits(np.concatenate(parts), chosen[0][1].every)

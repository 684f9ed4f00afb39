"""Alarms of many runs at once: a fleet, or the outputs of one record; `driftfit.judge.alarms.detect` treats one run.

N series, each with one false alarm in ``every`` samples, together give N alarms in that time. Here ``every`` refers to
all of them together: each gets one alarm in N every samples. Rates add up whether or not the series are independent.

An alarm says when. Which series had a fault is a separate question for the complete records: `Alarms.p` is the
probability that a record without a fault is as extreme as this one, and

    q_(k) = min over j >= k of  p_(j) N / j         (p in ascending order)

is below ``level`` for the series in ``faulty``. On average at most that share of them has no fault, if the series are
independent or positively dependent. A series can have an alarm and not be among them, and vice versa.

The limits of "glr" and "cusum" come from simulated records. A series is first judged by the limits of a group of like
series (`driftfit.judge.alarms.groups`), and by limits of its own if an alarm or a fault is possible then. So every
alarm and every fault that is reported is one by the limits that the series has as a single run.

Source: Benjamini and Hochberg (1995); Besag and Clifford (1991) for a simulation that ends when the answer is clear.
Cost: that of `detect` for each run; for "glr" and "cusum" that of the reference model and the statistics, and a
bootstrap for each series in doubt. Limits by ``calibrate=True`` need records for N every samples, N times. Memory: two
kilobytes for each series; its statistics are computed again when `Watch.alarms` is read.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.settings import numbers
from driftfit.judge.alarms.detect import Alarms, asked_for, detect, judged
from driftfit.judge.alarms.groups import Look, chance, in_doubt, look, with_limits
from driftfit.judge.cores.on_all_cores import on_all_cores
from driftfit.judge.fleet_verdict import SHOWN, discoveries
from driftfit.judge.verdict import p_text
from driftfit.run.keyed_results import table_by_key
from driftfit.run.live.rule import FROZEN, AlarmRule
from driftfit.show.text import Printed, facts, key_text, table_of

if TYPE_CHECKING:
    from driftfit.run.result import Track


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
    settled = _by_groups(runs, kind, each, level, settings) if kind in FROZEN and "records" not in settings else {}
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
    asked = asked_for(kind, **{name: settings[name] for name in ("every", "window", "hold") if name in settings})

    first = on_all_cores(runs, lambda key: (runs[key], asked, each[key]), _first_look, "reference models")
    looks = {key: one for key, one in first.items() if isinstance(one, Look)}
    rules = with_limits(runs, looks, each, int(settings.get("seed", 0)))
    p = {key: chance(runs[key], rules[key], one) for key, one in looks.items()}
    q = dict(zip(p, discoveries(np.array(list(p.values()))), strict=True))
    quiet = (key for key, one in looks.items() if not in_doubt(p[key], q[key], level, one, asked.every))
    settled: dict[Hashable, Judged | ValueError] = {
        key: Judged(rules[key], looks[key].start, p[key], (), "") for key in quiet
    }
    return settled | {key: one for key, one in first.items() if isinstance(one, ValueError)}


def _first_look(run: Track, asked: AlarmRule, reference: Any) -> Look | ValueError:
    try:
        return look(run, asked, reference)
    except ValueError as error:
        return error

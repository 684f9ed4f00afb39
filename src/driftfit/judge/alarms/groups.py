"""Limits of the "glr" and "cusum" alarms for groups of like series, from records simulated for some of the members.

Series are alike if their reference models have the same parameters and a similar length, and if their noise is similar:
its tails (the share of small residuals, and where scores are clipped), and whether its variance changes. The deviates
of like series have nearly the same distribution, so records that are simulated from many of them serve for each, at the
cost of the bootstrap of a single one. A group of one is simulated from itself.

The limits of a group only show which series are clearly without a fault. Those need no bootstrap of their own; the
others, which `in_doubt` finds, have one. The rates of false alarms are therefore those of single runs, or lower.

Cost: that of the reference model and of the statistics of each series; a bootstrap for each group.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import plain
from driftfit.judge.alarms.bootstrap import RECORDS, drawn_in_blocks, limits, simulated, together
from driftfit.judge.alarms.frozen import CLIPS, Rows
from driftfit.judge.alarms.reference import in_samples
from driftfit.judge.alarms.statistics import Reference, chance_of, findings_of, highest, modelled
from driftfit.judge.cores.on_all_cores import on_all_cores
from driftfit.run.live.reference_model import ALPHA, CLIP, CONSTANT
from driftfit.run.live.rule import AlarmRule
from driftfit.run.result import Track

MARGIN = 4.0
"""A series is in doubt if its p-value could be this many times smaller by the limits of the series itself."""
TAILS = 100.0
"""Groups differ by 1 / TAILS in the share of residuals below the smallest of `CLIPS`."""


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


def look(run: Track, asked: AlarmRule, reference: Reference) -> Look:
    """Estimate the reference model of a run and compute its statistics."""
    rule, rows, start, samples = modelled(run, asked, in_samples(run, reference))
    statistic = findings_of(run, rule, start, samples)[0][:, rule.entries]
    count = int(np.isfinite(statistic[start:]).any(axis=1).sum())
    return Look(rule, start, highest(statistic, start), count, _like(rule, rows))


def _like(rule: AlarmRule, rows: Rows) -> Hashable:
    frozen = rule.reference
    length, tails = round(2.0 * np.log2(len(rows.x))), round(TAILS * np.mean(np.abs(rows.x) < CLIPS[0]))
    noise = length, tails, frozen.numbers[CLIP], bool(frozen.numbers[ALPHA] > 0.0), drawn_in_blocks(frozen, rows.x)
    return rule.parameters, *noise, frozen.numbers[CONSTANT] if len(frozen.mean) else None


def with_limits(
    runs: Mapping[Hashable, Track], looks: Mapping[Hashable, Look], reference: Mapping[Hashable, Reference], seed: int
) -> dict[Hashable, AlarmRule]:
    """The rule of each series with the limits of its group."""
    groups: dict[Hashable, list[Hashable]] = {}
    for key, one in looks.items():
        groups.setdefault(one.like, []).append(key)

    def chosen(like: Hashable) -> tuple[list[tuple[Track, AlarmRule, Reference]], int]:
        return [(runs[key], looks[key].rule, reference[key]) for key in _spread(groups[like])], seed

    found = on_all_cores(groups, chosen, _limits_of, "limits")
    return {
        key: replace(looks[key].rule, limits=plain(found[like][0]), growth=plain(found[like][1]), unsure=found[like][2])
        for like, members in groups.items()
        for key in members
    }


def _spread(members: Sequence[Hashable]) -> list[Hashable]:
    """At most RECORDS members, evenly spaced."""
    few = min(len(members), RECORDS)
    return [members[k * len(members) // few] for k in range(few)]


def _limits_of(chosen: Sequence[tuple[Track, AlarmRule, Reference]], seed: int) -> tuple[Array, Array, float]:
    """`limits`, from RECORDS or a few more records simulated from the chosen runs."""
    each, parts = -(-RECORDS // len(chosen)), []
    for k, (run, asked, reference) in enumerate(chosen):
        rule, rows, *_ = modelled(run, asked, in_samples(run, reference))
        parts.append(simulated(rule.reference, rows, seed + k, each))
    rule = chosen[0][1]
    return limits(together(parts), rule.kind == "cusum", rule.every)


def chance(run: Track, rule: AlarmRule, found: Look) -> float:
    """The p-value of a series by these limits; NaN if nothing was judged."""
    return chance_of(run, rule)(found.extreme, found.samples) if found.samples else float("nan")


def in_doubt(p: float, q: float, level: float, found: Look, every: float) -> bool:
    """Whether an alarm or a fault is possible by the limits of the series itself."""
    alarm = -np.expm1(-found.samples / every)  # the p-value of a series whose largest statistic is at its limit
    return bool(q <= MARGIN * level or p <= MARGIN * alarm)

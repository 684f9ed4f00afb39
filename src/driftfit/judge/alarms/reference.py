"""The reference of an alarm, a normal segment of a record: a number of first samples, or an interval of time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.limits import end_of
from driftfit.engine.kernel import Array
from driftfit.engine.settings import plain, whole
from driftfit.judge.alarms.bootstrap import Normal
from driftfit.judge.alarms.frozen import frozen_model
from driftfit.judge.evidence import judged_rows
from driftfit.judge.regressors import earlier_outputs, regressors
from driftfit.judge.statistics.coarse_readings import explained, step_of
from driftfit.judge.statistics.robust import orthonormal
from driftfit.readings import gate
from driftfit.run.columns import COLLECTED, collect
from driftfit.run.live.alarm import innovations
from driftfit.run.live.reference_model import BLAMED, INTERVAL, NOISE_FACTOR, OK, ROW, Y, judgeable
from driftfit.run.live.rule import OFFSET, AlarmRule, chances, check_fits, drawn, seed_of
from driftfit.run.program import lanes_of
from driftfit.run.result import Track, burn_in

Reference = Mapping[str, tuple[float, float]] | tuple[Any, Any] | int | None

LEAST = 20
"""Smallest number of samples of a reference after the start of the run."""
DOUBT = 0.01
"""Level of the test of whether the reference is constant."""


def least(kind: str, n: int) -> int:
    """Normal samples after the start of a run of n parameters that an alarm of a kind needs."""
    return max(100, 10 * n) if kind == "glr" else LEAST


def in_samples(run: Track, reference: Any) -> Any:
    """A reference given as an interval of time, converted to samples; any other is returned unchanged."""
    if isinstance(reference, tuple | list) and len(reference) == 2:
        return tuple(_place(run, one) for one in reference)
    return reference


def normal_samples(run: Track, reference: Any) -> tuple[int, int]:
    """(first, end) of the normal samples, without the start of the run; ValueError if there are too few.

    ``reference`` is a number of first samples, or (from, to) in samples, without the last.
    """
    begun = burn_in(run.model.n)
    if len(run) < begun + LEAST:
        raise ValueError(
            f"detect: a run of {len(run)} samples is too short for a reference: its first {begun} samples are its "
            f"start, and at least {LEAST} normal ones are needed after them."
        )
    if isinstance(reference, tuple) and len(reference) == 2:
        first, end = reference
    elif reference is None or isinstance(reference, tuple | list):
        raise ValueError(
            'detect: give the normal range of the parameters, reference={"b1": (0.9, 1.1)}, the number of first '
            f"samples that are normal, reference=500, or an interval, reference=(from, to); got {reference!r}."
        )
    else:
        first, end = 0, whole("detect", "reference", reference, 1)
    used = max(first, begun)
    if not used + LEAST <= end <= len(run):
        raise ValueError(
            f"detect: the reference covers samples {first} to {end} of a run of {len(run)}, whose first {begun} "
            f"are its start and do not count: {max(end - used, 0)} remain, and at least {LEAST} are needed."
            if end <= len(run)
            else f"detect: the reference ends at sample {end}, and the run has {len(run)}."
        )
    return used, end


def first_third(run: Track, usable: Array, least: int) -> tuple[int, int]:
    """(first, end) of the samples that are taken as normal where no reference was given: the first third of the record,
    and up to three quarters if fewer would have less than ``least`` ``usable`` samples.
    """
    begun = burn_in(run.model.n)
    enough = np.flatnonzero(np.cumsum(usable[begun:]) >= least)
    needed = begun + int(enough[0]) + 1 if enough.size else len(run)
    return normal_samples(run, max(len(run) // 3, min(needed, 3 * len(run) // 4)))


def _place(run: Track, given: Any) -> int:
    """The first sample at or after a time, or a sample number."""
    if run.time.dtype.kind == "M" and isinstance(given, int | np.integer):
        return min(int(given), len(run))
    return int(np.searchsorted(run.time, end_of("detect: reference", given, run.time, run.labels.zone, 0)))


class Modelled(NamedTuple):
    """A rule with the model of its reference, without limits."""

    rule: AlarmRule
    normal: Normal
    start: int
    """Its first sample after the reference."""
    rows: Array
    """(T, n + 4): the samples of the run, as `rows_of` gives them."""


def by_innovations(run: Track) -> bool:
    """Whether the innovations of the tracker are judged: the model is no regression, or not of what it estimates."""
    return run.model.hidden is not None or run.theta.shape[1] != run.model.n


def rows_of(run: Track) -> Array:
    """Regressors of a run and the columns of `ROW` (T, n + 4), as the tracker receives them; "ok" are the samples that
    are `judgeable`."""
    steps = run.program.steps._replace(store=collect)
    tile = run.fresh()
    out = run.program.inspected(tile, len(run), COLLECTED)
    y, u, known = lanes_of(run.record)
    run.program.drivers(steps=steps).run(tile, y, u, known, out)
    noise = np.broadcast_to(run.known.noise, len(run))
    found = {"y": out["y"][:, 0], "ok": judgeable(out, 0, y[:, 0], noise), "noise": noise, "dt": out["dt"][:, 0]}
    phi = out["phi"][..., 0]
    if by_innovations(run):
        phi, found = phi[:, :0], found | innovations(run.innovation, run.innovation_std**2, found["ok"])
    return np.column_stack([phi, *(found[name] for name in ROW)])


def with_offset(rows: Array, rule: AlarmRule) -> Array:
    """The same with the constant regressor of the model of the reference, if it has one of its own."""
    return np.insert(rows, rows.shape[1] - len(ROW), 1.0, axis=1) if rule.parameters[-1:] == (OFFSET,) else rows


def modelled(run: Track, rule: AlarmRule, reference: Reference) -> Modelled:
    """The rule of "glr" with the model of the reference."""
    if isinstance(reference, Mapping):
        raise ValueError('detect: the reference of "glr" must be a number of samples, such as 500, or (from, to).')
    if by_innovations(run):
        check_fits(replace(rule, parameters=(OFFSET,)), run.tracker, run.names)
    every = rows_of(run)
    n = every.shape[1] - len(ROW)
    usable = (every[:, n + OK] > 0.0) & (every[:, n + INTERVAL] > 0.0)
    enough = least("glr", n)
    first, start = first_third(run, usable, enough) if reference is None else normal_samples(run, reference)
    rows, names = every[first:start].copy(), run.model.names if n else ()
    if run.program.gate is not None:
        usable[run.in_rows("reason") % gate.SIGNAL == gate.FROZEN] = False  # other refused readings are normal ones
    rows[:, n + OK] *= usable[first:start]
    ok = rows[:, n + OK] > BLAMED
    if ok.sum() < enough:
        raise ValueError(
            f'detect: "glr" compares with {enough} normal samples at least; samples {first} to {start} contain '
            f"{ok.sum()} that can be used. Give a longer normal segment, reference=(from, to), or "
            'reference={"b1": (0.9, 1.1)} with kind="band".'
        )
    constants = np.flatnonzero((np.ptp(rows[ok, :n], axis=0) == 0.0) & (rows[ok][0, :n] != 0.0))
    if not len(constants):
        names, constants = (*names, OFFSET), np.array([n])
    rule = replace(rule, parameters=names, names=("one parameter", "parameters", "noise"))
    rows = with_offset(rows, rule)
    rounding = _drawn(rows, step_of(run.y[first:start]) if n else 0.0, ok)
    at = np.arange(first, start)
    back = earlier_outputs(run, at, rows[:, :n], every[:, n + Y], np.ones(len(at))) if n else None
    delays = () if back is None else tuple(zip(back.columns.tolist(), back.delays.tolist(), strict=True))
    found = frozen_model(rows, int(constants[-1]), [column for column, _ in delays])
    if found is None:
        raise ValueError(
            'detect: "glr" measures changes in units of the noise, and the reference has none: constant parameters '
            f"explain samples {first} to {start} without error. Choose another reference."
        )
    frozen, known = found
    rule = replace(rule, frozen=tuple(plain(one) for one in frozen[:-1]), rounding=rounding)
    return Modelled(rule, Normal(rows, delays, frozen, known), start, every)


def _drawn(rows: Array, step: float, ok: Array) -> tuple[float, ...]:
    """Draw the readings of a reference again within the step of a coarse sensor: (step, noise, seed) of it; (), and the
    readings remain as they are, if constants do not explain those that are ``ok`` as rounded ones.
    """
    n = rows.shape[1] - len(ROW)
    root = np.sqrt(rows[ok, n + NOISE_FACTOR])
    basis = orthonormal(rows[ok, :n] / root[:, None]) if step else None
    y = rows[ok, n + Y] / root
    found = explained(basis.Q, y, step / root) if basis is not None and basis.distinct else None
    if found is None:
        return ()
    seed = seed_of(y, step / root)
    rows[ok, n + Y] = root * drawn(y, *found, 0.5 * step / root, chances(0, int(ok.sum()), seed))
    return step, found[1], float(seed + 1)  # later samples draw other numbers


def doubt(run: Track, first: int, end: int) -> str:
    """Why samples first .. end are no good reference, in words: when the parameters change there; empty if not."""
    if by_innovations(run):
        return ""
    rows = regressors(run)
    inside = (rows.at >= first) & (rows.at < end)
    found = judged_rows(rows.only(inside, range(rows.phi.shape[1])), DOUBT) if inside.any() else None
    if found is None or not found.rejected:
        return ""
    at, names = rows.at[inside], ", ".join(run.model.names[j] for j in found.moving)
    dates = [int(at[row]) for row in found.found.breaks] if found.kind.name == "steps" else []
    if not dates:
        return f"{names} of the reference moves gradually: choose another segment, reference=(from, to)"
    ends = [first, *dates, end]
    longest = int(np.argmax(np.diff(ends)))
    when, one, other = (run.time_text(t) for t in (dates[0], ends[longest], ends[longest + 1] - 1))
    return f"{names} of the reference changes at {when}: choose a segment of it, such as {one} to {other}"

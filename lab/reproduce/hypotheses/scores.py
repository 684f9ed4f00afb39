"""How a tracker is judged against the truth."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.engine.kernel import Array
from driftfit.models.regression import Regression
from driftfit.results import Track
from driftfit.tracking import track
from lab.jumps import MODEL, START, Jumping, jumping
from lab.reproduce.hypotheses.contests import Contest, Entry

REACH, QUIET = 20, 50
"""Samples after a jump that belong to it, and after which the path counts as steady."""
recorded = cache(jumping)
"""Records, which are the same for all rows of a table."""
HEADS = ("RMSE", "+-", "after", "steady", "det", "delay", "FA", "log p", "NEES/n", "leaves")
"""+- is the standard error of the RMSE over records."""


class Score(NamedTuple):
    """Sums over one record, to be pooled."""

    squares: Array
    """(3,): squared error of all, after jumps, steady."""
    counts: Array
    """(3,): samples of each."""
    found: int
    jumps: int
    delay: float
    false: int
    log_p: float
    nees: float
    leaves: float


def run(entry: Entry, record: Jumping) -> Track:
    """Track a record."""
    prob = None if entry.prior is None else entry.prior(record)
    if not entry.literal:
        return track(MODEL, entry.tracker, record.y, record.u, prob=prob, keep="cov")
    past = np.r_[0.0, 0.0, record.y]
    rows = np.stack([past[1:-1], past[:-2], record.u], axis=1)
    return track(Regression(3), entry.tracker, record.y, rows, prob=prob, keep="cov")


def alarms(entry: Entry, made: Track) -> Array:
    """Samples after which a change was called; changes reported within `REACH` samples of an alarm belong to it."""
    if entry.alarm is None:
        return np.zeros(0, int)
    kept: list[int] = []
    for t in np.flatnonzero(entry.alarm(made.hypotheses)).tolist():
        if not kept or t >= kept[-1] + REACH:
            kept.append(t)
    return np.array(kept, int)


def since_jump(record: Jumping) -> Array:
    """Samples since the last jump, or very many."""
    T = len(record.y)
    since = np.full(T, T)
    for jump in record.jumps:
        since[jump:] = np.arange(T - jump)
    return since


def parts(record: Jumping) -> tuple[Array, Array, Array]:
    """The samples that count: all, those after jumps, those long after."""
    since, late = since_jump(record), np.arange(len(record.y)) >= START
    return late, late & (since < REACH), late & (since > QUIET)


def score(entry: Entry, record: Jumping) -> Score:
    """One record."""
    made = run(entry, record)
    error = made.theta - record.theta
    square, masks = np.sum(error**2, axis=1), parts(record)
    called = alarms(entry, made)
    firsts = [called[(called >= jump) & (called < jump + REACH)] for jump in record.jumps]
    hits = [found[0] - jump for found, jump in zip(firsts, record.jumps, strict=True) if len(found)]
    is_bank = isinstance(entry.tracker, Bank)
    e, s = made.innovation, made.innovation_std
    log_p = made.hypotheses.evidence if is_bank else -0.5 * (np.log(2.0 * np.pi * s**2) + (e / s) ** 2)
    return Score(
        np.array([square[part].sum() for part in masks]), np.array([part.sum() for part in masks]), len(hits),
        len(record.jumps), float(np.sum(hits)), int(np.sum(since_jump(record)[called] >= REACH)),
        float(log_p[masks[0]].mean()), nees(error[START:], made.written("P")[START:]),
        float(made.hypotheses.leaves.mean()) if is_bank else 1.0,
    )  # fmt: skip


def nees(e: Array, P: Array) -> float:
    """Mean of e' P^-1 e / n."""
    return float(np.mean(np.einsum("ti,ti->t", e, np.linalg.solve(P, e[:, :, None])[:, :, 0])) / e.shape[1])


def pooled(squares: Array, counts: Array) -> tuple[Array, float]:
    """Root mean squares of the columns, and the standard error of the first over records."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(squares.sum(axis=0) / counts.sum(axis=0))
    each = squares[:, 0] / counts[:, 0]
    return rms, float(np.std(each) / np.sqrt(max(len(each) - 1, 1)) / (2.0 * rms[0]))


class Measured(NamedTuple):
    """A row of a table."""

    values: tuple[float, ...]
    """The numbers of `HEADS`."""
    each: Array
    """(runs,): RMSE of every record."""
    without: Array
    """(runs, 3): RMSE of all samples, of those after jumps and of those long after, each without one record."""


def measure(contest: Contest, name: str, runs: int) -> Measured:
    """The row of a table."""
    entry = contest.entries[name]
    seeds = range(contest.offset, contest.offset + runs)
    scores = [score(entry, recorded(seed, contest.T, contest.fault, contest.K)) for seed in seeds]
    squares, counts = np.array([s.squares for s in scores]), np.array([s.counts for s in scores])
    rms, error = pooled(squares, counts)
    found, jumps = sum(s.found for s in scores), sum(s.jumps for s in scores)
    calls, none = entry.alarm is not None, float("nan")
    values = (
        float(rms[0]), error, float(rms[1]), float(rms[2]),
        found / jumps if jumps and calls else none,
        sum(s.delay for s in scores) / found if found else none,
        1000.0 * sum(s.false for s in scores) / (runs * contest.T) if calls else none,
        float(np.mean([s.log_p for s in scores])), float(np.mean([s.nees for s in scores])),
        float(np.mean([s.leaves for s in scores])),
    )  # fmt: skip
    with np.errstate(invalid="ignore"):  # NaN without the only record
        without = np.sqrt((squares.sum(axis=0) - squares) / (counts.sum(axis=0) - counts))
    return Measured(values, np.sqrt(squares[:, 0] / counts[:, 0]), without)

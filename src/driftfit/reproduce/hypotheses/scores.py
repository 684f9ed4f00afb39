"""How a tracker is judged against the truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.kernel import Array
from driftfit.models.regression import Regression
from driftfit.reproduce.hypotheses.contests import Contest, Entry
from driftfit.result import Track
from driftfit.systems.jumps import MODEL, START, Jumping, jumping
from driftfit.track import track
from driftfit.trackers.bank import Bank

REACH, QUIET = 20, 50
"""Samples after a jump that belong to it, and after which the path counts as steady."""
HEADS = ("RMSE", "after", "steady", "det", "delay", "FA", "log p", "NEES/n", "leaves")


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
    prob = None if entry.told is None else entry.told(record)
    if not entry.literal:
        return track(MODEL, entry.tracker, record.y, record.u, prob=prob)
    past = np.r_[0.0, 0.0, record.y]
    rows = np.stack([past[1:-1], past[:-2], record.u], axis=1)
    return track(Regression(3), entry.tracker, record.y, rows, prob=prob)


def alarms(entry: Entry, made: Track) -> Array:
    """Samples after which a change was called."""
    if not isinstance(entry.tracker, Bank) or entry.told is not None:
        return np.zeros(0, int)
    told = made.hypotheses
    if entry.lag < 0:
        return np.array([d.decided for d in told.decisions if d.event > 0], int)
    at = min(entry.lag, told.lag_prob.shape[1] - 1)
    p = np.nan_to_num(told.lag_prob[:, at]).reshape(len(made), -1, told.sensors).sum(axis=2)
    return np.flatnonzero(p.argmax(axis=1) > 0)


def score(entry: Entry, record: Jumping) -> Score:
    """One record."""
    made = run(entry, record)
    T = len(made)
    since = np.full(T, T)
    for jump in record.jumps:
        since[jump:] = np.arange(T - jump)
    late = np.arange(T) >= START
    square = np.sum((made.theta - record.theta) ** 2, axis=1)
    parts = (late, late & (since < REACH), late & (since > QUIET))
    called = alarms(entry, made)
    firsts = [called[(called >= jump) & (called < jump + REACH)] for jump in record.jumps]
    hits = [found[0] - jump for found, jump in zip(firsts, record.jumps, strict=True) if len(found)]
    is_bank = isinstance(entry.tracker, Bank)
    e, s = made.innovation, made.innovation_std
    log_p = made.hypotheses.evidence if is_bank else -0.5 * (np.log(2.0 * np.pi * s**2) + (e / s) ** 2)
    return Score(
        np.array([square[part].sum() for part in parts]), np.array([part.sum() for part in parts]), len(hits),
        len(record.jumps), float(np.sum(hits)), int(np.sum(since[called] >= REACH)), float(log_p[late].mean()),
        nees(entry, record), float(made.hypotheses.leaves.mean()) if is_bank else 1.0,
    )  # fmt: skip


def nees(entry: Entry, record: Jumping) -> float:
    """Mean of e' P^-1 e / n."""
    prob = None if entry.told is None else entry.told(record)
    if entry.literal:
        made = run(entry, record)
        return float(np.mean(((made.theta - record.theta) / made.std)[START:] ** 2))
    made = track(MODEL, entry.tracker, record.y, record.u, prob=prob, keep="cov")
    e = (made.theta - record.theta)[START:]
    P = made._written("P")[START:]
    return float(np.mean(np.einsum("ti,ti->t", e, np.linalg.solve(P, e[:, :, None])[:, :, 0])) / e.shape[1])


def measure(contest: Contest, name: str, runs: int) -> tuple[float, ...]:
    """The row of a table."""
    entry = contest.entries[name]
    seeds = range(contest.offset, contest.offset + runs)
    scores = [score(entry, jumping(seed, contest.T, contest.fault, contest.K)) for seed in seeds]
    squares, counts = (np.sum([getattr(s, field) for s in scores], axis=0) for field in ("squares", "counts"))
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(squares / counts)
    found, jumps = sum(s.found for s in scores), sum(s.jumps for s in scores)
    calls = isinstance(entry.tracker, Bank) and entry.told is None
    none = float("nan")
    return (
        *rms.tolist(), found / jumps if jumps and calls else none,
        sum(s.delay for s in scores) / found if found else none,
        1000.0 * sum(s.false for s in scores) / (runs * contest.T) if calls and jumps else none,
        float(np.mean([s.log_p for s in scores])), float(np.mean([s.nees for s in scores])),
        float(np.mean([s.leaves for s in scores])),
    )  # fmt: skip

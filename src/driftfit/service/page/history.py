"""The past of a unit, reduced on the server: least, largest and mean of every column in at most ``points`` parts.

A range with no more samples than points is sent unchanged. Beyond that, whole blocks are represented by their
extremes, so a million samples cost the reading of 16,000 short rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.service.core.blocks import FIXED, extremes_of
from driftfit.service.core.journal import Journal

MOST_ROWS = 2_000_000
"""Samples of one export at most."""


def names_of(about: Any) -> list[str]:
    """Names of the columns."""
    return [*FIXED, *about["names"], *(f"std {name}" for name in about["names"])]


def reduced(
    journal: Journal, unit: int, recent: list[list[Any]], start: float, stop: float, points: int
) -> dict[str, Any]:
    """(low, high, mean) of every column between two times, each (k, c), and the number of samples."""
    total = _count(journal, unit, start, stop)
    if total <= 2 * points:
        values = samples(journal, unit, recent, start, stop)
        parts = _parts(values, points)
        return _as_lists([extremes_of(part) for part in parts], [len(part) for part in parts])
    low_high_mean, counts, end = [], [], -1
    where = "where unit = ? and stop >= ? and start <= ? order by first"
    for _, _, last, _, _, count, extremes, _ in journal.rows("block", where, unit, start, stop):
        low_high_mean.append(np.frombuffer(extremes).reshape(3, -1))
        counts.append(count)
        end = max(end, last)
    tail = [row for row in recent if row[0] > end and start <= _time(row) <= stop]
    if tail:
        low_high_mean.append(extremes_of(columns_of(tail)))
        counts.append(len(tail))
    return _as_lists(*_joined(low_high_mean, counts, points))


def samples(journal: Journal, unit: int, recent: list[list[Any]], start: float, stop: float) -> Array:
    """All columns (T, c) between two times."""
    parts, end = [], -1
    where = "where unit = ? and first in (select first from block where unit = ? and stop >= ? and start <= ?)"
    for _, _, last, count, rows, _ in journal.rows("history", f"{where} order by first", unit, unit, start, stop):
        parts.append(np.frombuffer(rows).reshape(count, -1))
        end = max(end, last)
        if sum(map(len, parts)) > MOST_ROWS:
            raise ValueError(f"more than {MOST_ROWS} samples; ask for a shorter range.")
    tail = [row for row in recent if row[0] > end]
    if tail:
        parts.append(columns_of(tail))
    if not parts:
        return np.zeros((0, len(FIXED)))
    values = np.vstack(parts)
    return values[(values[:, 0] >= start) & (values[:, 0] <= stop)]


def latest(journal: Journal, unit: int, recent: list[list[Any]], blocks: int = 10) -> Array:
    """All columns (T, c) of the last blocks, and of the samples after them."""
    found = [*journal.rows("history", "where unit = ? order by first desc limit ?", unit, blocks)][::-1]
    end = max((row[2] for row in found), default=-1)
    parts = [np.frombuffer(row[4]).reshape(row[3], -1) for row in found]
    tail = [row for row in recent if row[0] > end]
    parts += [columns_of(tail)] if tail else []
    return np.vstack(parts) if parts else np.zeros((0, 0))


def columns_of(rows: list[list[Any]]) -> Array:
    """Results as an array (count, 5 + 2 n); where samples have no times their numbers are used."""
    values = np.array([[_time(row), *row[3:7], *row[8], *row[9]] for row in rows])
    with np.errstate(invalid="ignore"):
        values[:, 4] = np.sqrt(values[:, 4])
    return values


def _count(journal: Journal, unit: int, start: float, stop: float) -> int:
    query = "select coalesce(sum(count), 0) from block where unit = ? and stop >= ? and start <= ?"
    return int(journal.db.execute(query, (unit, start, stop)).fetchone()[0])


def _time(row: list[Any]) -> float:
    return float(row[0] if row[2] is None else row[2])


def _parts(values: Array, points: int) -> list[Array]:
    """Consecutive parts, at most ``points``."""
    return [part for part in np.array_split(values, min(points, len(values)) or 1) if len(part)]


def _joined(found: list[Array], counts: list[int], points: int) -> tuple[list[Array], list[int]]:
    """Neighbouring blocks as one, until there are at most ``points``."""
    if len(found) <= points:
        return found, counts
    places = np.array_split(np.arange(len(found)), points)
    return [_one([found[k] for k in one], [counts[k] for k in one]) for one in places], [
        sum(counts[k] for k in one) for one in places
    ]


def _one(found: list[Array], counts: list[int]) -> Array:
    stack, weight = np.stack(found), np.array(counts, float)[:, None]
    fine = np.isfinite(stack[:, 2])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(fine, stack[:, 2] * weight, 0.0).sum(axis=0) / np.where(fine, weight, 0.0).sum(axis=0)
    low = np.where(fine, stack[:, 0], np.inf).min(axis=0)
    high = np.where(fine, stack[:, 1], -np.inf).max(axis=0)
    return np.where(fine.any(axis=0), np.stack([low, high, mean]), np.nan)


def _as_lists(found: list[Array], counts: list[int]) -> dict[str, Any]:
    """Columns as lists, None where there is no number."""
    if not found:
        return {"count": 0, "low": [], "high": [], "mean": []}
    stack = np.stack(found)
    plain = stack.astype(object)
    plain[~np.isfinite(stack)] = None
    kinds = {name: plain[:, k].T.tolist() for k, name in enumerate(("low", "high", "mean"))}
    return {"count": int(sum(counts)), **kinds}

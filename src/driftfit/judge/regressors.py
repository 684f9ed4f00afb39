"""The regression behind a run, which of its columns a test can tell apart, and how well windows of it do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.null import Lags
from driftfit.judge.constant_fit import constant_least_squares
from driftfit.judge.statistics.coarse_readings import step_of
from driftfit.judge.statistics.robust import orthonormal, sole
from driftfit.models.base import Model
from driftfit.run.result import Track, burn_in
from driftfit.smooth.solvers.rank import column_sizes


class Rows(NamedTuple):
    """The N usable samples, scaled to the noise variance of weight 1."""

    at: Array
    """(N,): their sample numbers in the record."""
    phi: Array
    """(N, n)"""
    y: Array
    """(N,)"""
    step: Array | None = None
    """(N,): the steps of a coarse sensor; None if it is fine."""
    lags: Lags | None = None
    """Which columns are earlier outputs; None if none is."""
    root: Array | None = None
    """(N,): what phi and y were multiplied by; None for 1."""

    def only(self, rows: Array, columns: Sequence[int]) -> Rows:
        """Some of the rows (a mask or indices), and some of the columns."""
        lags = None if self.lags is None else self.lags.only(np.arange(len(self.y))[rows], columns)
        phi = np.ascontiguousarray(self.phi[rows][:, columns])
        step, root = (None if one is None else one[rows] for one in (self.step, self.root))
        return Rows(self.at[rows], phi, self.y[rows], step, lags, root)


class Distinct(NamedTuple):
    """Which of n columns of regressors a test can tell apart."""

    kept: tuple[int, ...]
    """Linearly independent columns, as many as there are: the constant one, and of others the first."""
    groups: tuple[tuple[int, ...], ...]
    """Columns that are linearly dependent on each other; those of zeros, and those apart from all groups, are in none.
    """


COEFFICIENT = 1e-7
"""A coefficient above this, of columns of unit length, is not rounding."""


def distinct(phi: Array) -> Distinct:
    """The columns of phi (N, n) that are linearly independent, whatever their units."""
    N, n = phi.shape
    basis = orthonormal(phi) if n < N else None
    if basis is None or basis.distinct:
        return Distinct(tuple(range(n)), ())
    constant = [i for i in range(n) if np.ptp(phi[:, i]) == 0.0]
    order = [*constant[::-1], *(i for i in range(n) if i not in constant)]
    kept: list[int] = []
    for i in order:
        if np.linalg.matrix_rank(basis.R[:, [*kept, i]], basis.negligible) > len(kept):
            kept.append(i)
    kept.sort()
    groups: list[set[int]] = []
    for i in set(order) - set(kept):
        of = np.linalg.lstsq(basis.R[:, kept], basis.R[:, i], rcond=None)[0]
        new = {i, *(kept[k] for k in np.flatnonzero(np.abs(of) > COEFFICIENT))}
        joined = [group for group in groups if group & new]
        groups = [group for group in groups if not group & new] + [new.union(*joined)]
    return Distinct(tuple(kept), tuple(tuple(sorted(group)) for group in groups if len(group) > 1))


def judged_by_others(rows: Rows) -> tuple[Rows, Distinct]:
    """Rows without those that alone determine a coefficient, as that of a pulse that comes once, and the columns that
    the others tell apart.

    The outputs of such rows say nothing about a change: any value of that coefficient is possible before and after.
    """
    found = distinct(rows.phi)
    if not 0 < len(found.kept) < len(rows.y):
        return rows, found
    alone = sole(orthonormal(rows.phi[:, found.kept]).Q)
    if not alone.any():
        return rows, found
    rows = rows.only(~alone, range(rows.phi.shape[1]))
    return rows, distinct(rows.phi)


def refuse_hidden(verb: str, model: Model, instead: str) -> None:
    """ValueError for a model with hidden states, whose samples are not those of a regression."""
    if model.hidden is not None:
        raise ValueError(
            f"{verb}: a {type(model).__name__} moves hidden states, so there is no regression of which it could judge "
            f"the coefficients; use {instead}."
        )


def regressors(run: Track, steady: Array | None = None) -> Rows:
    """The record as samples of a regression for the model of a run; ``steady`` are its constants, if they are known."""
    out = constant_least_squares(run.model, run.record) if steady is None else steady
    at = np.flatnonzero(out["ok"][:, 0] > 0.0)
    noise = run.known.part(at).noise
    root = 1.0 / np.sqrt(noise)
    y = out["y"][at, 0]
    phi = out["phi"][at, :, 0]
    phi = phi if run.model.implicit is None else run.model.implicit.settled(phi, y, run.u, at)
    step, lags = step_of(run.y), earlier_outputs(run, at, phi, out["y"][:, 0], root)
    scaled = phi * np.reshape(root, (-1, 1)), y * root
    return Rows(at, *scaled, step * np.broadcast_to(root, at.shape) if step else None, lags, root * np.ones(len(at)))


def earlier_outputs(run: Track, at: Array, phi: Array, y: Array, root: Array) -> Lags | None:
    """Which columns of phi (N, n) are outputs y (T,) of earlier samples than at (N,), in every row that has such."""
    count = run.model.output_lags or 0
    if not count or not len(at):
        return None
    place = np.full(len(y), -1)
    place[at] = np.arange(len(at))
    columns, source, ratio = [], [], []
    root = np.broadcast_to(root, at.shape)
    for j in range(count):
        for lag in range(1, count + 1):
            before = at - lag
            past = np.where(before >= 0, y[before], np.nan)
            known = np.isfinite(past)
            if known.any() and (past[known] == phi[known, j]).all():
                row = np.where(known, place[before], -1)
                columns.append(j)
                source.append(row)
                ratio.append(root / np.where(row >= 0, root[row], 1.0))
                break
    if not columns:
        return None
    return Lags(np.array(columns), np.stack(source, axis=1), np.stack(ratio, axis=1))


INDEX = 100.0
"""Limit of the condition index. Belsley, Kuh and Welsch call dependence moderate to strong from 30; beyond this limit
the parameters of a window are determined by earlier samples.
"""


class Excitation(NamedTuple):
    """Windows of W samples, half overlapping."""

    at: Array
    """(w,): index of the last sample of each window, among the samples used."""
    eigenvalues: Array
    """(w, n) ascending."""
    direction: Array
    """(n,): the scaled combination of parameters that the worst window determines least."""

    @property
    def condition(self) -> Array:
        """(w,): condition index of each window; inf where a direction is not excited at all."""
        low, high = self.eigenvalues[:, 0], self.eigenvalues[:, -1]
        with np.errstate(divide="ignore", invalid="ignore"):
            condition: Array = np.sqrt(high / np.maximum(low, 0.0))
        return np.where(high > 0.0, condition, np.inf)


def excitation(phi: Array, window: int | None = None) -> Excitation:
    """Whether regressors phi (N, n) distinguish the parameters in a window, of max(50, 5 n) samples unless it is given.

        R_w = (1 / W) sum over a window of psi_t psi_t',     psi_ti = phi_ti / rms of regressor i over the record

    The smallest eigenvalue of R_w over the largest is the reciprocal of the squared condition index of Belsley, Kuh and
    Welsch (1980). Scaling makes it independent of units, and it is small in a window in which an input is constant.
    """
    N, n = phi.shape
    W = burn_in(n) if window is None else window
    ends = np.arange(W, N + 1, max(W // 2, 1))
    if not len(ends):
        return Excitation(np.zeros(0, int), np.zeros((0, n)), np.full(n, np.nan))
    scaled = phi / column_sizes(phi)
    R = np.array([scaled[end - W : end].T @ scaled[end - W : end] / W for end in ends])
    values, vectors = np.linalg.eigh(R)
    found = Excitation(ends - 1, np.maximum(values, 0.0), vectors[0, :, 0])
    return found._replace(direction=vectors[int(np.argmax(found.condition)), :, 0])

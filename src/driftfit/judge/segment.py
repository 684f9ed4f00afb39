"""Segments of a whole record: between which dates were the parameters constant, and how certain are the dates?

    min over breaks of  sum over segments of min_theta sum (y_t - phi_t' theta)^2 / noise  +  penalty * number of breaks

The minimum is found exactly by pruned dynamic programming (`driftfit.judge.statistics.partition`). Rows are first
divided by the level of the noise, whitened if it is an autoregression, and limited to three levels from the fit, so
that an outlier does not become a segment (`driftfit.judge.statistics.noise`). If the noise is louder where regressors
are large, rows are weighted and the search is repeated (`driftfit.judge.segments.noise_of_regressors`). The penalty is
chosen so that a record of constant parameters is divided with probability ``false``. Each date has an interval that
contains the true one with probability at least ``level`` (`driftfit.judge.statistics.break_dates`), given that there
is a break. What a segment does not determine has an infinite error (`driftfit.judge.segments.determined`).

Use it on complete records in which parameters jump and are constant in between. A `Bank` does the same on-line, and
`Track.smooth` estimates parameters that drift: a slow drift is cut into steps here. A record of more than 2000 samples
is first divided on a grid with that many positions, and every date is then moved to the most likely position among all
samples between its neighbours; two breaks closer than ``shortest`` are not distinguished.

Source: Bai and Perron (1998, 2003) for breaks in regressions; Killick, Fearnhead and Eckley (2012) for the pruning; Yao
(1987), Bai (1997) for dates. Departures: whitening, outliers, weights, a penalty from a rate of false breaks, and
dates from their likelihood. Cost: O(T n^2) and at most CELLS^2 / 2 factors of order n + 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.data.record import Reading
from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.judge.regressors import refuse_hidden, regressors
from driftfit.judge.segments.determined import Determined, doubtful
from driftfit.judge.segments.joint_autoregression import jointly
from driftfit.judge.segments.noise_of_regressors import relative_size
from driftfit.judge.statistics.break_dates import dated
from driftfit.judge.statistics.constancy import shortest as shortest_of
from driftfit.judge.statistics.noise import HELD, Noise, begun, whitened
from driftfit.judge.statistics.parts.coarse_readings import drawn_within
from driftfit.judge.statistics.robust import clipped, fit_in, least_squares, noisy, orthonormal, robust_fit
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.result import Track
from driftfit.run.track import in_rows_only
from driftfit.show.axes import BLUE, GREY, RED, date_axis, panels, time_label
from driftfit.show.text import Printed, digits, table_of
from driftfit.trackers.rls import RLS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CELLS = 2000
"""Largest number of positions for breaks that are compared at once."""


class Break(NamedTuple):
    """A change of parameters: the first sample with the new ones, and an interval for it.

    ``date, first, last`` are times if the record has them, otherwise sample numbers; ``at`` is the sample number of
    date.
    """

    date: Any
    first: Any
    last: Any
    at: int


class Segment(NamedTuple):
    """Samples start .. stop - 1 of the record, with constant theta (n,) and standard errors (n,).

    An error is inf where the segment does not determine the parameter, because an input rests there. theta is then
    that of the last segment that does, or of the whole record, moved only where the outputs of the segment require it.
    An error is NaN where the segment is too short.
    """

    start: int
    stop: int
    theta: Array
    std: Array


@dataclass(frozen=True)
class Segmentation(Printed):
    """The result of `segment`; printing it shows a table.

    Attributes
    ----------
    breaks : tuple of Break
        Sorted by time; one fewer than segments.
    segments : tuple of Segment
    level : float
        An interval holds its date with at least this probability.
    penalty : float
        Penalty of a break, in units of the noise variance.
    noise : float
        Standard deviation of the noise, the median over time.
    ar : tuple of float
        Autoregression of the noise; empty if it is white.
    """

    breaks: tuple[Break, ...]
    segments: tuple[Segment, ...]
    level: float
    penalty: float
    noise: float
    ar: tuple[float, ...]
    run: Track = field(repr=False, compare=False)
    undivided: str = ""
    """Why the record was not searched for breaks; empty if it was."""

    @property
    def theta(self) -> Array:
        """Parameters at every sample, (T, n)."""
        return np.repeat([s.theta for s in self.segments], [s.stop - s.start for s in self.segments], axis=0)

    def summary(self) -> str:
        """The segments as a table, as text."""
        return str(self)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        count = len(self.breaks)
        yield Text(f" {count or 'no'} break{'' if count == 1 else 's'}, dates with {100.0 * self.level:g} % intervals")
        names = self.run.model.names
        text = self.run.time_text
        for one in self.breaks:
            yield Text(f" {text(one.at)}, from {text(self._sample(one.first))} to {text(self._sample(one.last))}")
        heads = (text for name in names for text in (name, "+-"))
        table = table_of("Segments, from sample", "", "samples", *heads, group=2)
        for part in self.segments:
            pairs = zip(part.theta, part.std, strict=True)
            numbers = (cell for value, std in pairs for cell in (digits(value, std), error_text(std)))
            table.add_row(str(part.start), str(part.stop - part.start), *numbers)
        yield table
        for part in self.segments:
            unknown = [name for name, std in zip(names, part.std, strict=True) if np.isinf(std)]
            if unknown:
                yield Text(f" {part.start}: {', '.join(unknown)} not determined in this segment")
        correlated = f"; autoregression of the noise {', '.join(f'{a:.2f}' for a in self.ar)}" if self.ar else ""
        searched = (
            f"not searched for breaks: {self.undivided}" if self.undivided else f"penalty of a break {self.penalty:.1f}"
        )
        yield Text(f" noise {self.noise:.4g}{correlated}; {searched}", "dim")

    def _sample(self, time: Any) -> int:
        return int(np.searchsorted(self.run.time, time))

    def plot(self, ax: Any = None) -> Figure:
        """Parameters of the segments with two standard errors, and the intervals of the dates; a matplotlib figure.

        ``ax`` as for `Track.plot`.
        """
        run = self.run
        names, time = run.model.names, run.time
        figure, axes = panels(ax, (8.0, 2.0 * len(names) + 2.0), len(names) + 1, sharex=True)
        axes[0].plot(time, run.y, ".", ms=2, color=GREY)
        axes[0].set_ylabel(run.labels.y)
        for i, (panel, name) in enumerate(zip(axes[1:], names, strict=True)):
            for part in self.segments:
                span, value, width = time[[part.start, part.stop - 1]], part.theta[i], 2.0 * part.std[i]
                width = width if np.isfinite(width) else np.nan
                panel.plot(span, [value, value], color=BLUE)
                panel.fill_between(span, value - width, value + width, color=BLUE, alpha=0.25, lw=0)
            panel.set_ylabel(name)
        for panel in axes:
            for one in self.breaks:
                panel.axvspan(one.first, one.last, color=RED, alpha=0.2, lw=0)
                panel.axvline(one.date, color=RED, lw=0.8)
        axes[-1].set_xlabel(time_label(run))
        date_axis(axes[-1], run)
        figure.align_ylabels(axes)
        return figure


def segment(
    y: Any,
    u: Any = None,
    model: Model | None = None,
    *,
    level: float = 0.95,
    false: float = 0.01,
    shortest: int | None = None,
    **record: Any,
) -> Segmentation:
    """Divide a record at the dates at which the parameters of a model change.

    Parameters
    ----------
    y, u : as for `track`
        Output and inputs.
    model : Model or None
        The model whose parameters are constant within a segment. None: the mean of y, with coefficients of u if given.
    level : number
        Level of the intervals for dates.
    false : number
        Probability that a record of constant parameters is divided, which determines the penalty. If the noise is
        correlated and its autoregression is estimated, the probability may be several times that.
    shortest : int or None
        Number of samples in the shortest segment; max(10, 4 n) by default.
    record
        Further arguments of `track`: ``data, time, dt, weights, units``.

    Raises
    ------
    ValueError
        For numbers out of range, and for everything that `track` does not accept.
    """
    if model is None:
        model = Regression(0 if u is None else None, intercept=True)
    data = record.pop("data", None)
    run = in_rows_only(model, RLS(1.0), y, u, Reading(**record), data)
    if not isinstance(run, Track):
        raise ValueError(f"segment: give one series of one output at a time; got y={y!r}.")
    return segmented(run, level=level, false=false, shortest=shortest)


def segmented(run: Track, level: float = 0.95, false: float = 0.01, shortest: int | None = None) -> Segmentation:
    """Divide the record of a run; see `segment`. The tracker is not used."""
    for name, given in (("level", level), ("false", false)):
        if not 0.0 < given < 1.0:
            raise ValueError(f"segment: {name} must be between 0 and 1, such as 0.95; got {given!r}.")
    refuse_hidden("segment", run.model, "run.theta, or a Regression")
    n = run.model.n
    least = shortest_of(n) if shortest is None else max(whole("segment", "shortest", shortest, 1), n + 1)
    rows = regressors(run)
    N = len(rows.y)
    if max(2 * least, n + 2) > N:
        needed = f"{N} samples can be used, and at least {max(2 * least, n + 2)} are needed"
        return _undivided(run, rows.phi, rows.y, level, needed)
    basis = orthonormal(rows.phi)
    if not basis.distinct:
        return _undivided(run, rows.phi, rows.y, level, "the regressors do not distinguish the parameters")
    phi, y, fit = rows.phi, rows.y, fit_in(basis, rows.y)
    step = rows.step
    if step is not None:
        y = drawn_within(basis.Q, y, step)
        fit = fit_in(basis, y)
    if not noisy(fit, phi, y):
        return _undivided(run, phi, y, level, "constant parameters explain nine of ten outputs without error")
    found = _searched(basis.Q, fit.residual, least, false)
    if step is not None and y is rows.y and len(found.breaks):  # those of segments, where constants explain none
        y = drawn_within(basis.Q, y, step, found.breaks)
        fit = fit_in(basis, y)
        found = _searched(basis.Q, fit.residual, least, false)
    size = relative_size(phi, y, found)
    if size is not None:
        basis = orthonormal(phi / size[:, None])
        weighted = fit_in(basis, y / size)
        again = _searched(basis.Q, weighted.residual, least, false)
        # weights also change the correlation of the noise: there they must explain breaks, not add some
        if not len(again.ar) or len(again.breaks) < len(found.breaks):
            phi, y, fit, found = phi / size[:, None], y / size, weighted, again
        else:
            basis, size = orthonormal(phi), None
    # a value limited by the fit still supports one side; without its row it does not
    used = np.abs(found.near) <= HELD * found.level
    X, z = basis.Q * (used / found.level)[:, None], np.where(used, found.held, 0.0) / found.level
    breaks, spans = dated(X / found.white, z / found.white, found.ar, found.breaks.tolist(), least, level)
    at = [int(rows.at[b]) for b in breaks]
    time = run.time
    edges = [0, *breaks, N]
    limits = [0, *at, len(run)]
    sure = [0, *(limit for span in spans for limit in span), N]
    parts, held = [], fit.theta
    for k, limit in enumerate(pairwise(edges)):
        theta, std = _fitted(phi, y, found, limit, (sure[2 * k], sure[2 * k + 1]), held)
        held = np.where(np.isfinite(std), theta, held)
        parts.append(Segment(limits[k], limits[k + 1], theta, std))
    described = tuple(
        Break(time[t], time[rows.at[a]], time[rows.at[b]], t) for t, (a, b) in zip(at, spans, strict=True)
    )
    spread = float(np.median(found.level if size is None else found.level * size))
    return Segmentation(described, tuple(parts), level, found.penalty, spread, tuple(map(float, found.ar)), run)


def _searched(Q: Array, y: Array, least: int, false: float) -> Noise:
    search, found, starts = begun(Q, y, CELLS, least, quiet=false)
    return jointly(search, found, starts, false)


def _fitted(
    phi: Array, y: Array, found: Noise, rows: tuple[int, int], sure: tuple[int, int], held: Array
) -> tuple[Array, Array]:
    """theta of the rows a .. b and its standard errors, Huber's for noise that is white after whitening.

    Where the rows next to a break alone tell about a direction, only the rows ``sure`` between the intervals of the
    dates are used: one row of the neighbouring segment would decide. What they do not determine stays as in ``held``
    (n,). A segment too short for errors has plain least squares, and errors
    that are not known. Where more than nine of ten readings lie on one plane, as zeros of rare counts do, Huber's scale
    vanishes, and least squares takes its place.
    """
    (a, b), p, n = rows, len(found.ar), len(held)
    c = found.level[a:b]
    X, z = phi[a:b] / c[:, None], y[a:b] / c
    short = b - a - p <= n
    first, last = (sure[0] - a, sure[1] - a) if sure[1] - sure[0] - p > n else (0, b - a)
    if not short:
        X, z = (part[p:] for part in whitened(X, z, found.ar))
        first, last = max(first - p, 0), last - p
    if doubtful(X, first, last):
        X, z = X[first:last], z[first:last]
    known = Determined.of(X)
    start = np.where(known.unknown.any(), held, 0.0)
    X_known, z = X @ known.M, z - X @ start
    if short:
        theta = start + known.M @ least_squares(X_known, z)
        return theta, np.where(known.unknown, np.inf, np.nan)
    if not X_known.shape[1]:
        return start, np.full(n, np.inf)
    fit = robust_fit(X_known, z)
    if not noisy(fit, X_known, z):  # most of it lies on one plane: the rest would not count
        beta = least_squares(X_known, z)
        fit = clipped(beta, z - X_known @ beta, np.inf)
    N, r = X_known.shape
    variance = float(fit.psi @ fit.psi) / max(N - r, 1) / max(float(np.mean(fit.inside)), 0.1) ** 2
    return start + known.M @ fit.theta, known.errors(X, variance)


def _undivided(run: Track, phi: Array, y: Array, level: float, why: str) -> Segmentation:
    """A single segment, with least squares; a parameter that the record does not determine has no standard error."""
    N, n = phi.shape
    theta, std, spread = np.full(n, np.nan), np.full(n, np.nan), float("nan")
    if N:
        theta = least_squares(phi, y)
        e = y - phi @ theta
        e = np.where(np.abs(e) <= ROUNDING * (np.abs(y) + np.abs(phi) @ np.abs(theta)), 0.0, e)
        spread = float(np.std(e))
        if n < N:
            known = Determined.of(phi)
            std = known.errors(phi, e @ e / (N - known.M.shape[1]))
    one = Segment(0, len(run), theta, std)
    return Segmentation((), (one,), level, float("nan"), spread, (), run, why)


def error_text(std: float) -> str:
    """A standard error as text; one that is not known is not a number of the table."""
    return "-" if np.isnan(std) else f"{std:.4g}"

"""Segments of a whole record: between which dates were the parameters constant, and how certain are the dates?

    y_t = x_t' theta_s + v_t,   v_t = sum a_l v_(t-l) + e_t        constant theta_s between two dates

These are the dates of the verdict, with its error rate: where constants are not rejected at ``false`` there is no
break (`driftfit.judge.changes`). A further break must gain what draws of constants gain in a fifth of that rate. Each
date has an interval that holds 95 % of its likelihood, and the parameters of a segment are weighted least squares of
all of its rows, with standard errors that count the uncertainty of the dates. What a segment does not determine has an
infinite error.

Use it on complete records in which parameters jump and are constant in between. A `Bank` does the same on-line, and
`Track.smooth` estimates parameters that drift: a slow drift is cut into steps here, and the text says where a gradual
change or a random walk explains the record better. Breaks closer than ``shortest`` are not distinguished.

Source: Bai and Perron (1998, 2003) for breaks in regressions; Jackson et al. (2005) for the partition; Yao (1987) for
dates. Cost: that of a verdict.
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
from driftfit.judge.changes.dates import informed
from driftfit.judge.changes.fit import NONE
from driftfit.judge.changes.fit import shortest as shortest_of
from driftfit.judge.changes.words import clause, events
from driftfit.judge.evidence import REJECTED, judged_rows
from driftfit.judge.regressors import refuse_hidden, regressors
from driftfit.judge.statistics.robust import orthonormal, pseudo_inverse
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.result import Track
from driftfit.run.track import run_quietly
from driftfit.show.axes import BLUE, GREY, RED, date_axis, panels, time_label
from driftfit.show.text import Printed, digits, table_of
from driftfit.trackers.rls import RLS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    better: str = ""
    """What explains the record better than these steps, in words; empty if nothing does."""

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
            numbers = (
                cell for value, std in pairs for cell in (digits(value, std), "-" if np.isnan(std) else f"{std:.4g}")
            )
            table.add_row(str(part.start), str(part.stop - part.start), *numbers)
        yield table
        if self.better:
            yield Text(f" Steps are not the best description: {self.better}.")
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
    false: float = REJECTED,
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
        Probability that a record of constant parameters is divided: the level of the test of constants.
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
    run = run_quietly(model, RLS(1.0), y, u, Reading(**record), data)
    if not isinstance(run, Track):
        raise ValueError(f"segment: give one series of one output at a time; got y={y!r}.")
    return segmented(run, level=level, false=false, shortest=shortest)


def segmented(run: Track, level: float = 0.95, false: float = REJECTED, shortest: int | None = None) -> Segmentation:
    """Divide the record of a run; see `segment`. The tracker is not used."""
    for name, given in (("level", level), ("false", false)):
        if not 0.0 < given < 1.0:
            raise ValueError(f"segment: {name} must be between 0 and 1, such as 0.95; got {given!r}.")
    refuse_hidden("segment", run.model, "run.theta, or a Regression")
    n = run.model.n
    fewest = None if shortest is None else whole("segment", "shortest", shortest, 1)
    least, rows = shortest_of(n, NONE, fewest), regressors(run)
    N = len(rows.y)
    if max(2 * least, n + 2) > N:
        needed = f"{N} samples can be used, and at least {max(2 * least, n + 2)} are needed"
        return _undivided(run, rows.phi, rows.y, level, needed)
    changes = judged_rows(rows, false, None, level, fewest)
    if changes is None:
        distinct = orthonormal(rows.phi).distinct
        why = "constant parameters explain nine of ten outputs without error"
        return _undivided(
            run, rows.phi, rows.y, level, why if distinct else "the regressors do not distinguish the parameters"
        )
    found, time = changes.found, run.time
    at = rows.at[found.breaks]
    limits = [0, *(int(t) for t in at), len(run)]
    parts = tuple(
        Segment(start, stop, theta, std)
        for (start, stop), theta, std in zip(pairwise(limits), found.theta, found.std, strict=True)
    )
    spans = rows.at[found.spans]
    breaks = tuple(Break(time[t], time[first], time[last], int(t)) for t, (first, last) in zip(at, spans, strict=True))
    other = changes.rejected and changes.kind.name != "steps"
    better = "; ".join(map(clause, events(changes, run.model.names, rows.at, run.time_text))) if other else ""
    noise = float(np.median(changes.model.noise.level))
    return Segmentation(breaks, parts, level, found.prices[0], noise, tuple(map(float, found.ar)), run, "", better)


def _undivided(run: Track, phi: Array, y: Array, level: float, why: str) -> Segmentation:
    """A single segment, with least squares; a parameter that the record does not determine has no standard error."""
    N, n = phi.shape
    theta, std, spread = np.full(n, np.nan), np.full(n, np.nan), float("nan")
    if N:
        inverse = pseudo_inverse(phi)
        theta = inverse @ y
        e = y - phi @ theta
        e = np.where(np.abs(e) <= ROUNDING * (np.abs(y) + np.abs(phi) @ np.abs(theta)), 0.0, e)
        spread = float(np.std(e))
        if n < N:
            unknown, directions = informed(phi)
            std = np.sqrt(np.sum(inverse**2, axis=1) * (e @ e) / max(N - len(directions), 1))
            std = np.where(unknown, np.inf, std)
    return Segmentation((), (Segment(0, len(run), theta, std),), level, float("nan"), spread, (), run, why)

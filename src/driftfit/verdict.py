"""Verdict: is the time variation real, which parameters move, by how much and when, and does following them pay?

Two questions that have different answers:

* *Do the parameters move?* A score test of constant coefficients (Nyblom and Hansen, `driftfit.judges.constancy`)
  whose null distribution follows the noise and the excitation of the record itself, so that outliers, a changing noise
  variance and changing inputs do not pass for drift. It asks the record, not the tracker: q and r do not enter. Where
  constants are true, "they move" is said with probability ``level``, as ``benchmarks/verdict_error_rate.py`` verifies.
* *Does following them pay?* The one-step errors of the run beside persistence, constant least squares on the past and a
  constant ARX, on the same samples, with paired tests (`driftfit.judges.paired`).

A parameter is named as one that moves where the joint test rejects, and its own still does when what was named before
it is taken into account (`driftfit.judges.attribute`).

A model without enough lags has correlated noise, which is hard to tell from a drifting intercept. The test finds from
the record how many lags of correlation it must allow for, ``lags=`` sets them, and the verdict says so. Not for smooth
fast oscillations: a parameter that swings many times within the record leaves little trace in a
cumulated score. Cost: three constant fits, O(T n^2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.compare import errors
from driftfit.judges.attribute import Attribution, attribute
from driftfit.judges.constancy import Constancy, constancy
from driftfit.judges.paired import Paired, paired
from driftfit.judges.regressors import Rows, regressors
from driftfit.judges.whiteness import whiteness
from driftfit.result import Track, root_mean_square
from driftfit.settings import whole
from driftfit.summary import Printed, facts, table_of

RIVALS = ("persistence", "constant LS", "constant ARX")
CORRELATED = 1e-3
"""Below this p-value of whiteness the residuals of constant coefficients are said to be correlated."""


@dataclass(frozen=True)
class Moved:
    """What the record says of one parameter.

    ``statistic``, ``p``: Hansen's L and its p-value. ``p_own``: p-value of the path of the estimate, which tells apart
    parameters with correlated regressors, given the moves of those named before it. ``moves``: named as one that moves.
    ``at``, ``when``: the sample, and its time as text, of its clearest step; ``before``, ``after``: its value before
    its first and after its last step, ``std`` the standard error of their difference.
    """

    name: str
    statistic: float
    p: float
    p_own: float
    moves: bool
    at: int
    when: str
    before: float
    after: float
    std: float


@dataclass(frozen=True)
class Verdict(Printed):
    """What `Track.verdict` returns; printing it shows it.

    Attributes
    ----------
    drifts : bool
        The parameters move: ``p`` is below ``level``.
    pays : bool
        The run predicts better than constant least squares on the past: its paired p-value is below ``level``.
    p, statistic : float
        Joint test of all parameters; NaN where the record cannot tell.
    level : float
        Error rate: how often constants are said to move.
    parameters : tuple of Moved
    rms : float
        Root mean square one-step error of the run on ``scored`` samples.
    rivals : tuple of Paired
        The same of persistence, constant LS and constant ARX, with paired tests.
    samples, scored : int
        Samples in the test, and in the comparison.
    correlated : bool
        The residuals of constant coefficients are correlated, so that p may be too small.
    lags : int
        Lags of correlation that were allowed for.
    """

    drifts: bool
    pays: bool
    p: float
    statistic: float
    level: float
    parameters: tuple[Moved, ...]
    rms: float
    rivals: tuple[Paired, ...]
    samples: int
    scored: int
    correlated: bool
    lags: int

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the parameters that move."""
        return tuple(moved.name for moved in self.parameters if moved.moves)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in words."""
        return tuple(filter(None, (self._drift(), self._which(), self._gain(), self._caution())))

    def _drift(self) -> str:
        if np.isnan(self.p):
            return "The record cannot tell whether parameters move: too few samples, or regressors that do not span."
        if self.drifts:
            return f"The parameters move: constants are rejected with {p_equals(self.p)} (level {self.level:g})."
        return (
            f"No drift found: constant parameters are not rejected, {p_equals(self.p)} (level {self.level:g}). "
            "A drift that is small beside the noise cannot be ruled out."
        )

    def _which(self) -> str:
        if not self.drifts:
            return ""
        if not self.moving:
            return "Which of them moves cannot be told: their regressors are too alike, or the move is spread over all."
        told = [f"{m.name} from {m.before:.4g} to {m.after:.4g} about {m.when}" for m in self.parameters if m.moves]
        return f"It is {'; '.join(told)}."

    def _gain(self) -> str:
        steady = self.rivals[1]
        if np.isnan(steady.p):
            return "There are too few samples to compare predictions."
        change = 100.0 * (self.rms / steady.rms - 1.0)
        size = f"{abs(change):.1f} % {'smaller' if change < 0.0 else 'larger'}"
        if self.pays:
            return f"Following them pays: the one-step error is {size} than that of constants ({p_equals(steady.p)})."
        return (
            f"Following them does not clearly pay here: the one-step error is {size} than that of constants "
            f"({p_equals(steady.p)})."
        )

    def _caution(self) -> str:
        better = [rival.name for rival in self.rivals if rival.rms < self.rms]
        told = f"Lower error than this run: {', '.join(better)}. " if better else ""
        if self.correlated:
            told += (
                "The residuals of constant coefficients are correlated: a drift does that, and so does a model with "
                f"too few lags. The test allows for {self.lags} lags of correlation; try one more lag in the model."
            )
        return told.strip()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for sentence in self.sentences:
            yield Text(f" {sentence}")
        table = table_of("Parameters", "", "L", "p", "p own", "moves", "before", "after", "+-", "from")
        for m in self.parameters:
            shown = (f"{m.statistic:.3f}", p_text(m.p), p_text(m.p_own), "yes" if m.moves else "")
            change = (f"{m.before:.3g}", f"{m.after:.3g}", f"{m.std:.2g}", m.when) if m.moves else ("",) * 4
            table.add_row(Text(m.name), *shown, *change)
        yield table
        table = table_of("One-step prediction error, root mean square", "", "error", "t", "p")
        table.add_row("this run", f"{self.rms:.5g}", "", "")
        for rival in self.rivals:
            table.add_row(rival.name, f"{rival.rms:.5g}", f"{rival.t:.2f}", p_text(rival.p))
        yield table
        yield facts(("Samples", f"{self.samples} tested, {self.scored} scored"))


def p_text(p: float) -> str:
    """A p-value as it is written."""
    return "nan" if np.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}" if p < 0.1 else f"{p:.2f}"


def p_equals(p: float) -> str:
    """A p-value in a sentence."""
    return f"p {p_text(p)}" if p < 1e-4 else f"p = {p_text(p)}"


def verdict(run: Track, level: float = 0.05, lags: int | None = None) -> Verdict:
    """Judge a run.

    Parameters
    ----------
    run : Track
        What `track` returned.
    level : number
        Error rate of "the parameters move".
    lags : int or None
        Lags of correlation of the noise to allow for; None finds them from the record, and 0 is for a model whose
        one-step errors are known to be white.

    Raises
    ------
    ValueError
        If level is not between 0 and 1, or lags is negative.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"verdict: level must be between 0 and 1, such as 0.05; got {level!r}.")
    if lags is not None:
        whole("verdict", "lags", lags, 0)
    rows = regressors(run)
    test = constancy(rows.phi, rows.y, lags)
    drifts = bool(test.p_joint < level)
    steps = attribute(rows.phi, rows.y, test, level, lags) if drifts else None
    parameters = tuple(_moved(run, rows, test, steps, i) for i in range(len(test.p)))
    own, *others, scored = errors(run)
    rivals = tuple(paired(name, error[scored], own[scored]) for name, error in zip(RIVALS, others, strict=True))
    return Verdict(
        drifts=drifts,
        pays=bool(rivals[1].p < level),
        p=test.p_joint,
        statistic=test.joint,
        level=level,
        parameters=parameters,
        rms=root_mean_square(own[scored]),
        rivals=rivals,
        samples=len(rows.y),
        scored=int(scored.sum()),
        correlated=bool(whiteness(test.fit.residual).p < CORRELATED),
        lags=test.lags,
    )


def _moved(run: Track, rows: Rows, test: Constancy, steps: Attribution | None, i: int) -> Moved:
    name, at = run.model.names[i], steps.first(i) if steps else None
    own = float(test.p_own[i] if steps is None else steps.p[i])
    if steps is None or at is None:
        sample, sides = int(rows.at[min(int(test.at[i]), len(rows.at) - 1)]) if len(rows.at) else 0, (np.nan,) * 3
    else:
        sample, sides = int(rows.at[at]), (float(steps.before[i]), float(steps.after[i]), float(steps.std[i]))
    when = run.time_text(sample)
    return Moved(name, float(test.L[i]), float(test.p[i]), own, at is not None, sample, when, *sides)

"""Verdict: is the time variation real, which parameters move, by how much and when, and does tracking them pay?

The verdict answers two questions whose answers may differ:

* *Do the parameters move?* One test of constants (`driftfit.judge.changes`), whose null distribution comes from records
  that the model of constants draws itself, so that outliers, a changing noise variance, changing inputs and correlated
  noise are not mistaken for drift. The test uses the record, not the tracker: q and r do not enter. Only what the
  tracker left out, such as fault codes, is missing here, and for the rivals below, too. If the parameters are constant,
  the verdict says that they move with probability ``level``, as ``benchmarks/judging.py`` verifies.
* *Does following them pay?* The one-step errors of the run are compared with those of persistence, constant least
  squares on the past, the same with two lags of the outputs and regressors, and a constant ARX, on the same samples,
  with paired tests (`driftfit.judge.statistics.paired`). Correlated noise can be predicted, and so can the effect of a
  drifting parameter. Following therefore pays where the run beats the better of constants without lags and with them.

The first sentence combines both answers. The next ones say what moved, when, and how: in steps, for a time, gradually,
or as a random walk (`driftfit.judge.changes.words`).

A model without enough lags has correlated noise, which is hard to tell from a drifting intercept. The autoregression of
the noise is found from the record, ``lags=`` sets its order, and the verdict reports it. A parameter that wanders as
fast as the noise itself is mistaken for such noise; where the noise is nearly a random walk, the verdict says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.judge.changes.words import Event, clause, events, rows
from driftfit.judge.compare import left_at_start
from driftfit.judge.evidence import REJECTED, Evidence, least_rows
from driftfit.judge.statistics.paired import LEAST as COMPARED
from driftfit.judge.statistics.paired import Paired, paired
from driftfit.judge.statistics.whiteness import loudest
from driftfit.readings.gate import FROZEN
from driftfit.run.result import Track, root_mean_square
from driftfit.show.text import Printed, digits, facts, table_of

LEVEL = REJECTED
RIVALS = ("persistence", "constant LS", "LS with lags", "constant ARX")


@dataclass(frozen=True)
class Moved:
    """The verdict on one parameter.

    ``moves``: whether it is named as moving. ``at``, ``when``: the sample, and its time as text, of its clearest
    change, the beginning of one that takes time. ``before``: its value before its first change. ``after``: the value
    furthest from that, and ``std`` the standard error of their difference, NaN for a gradual change. ``last``: its last
    value, which is ``before`` again after a temporary fault. ``earliest``, ``latest``: first and last sample of an
    interval that contains the date with 95 % confidence. ``instead``: the parameters whose change at that time would
    explain the record as well; the record does not tell which of them moved.
    """

    name: str
    moves: bool
    at: int
    when: str
    before: float
    after: float
    std: float
    last: float
    earliest: int
    latest: int
    instead: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict(Printed):
    """The result of `Track.verdict`; printing it shows the sentences and tables.

    Attributes
    ----------
    drifts : bool or None
        Whether the parameters move: ``p`` is below ``level``. None if the record does not determine it.
    pays : bool or None
        The run predicts better than constant least squares on the past, without lags or with them, whichever is the
        better: the p-value of `constants` is below ``level``. None where there are too few samples to compare.
    p : float
        p-value of the joint test of all parameters; NaN if the record does not determine it.
    statistic : float
        Nyblom's statistic of all parameters.
    level : float
        Error rate: how often constant parameters are reported as moving.
    parameters : tuple of Moved
    events : tuple of Event
        What happened: steps, temporary and gradual changes, walks.
    weights : dict
        Weights of constants (rest), steps, a gradual change, a walk, and a walk with jumps, of sum 1; empty where
        constants are not rejected.
    rms : float
        Root mean square one-step error of the run on ``scored`` samples.
    rivals : tuple of Paired
        The same of persistence, constant LS, LS with lags and constant ARX, with paired tests.
    samples, scored : int
        Samples in the test, and in the comparison.
    correlated : bool
        Whether the noise is correlated, even within segments of constant parameters.
    lags : int
        The last lag of the autoregression of the noise.
    burn : int
        Samples at the beginning that are not scored.
    hidden : bool
        Whether the model moves hidden states: it has no regression, and only its predictions are judged.
    spread_with : tuple of str
        If constants are not rejected: parameters with residuals that are clearly larger where their regressors are.
    dependent : tuple of tuples of str
        Groups of parameters with linearly dependent regressors, such as those of a column that repeats another.
    held : tuple of str
        The parameters that the test takes for 0, so that it can judge the others: one or more of every group, and
        those whose regressors are 0 in every sample that can be used but one at most.
    stuck : int
        Readings of a frozen sensor, which the gate left out.
    nearly_walk : float
        Largest root of the noise, if a random walk is not excluded: a level that wanders looks the same. Otherwise 0.
    """

    drifts: bool | None
    pays: bool | None
    p: float
    statistic: float
    level: float
    parameters: tuple[Moved, ...]
    events: tuple[Event, ...]
    weights: dict[str, float]
    rms: float
    rivals: tuple[Paired, ...]
    samples: int
    scored: int
    correlated: bool
    lags: int
    burn: int
    hidden: bool = False
    spread_with: tuple[str, ...] = ()
    dependent: tuple[tuple[str, ...], ...] = ()
    held: tuple[str, ...] = ()
    stuck: int = 0
    nearly_walk: float = 0.0

    @property
    def constants(self) -> Paired:
        """The rival that decides whether following pays: constant least squares, or with lags where that is better."""
        return better_constants(self.rivals)

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the parameters that move."""
        return tuple(moved.name for moved in self.parameters if moved.moves)

    @property
    def least(self) -> int:
        """Number of samples that a test of these parameters needs."""
        return least_rows(len(self.parameters) - len(self.held))

    @property
    def untested(self) -> str:
        """Why there is no test of whether parameters move, in a few words; empty if there is one."""
        if self.drifts is not None:
            return ""
        if self.hidden:
            return "not tested: hidden states"
        if self.samples < self.least:
            return f"not tested: {self.samples} of {self.least} samples"
        return (
            "not tested: no noise"
            if self.rivals[1].rms == 0.0
            else "not tested: regressors too similar, or rare counts"
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in sentences."""
        which = f"What moves: {'; '.join(map(clause, self.events))}." if self.events else ""
        return tuple(filter(None, (f"{self._drift()} {self._gain()}", which, self._indistinct(), self._caution())))

    def _drift(self) -> str:
        if self.hidden:
            return "Whether parameters move cannot be tested: a model with hidden states is not a regression."
        if self.drifts is None:
            least = self.least
            short = f"{self.samples} samples can be used, and at least {least} are needed."
            alike = (
                "constant parameters explain every output without error, so there is no noise to compare a change with."
                if self.rivals[1].rms == 0.0
                else "its regressors do not distinguish the parameters, or explain nine of ten outputs without error, "
                "as those of rare counts."
            )
            return f"The record cannot show whether parameters move: {short if self.samples < least else alike}"
        if self.drifts:
            return f"The parameters move: constants are rejected with {p_equals(self.p)} (level {self.level:g})."
        if self.pays:
            reason = (
                "once correlated noise is allowed for. A model with too few lags causes such noise, and a parameter "
                "that varies as fast looks the same."
                if self.lags
                else "by a test on the whole record, which misses small and fast drifts."
            )
            return (
                "Tracking reduces the error, but there is no evidence that parameters move: constants are not rejected "
                f"({p_equals(self.p)}, level {self.level:g}) {reason}"
            )
        return (
            f"No drift found: constant parameters are not rejected, {p_equals(self.p)} (level {self.level:g}). "
            "A drift that is small compared with the noise cannot be ruled out."
        )

    def _indistinct(self) -> str:
        idle = [name for name in self.held if not any(name in group for group in self.dependent)]
        text = [
            f"The regressors of {listed(group)} are linearly dependent: only their joint effect is judged, as that of "
            f"{listed([name for name in group if name not in self.held])}."
            for group in self.dependent
        ]
        if idle:
            whose = "its regressor is" if len(idle) == 1 else "their regressors are"
            text.append(f"Nothing shows whether {listed(idle)} moved: {whose} 0 in every sample but one at most.")
        return " ".join(text)

    def _gain(self) -> str:
        steady = self.constants
        if self.hidden and self.scored >= COMPARED:
            rival = self.rivals[3]
            size = _larger(self.rms, rival.rms)
            return f"The one-step error is {size} than that of a {rival.name} ({p_equals(rival.p)})."
        if self.pays is None and not self.samples:
            return "Predictions cannot be compared either: every sample has a missing output or regressor."
        if self.pays is None:
            return (
                f"Predictions cannot be compared: {self.scored} samples remain after the first {self.burn}, and "
                f"at least {COMPARED} are needed; a smaller burn= leaves out fewer."
            )
        who = "constants" if steady is self.rivals[1] else "constants with lags"
        if not steady.rms > 0.0:
            return f"Tracking them cannot pay here: {who} predict the output without error."
        size = _larger(self.rms, steady.rms)
        if self.pays:
            return f"Tracking them pays: the one-step error is {size} than that of {who} ({p_equals(steady.p)})."
        if self.rivals[1].p < self.level:
            return (
                "Tracking them predicts better than constants, but not than constants with two more lags of "
                f"everything: its one-step error is {size} than theirs ({p_equals(steady.p)}). "
                "Lags may be all that is missing."
            )
        return (
            f"Tracking them does not clearly pay here: the one-step error is {size} than that of {who} "
            f"({p_equals(steady.p)})."
        )

    def _caution(self) -> str:
        better = [rival.name for rival in self.rivals if rival.rms < self.rms]
        text = f"Lower error than this run: {', '.join(better)}. " if better else ""
        if self.correlated:
            text += (
                "The noise is correlated, even within segments of constant parameters. A model with too few lags "
                "causes this, and so does a fast drift. The test allows for an autoregression up to lag "
                f"{self.lags}; try one more lag in the model. "
            )
        if self.nearly_walk:
            text += (
                f"The noise is nearly a random walk (largest root {self.nearly_walk:.4g}): a level that wanders looks "
                "the same, and this record does not tell them apart. "
            )
        if self.spread_with:
            text += (
                f"The residuals are larger where the regressor of {' or '.join(self.spread_with)} is: either this "
                "coefficient varies from sample to sample, which no tracker can follow, or the noise grows with it. "
            )
        if self.stuck:
            text += (
                f"{self.stuck} readings repeat the one before although the forecast moved, as those of a frozen sensor "
                "do: they are left out."
            )
        return text.strip()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for sentence in self.sentences:
            yield Text(f" {sentence}")
        if self.events:
            table = table_of("Changes", "", "at", "95 %", "until", "", "before", "after", "+-")
            for row in rows(self.events):
                table.add_row(*map(Text, row))
            yield table
            yield facts(("Weights", ", ".join(f"{name} {weight:.2f}" for name, weight in self.weights.items())))
        table = table_of("One-step prediction error, root mean square", "", "error", "t", "p")
        table.add_row("this run", f"{self.rms:.5g}", "", "")
        for rival in self.rivals:
            table.add_row(rival.name, f"{rival.rms:.5g}", f"{rival.t:.2f}", p_text(rival.p))
        yield table
        yield facts(("Samples", f"{self.samples} tested, {self.scored} scored"))


def _larger(one: float, other: float) -> str:
    """By how much an error is larger than another."""
    change = 100.0 * (one / other - 1.0) if other > 0.0 else 0.0
    return f"{abs(change):.1f} % {'smaller' if change < 0.0 else 'larger'}"


def listed(names: Sequence[str]) -> str:
    """Names in a sentence."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def rounded(error: Array, y: Array) -> Array:
    """Errors (N,) of predictions of y (N,), 0 where they are those of the arithmetic: these are not compared."""
    return np.where(np.abs(error) <= ROUNDING * np.max(np.abs(y), initial=0.0), 0.0, error)


def better_constants(rivals: tuple[Paired, ...]) -> Paired:
    """Of constant least squares without lags and with them, the one with the smaller error."""
    return min(rivals[1:3], key=lambda rival: rival.rms)


def change(moved: Moved, least: int = 4) -> str:
    """Its values before and after, with at least so many digits."""
    return f"{digits(moved.before, moved.std, least)} to {digits(moved.after, moved.std, least)}"


def p_text(p: float) -> str:
    """A p-value as text."""
    return "nan" if np.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}" if p < 0.1 else f"{p:.2f}"


def p_equals(p: float) -> str:
    """A p-value in a sentence."""
    return f"p {p_text(p)}" if p < 1e-4 else f"p = {p_text(p)}"


def verdict(run: Track, level: float = LEVEL, lags: int | None = None, burn: int | None = None) -> Verdict:
    """Judge a run.

    Parameters
    ----------
    run : Track
        What `track` returned.
    level : number
        Error rate of the statement that the parameters move.
    lags : int or None
        Lags of correlation of the noise to allow for; None estimates them from the record, and 0 is for a model whose
        one-step errors are known to be white.
    burn : int or None
        Number of samples at the beginning that are not scored; by default as in `driftfit.judge.compare`.

    Raises
    ------
    ValueError
        If level is not between 0 and 1, or lags or burn is negative.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"verdict: level must be between 0 and 1, such as 0.05; got {level!r}.")
    for name, given in (("lags", lags), ("burn", burn)):
        if given is not None:
            whole("verdict", name, given, 0)
    return judged(Evidence(run, lags, burn, level))


def judged(known: Evidence) -> Verdict:
    """The verdict where the test of constancy may be shared with the diagnosis."""
    run, found, names = known.run, known.changes, known.names
    at, level = known.tested.at, known.level
    happened = () if found is None or not found.rejected else events(found, names, at, run.time_text)
    scored = known.errors.scored
    y = run.y[scored]
    error, *others = (rounded(each[scored], y) for each in known.errors[:-2])
    rivals = tuple(paired(name, rival, error) for name, rival in zip(RIVALS, others, strict=True))
    lags = () if found is None else found.model.noise.lags
    loud = None if found is None or found.rejected else loudest(found.model.noise.e, found.model.noise.ranks)
    return Verdict(
        drifts=None if found is None else found.rejected,
        pays=None if np.isnan(rivals[1].p) else bool(better_constants(rivals).p < level),
        p=known.p,
        statistic=float("nan") if found is None else found.test.L,
        level=level,
        parameters=tuple(_moved(happened, name) for name in run.model.names),
        events=happened,
        weights=found.kind.weights if found is not None and found.rejected else {},
        rms=root_mean_square(error),
        rivals=rivals,
        samples=len(at),
        scored=int(scored.sum()),
        correlated=len(lags) > 0,
        lags=int(max(lags, default=0)),
        burn=left_at_start(run) if known.burn is None else known.burn,
        hidden=run.model.hidden is not None,
        spread_with=() if loud is None else (names[loud],),
        dependent=tuple(tuple(run.model.names[i] for i in group) for group in known.distinct.groups),
        held=tuple(name for name in run.model.names if name not in names),
        stuck=int(np.sum(run.left_out.code == FROZEN)),
        nearly_walk=found.test.root if found is not None and found.wandering_noise else 0.0,
    )


def _moved(happened: Sequence[Event], name: str) -> Moved:
    """What is said of a parameter."""
    own = [(event, move) for event in happened for move in event.moves if move.name == name]
    if not own:
        nan = float("nan")
        return Moved(name, False, 0, "", nan, nan, nan, nan, 0, 0)
    before = own[0][1].before
    event, move = max(own, key=lambda one: abs(one[1].after - one[1].before) / one[1].std if one[1].std > 0.0 else 0.0)
    far = max(own, key=lambda one: abs(one[1].after - before))[1]
    last = own[-1][1].before if own[-1][0].kind == "temporary" else own[-1][1].after
    where = (event.at, event.when, before, far.after, far.std, last, event.earliest, event.latest)
    return Moved(name, True, *where, move.instead)

"""Diagnose: the faults of a run as numbers with limits, and a sentence for each number that is out of bounds.

With z = e / s, innovations over their standard deviation, after the first max(50, 5 n) samples:

    whiteness         p-value of 20 autocorrelations of z, robust to changing variance          at least 0.01
    inputs            smallest p-value of z against 11 lags of an input, times their number     at least 0.01
    noise level       mean of z^2 without the outliers, over what a Gaussian has                0.75 to 1.33
    steady noise      the same, largest over smallest of ten parts of the record                at most 3
    outliers          share of |z| > 4                                                          at most 0.2 %
    symmetry          skewness of z clipped at 4                                                -0.5 to 0.5
    excitation        largest condition index of a window (`driftfit.judge.regressors.excitation`)        at most 100
    constancy         joint p-value of constant coefficients (`driftfit.judge.changes`)                   see below

Constancy is out of bounds if the record and the tracker disagree: the coefficients move but the tracker holds them
constant (p below 0.01), or they do not move and the tracker lets them move at a cost: p above 0.05, and one-step errors
more than 3 % larger than those of constants, by a paired test at 1 % (of e^2 - (1.03 e_constant)^2, see
`driftfit.judge.statistics.paired`). A fault is therefore found with fewer than one in a hundred trackers whose drift
costs less than that, and on short records only if it costs much more: ``benchmarks/diagnose_constancy.py``. The mean of
z^2 is over |z| < 3 of the median scale, so that outliers are counted once, under their own name. Limits that a short
record makes too tight are widened by three standard errors. Source: Mehra (1970), Bar-Shalom et al. (2001, section
5.4) for innovation tests. Cost: that of a verdict.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.judge.evidence import Evidence
from driftfit.judge.plots import Health, draw_diagnosis
from driftfit.judge.regressors import INDEX, Excitation, excitation
from driftfit.judge.statistics.paired import paired
from driftfit.judge.statistics.robust import core
from driftfit.judge.statistics.whiteness import Whiteness, crossing, whiteness
from driftfit.judge.verdict import p_text, rounded
from driftfit.run.result import Track, burn_in, root_mean_square
from driftfit.show.text import Printed, table_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS = 10
MATERIAL, REJECTED = 1.03, 0.01
"""A tracker that lets coefficients move is at fault if its error exceeds that of constants by this factor."""
NOT_REJECTED = 0.05
"""Constants count as not rejected if p is at least this."""
BEYOND = 4.0
"""An innovation beyond this many standard deviations counts as an outlier."""


@dataclass(frozen=True)
class Check:
    """One number with its limits; ``advice`` is a sentence if it is out of bounds, otherwise empty.

    ``value`` is NaN, and in bounds, if the record is too short or the tracker carries no covariance.
    """

    name: str
    value: float
    low: float
    high: float
    advice: str

    @property
    def ok(self) -> bool:
        """Whether the value is within its limits, or not known."""
        return not (self.value < self.low or self.value > self.high)

    @property
    def text(self) -> str:
        """The value as it is printed; p-values are combined from 1e-12 on, so that smaller ones have no meaning."""
        least = self.name.endswith("(p)") and self.value < 1e-4
        return p_text(self.value) if least else f"{self.value:.4g}"


@dataclass(frozen=True)
class Diagnosis(Printed):
    """The result of `Track.diagnose`; printing it shows a table, `plot` draws one page.

    Attributes
    ----------
    checks : tuple of Check
        Every number with its limits.
    ok : bool
        Whether all of them are within their limits.
    """

    checks: tuple[Check, ...]
    run: Track = field(repr=False, compare=False)

    @property
    def ok(self) -> bool:
        return all(check.ok for check in self.checks)

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for every number that is out of bounds, with a suggestion."""
        return tuple(check.advice for check in self.checks if not check.ok)

    @property
    def no_finding(self) -> str:
        """The sentence where no number is out of bounds, which says how many of them are not known."""
        unknown = sum(bool(np.isnan(check.value)) for check in self.checks)
        known = len(self.checks) - unknown
        if not unknown:
            return "All diagnostics are within their limits."
        if not known:
            return "Nothing could be diagnosed: the record determines none of the numbers."
        are = "is within its limits" if known == 1 else "are within their limits"
        return f"{known} of {len(self.checks)} diagnostics {are}; the others are not known."

    def __getitem__(self, name: str) -> Check:
        return next(check for check in self.checks if check.name == name)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = table_of("Diagnostics", "", "value", "from", "to", "")
        for check in self.checks:
            limits = ("" if np.isinf(limit) else f"{limit:.4g}" for limit in (check.low, check.high))
            verdict = "not known" if np.isnan(check.value) else "" if check.ok else "out of bounds"
            table.add_row(check.name, check.text, *limits, verdict)
        yield table
        for sentence in self.sentences or (self.no_finding,):
            yield Text(f" {sentence}")

    def plot(self, ax: Any = None) -> Figure:
        """Innovations, their correlations, level, distribution; excitation; paths of the estimates: one page.

        ``ax`` as for `Track.plot`.
        """
        z, white = standardised(self.run)
        known = Evidence(self.run)
        return draw_diagnosis(Health(known, z, white, excitation(known.rows.phi), lambda name: self[name].ok), ax)


def diagnose(run: Track) -> Diagnosis:
    """Check a run; see the module for the numbers and their limits. Bad data never raise an error."""
    return diagnosis(Evidence(run))


def diagnosis(known: Evidence) -> Diagnosis:
    """As `diagnose`, with a test of constancy that may be shared with the verdict."""
    run = known.run
    z, white = standardised(run)
    checks = (
        _whiteness(white),
        *_inputs(run, z),
        *_level(z, white, run.tracker.adapts),
        *_distribution(z, run.tracker.adapts),
        _excitation(run, excitation(known.rows.phi)),
        _constancy(known),
    )
    return Diagnosis(checks, run)


def standardised(run: Track) -> tuple[Array, Whiteness]:
    """Standardised innovations after the start, NaN where there are none, and their whiteness."""
    start = burn_in(run.model.n)
    used = run.y[run.ok]
    e = run.innovation if run.model.implicit else rounded(run.innovation, used)
    if run.model.output_lags and np.ptp(used if used.size else 0.0) == 0.0:
        e = np.full(len(run), np.nan)  # a constant output has no noise: what is left is the prior, on its way out
    with np.errstate(divide="ignore", invalid="ignore"):
        z = e / run.innovation_std
    z = np.where(run.ok & np.isfinite(z) & (np.arange(len(run)) >= min(start, len(run) // 2)), z, np.nan)
    # without a covariance there is no scale, but correlation does not need one
    return z, whiteness(z if np.isfinite(z).any() else np.where(run.ok, e, np.nan))


def _whiteness(white: Whiteness) -> Check:
    with np.errstate(divide="ignore", invalid="ignore"):
        clear = np.nan_to_num(np.abs(white.r) / white.std, posinf=0.0)
    first, most = (white.r[0], int(np.argmax(clear))) if len(clear) else (np.nan, 0)
    if most and clear[0] < 2.0:
        where = f"{white.r[most]:.2f} at lag {most + 1}, {first:.2f} at the first"
        hint = f"lags up to {most + 1}, or regressors that describe a season"
    elif first > 0.0:
        where, hint = f"{first:.2f} at the first lag, positive", "more drift (a larger q, less memory), or one more lag"
    else:
        where = f"{first:.2f} at the first lag, negative"
        hint = "less drift, or one more lag (noise on the output does this too)"
    advice = (
        f"The innovations are correlated ({where}): the model leaves something "
        f"predictable. Try {hint}; if they stay correlated, the noise is coloured: use ARMAX, OE or BoxJenkins."
    )
    return Check("whiteness (p)", white.p, 0.01, np.inf, advice)


def _inputs(run: Track, z: Array) -> list[Check]:
    if run.u.shape[1] == 0:
        return []
    p = np.array([crossing(z, u).p for u in np.where(np.abs(run.u) < LARGEST, run.u, np.nan).T])
    if np.isnan(p).all():
        return [Check("inputs (p)", float("nan"), 0.01, np.inf, "")]
    worst = int(np.nanargmin(p))
    given = run.labels.u
    name = given[worst] if worst < len(given) else f"input {worst + 1}"
    advice = (
        f"The innovations are correlated with {name}: the model does not contain all of its effect. "
        "Try more lags of it, another delay, or a nonlinearity."
    )
    return [Check("inputs (p)", min(1.0, float(p[worst]) * len(p)), 0.01, np.inf, advice)]


def _level(z: Array, white: Whiteness, robust: bool) -> tuple[Check, Check]:
    count = int(np.isfinite(z).sum())
    level = core(z)
    slack = 3.0 * np.sqrt(2.0 / count) if count else 0.0
    sign = white.r[0] if len(white.r) and white.p < 0.05 else 0.0
    if level > 1.0:
        what = f"larger than predicted; raise {'q, since they are correlated too' if sign > 0.0 else 'r'}"
    else:
        what = f"smaller than predicted; lower {'q, since successive errors alternate' if sign < 0.0 else 'r'}"
    advice = (
        f"The one-step error is {what}: its squares are {level:.2f} of their variance. tune() estimates the settings."
    )
    levels = np.array([core(part) for part in np.array_split(z, PARTS)])
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 where all predictions are exact
        ratio = float(np.nanmax(levels) / np.nanmin(levels)) if np.isfinite(levels).any() else float("nan")
    wide = 3.0 * np.exp(2.0 * slack * np.sqrt(PARTS) / 2.0) if count else 3.0
    changing = (
        f"The noise is not constant: its variance changes {ratio:.1f}-fold over the record. Bands are too narrow where "
        f"it is large; {'look there' if robust else 'give weights=, or use AdaptiveKalman, which tracks the noise'}."
    )
    return (
        Check("noise level", level, min(0.75, 1.0 - slack), max(1.33, 1.0 + slack), advice),
        Check("steady noise", ratio, -np.inf, wide, changing),
    )


def _distribution(z: Array, robust: bool) -> tuple[Check, Check]:
    z = z[np.isfinite(z)]
    if len(z) < 20:
        return Check("outliers", float("nan"), 0.0, 0.002, ""), Check("symmetry", float("nan"), -0.5, 0.5, "")
    share = float(np.mean(np.abs(z) > BEYOND))
    limit = max(0.002, 2.5 / len(z))
    outliers = (
        f"{100.0 * share:.2g} % of the innovations are beyond {BEYOND:g} standard deviations. "
        + (
            "They are discounted, but inspect them."
            if robust
            else "Outliers distort the parameters: use AdaptiveKalman, "
        )
        + ("" if robust else "which discounts them, or give weights=0 to known bad samples.")
    )
    held = np.clip(z - np.median(z), -BEYOND, BEYOND)
    skew = float(np.mean((held - held.mean()) ** 3) / np.mean((held - held.mean()) ** 2) ** 1.5) if held.any() else 0.0
    slack = max(0.5, 3.0 * np.sqrt(6.0 / len(z)))
    skewed = f"The innovations are skewed ({skew:.2f}): try the logarithm of a positive output, or a nonlinearity."
    return (Check("outliers", share, 0.0, limit, outliers), Check("symmetry", skew, -slack, slack, skewed))


def _excitation(run: Track, excited: Excitation) -> Check:
    if not len(excited.at):
        return Check("excitation", float("nan"), 0.0, INDEX, "")
    poor = float(np.mean(excited.condition > INDEX))
    share = np.abs(excited.direction)
    involved = [name for name, part in zip(run.model.names, share, strict=True) if part > 0.3 * share.max()]
    advice = (
        f"In {100.0 * poor:.0f} % of the windows the inputs do not distinguish {', '.join(involved)}: there they are "
        "determined by earlier samples. Excite the system, use fewer lags, or centre the signals if there is an "
        "intercept."
    )
    return Check("excitation", float(excited.condition.max()), 0.0, INDEX, advice)


def _constancy(known: Evidence) -> Check:
    if holds_constant(known.run):
        advice = (
            "The coefficients move, but this tracker holds them constant: use Kalman with a drift, or AdaptiveKalman."
        )
        return Check("constancy (p)", known.p, REJECTED, np.inf, advice)
    error = known.errors
    own, steady = (part[error.scored] for part in (error.tracked, error.constant_ls))
    least, most = root_mean_square(steady), root_mean_square(own)
    advice = (
        f"Constants are not rejected, and predict better ({least:.4g} against {most:.4g}): the drift is set too high. "
        "Lower q or increase the memory; tune() estimates it."
    )
    dear = paired("constant LS", own, MATERIAL * steady).p < REJECTED
    return Check("constancy (p)", known.p, -np.inf, NOT_REJECTED if dear else np.inf, advice)


def holds_constant(run: Track) -> bool:
    """Whether the tracker of a run keeps all parameters constant."""
    settings = run.tracker.settings()
    if "forgetting" in settings:
        return bool(settings["forgetting"] == 1.0)
    if "mu" in settings:
        return bool(np.isinf(settings["mu"]).all())
    return "q" in settings and not np.any(settings["q"])

"""Samples that contradict all samples before them: fault codes and spikes in the output or in an input.

A reading of 9999 where the output is near 10, or an input of 9999 where it is near 1, carries no information about the
system, but least squares gives it more weight than all others. In both cases the reading and its prediction are far
apart, and one of the two is far outside the range of the readings so far. With m and v the mean and variance of these
readings, e = y - y_hat, and s the tracker's variance of e times the mean of e^2 / s so far, a sample is strange if

    e^2 > (REACH p)^2 v    and    e^2 > SURE^2 s    and    min(|y - m|, |y_hat - m|) < |e| / 2

and is not used. If y is farther from m than y_hat, its lag also counts as missing. The second condition does not hold
where parameters are hardly known, and the third not after a test signal to which the output responds. A change of gain
or level within the usual range of the readings is never strange.

If instead y_hat is farther from m, an input is probably at fault. An estimate that went astray also gives strange
predictions, however, and must be corrected; so inputs are blamed for at most `LAGS` samples in a row, and for one
sample in ten in the long run.

A strange input stays in the regressors, as a lag or in what a model simulates, where its effect may be smaller. In the
`LAGS` samples after one for which an input was blamed, a sample with phi' P phi > r, which would change the estimate
more than all samples before it, is therefore not used either.

The patience p begins at 1 and doubles with every strange reading that follows another one: a value that persists is a
change of level and is accepted; one of 1000 standard deviations after seven samples. Where the prediction is strange,
p doubles in four samples, and in 16 where the strange value repeats itself, because fault codes come in runs. It stays
the same while a strange prediction decays, as the output of a simulation does. The first `FIRST` readings are not
judged here; those of a diffuse start are judged together (`driftfit.trackers.parts.faults.judged_start`).

Source: ours; see `driftfit.trackers.parts.outlying_readings` for the rule of a tracker that learns its own noise. Cost
per sample: some twenty operations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.parts.diffuse import corrected, prediction, symmetric_product

REACH = 10.0
"""Standard deviations of the readings."""
SURE = 5.0
"""Standard deviations of the prediction."""
FIRST = 10.0
"""Number of first readings that are accepted, for comparison with later ones."""
JUDGED = 6.0
"""After a prior for n parameters this many more than n, if that is more: before that s may say nothing about e."""
MEMORY = 1000.0
"""Memory of the mean and variance of the readings, and of the mean of e^2 / s, in samples."""
ENOUGH, FAR = 4.0, 100.0
"""Samples from which on the mean of e^2 / s is used; the largest multiple of it by which a sample enters it."""
LASTING, LONGEST = 4.0, 1e12
"""The patience from which on the lag of a strange input is accepted as well; the upper bound of the patience."""
LAGS = 50.0
"""Samples in which a strange input may still be in the regressors."""
SELDOM = 0.1
"""Share of samples that inputs may be blamed for in the long run."""
QUICK, SLOW, SLOWEST = 2.0, 2.0 ** (1.0 / 4.0), 2.0 ** (1.0 / 16.0)
"""Factors of the patience: for readings, for predictions, and if the strange value repeats itself."""
ALIKE, SINKING = 1.01, 0.8
"""A strange prediction repeats itself if its distance from m is that of the ones before, up to `ALIKE`. The latter is
the largest of them, of which `SINKING` is kept with every sample."""


def no_contradictions(n: int = 0) -> dict[str, Any]:
    """Fields before the first reading; n is the number of parameters of which a prior may say too little."""
    return {
        "y_first": max(FIRST, n + JUDGED),
        "y_mean": 0.0, "y_spread": 0.0, "y_count": 0.0, "y_last": np.nan, "patience": 1.0, "y_strange": np.nan,
        "far": 0.0, "left_out": 0.0, "distrusted": 0.0, "misfit": 0.0, "misfits": 0.0, "shift": 0.0, "lagging": 0.0,
    }  # fmt: skip


@kernel
def learn_range(s: State, y: float, used: float, l: int) -> None:
    """Mean and variance of the readings; one that repeats the last has nothing new."""
    fresh = used if (y != s.y_last[l]) | (s.y_count[l] < 1.0) else 0.0
    s.y_count[l] += fresh
    share = fresh / min(max(s.y_count[l], 1.0), MEMORY)
    away = y - s.y_mean[l]
    s.y_mean[l] += share * away
    s.y_spread[l] += share * ((1.0 - share) * away * away - s.y_spread[l])
    s.y_last[l] = y if used > 0.0 else s.y_last[l]


@kernel
def judge(s: State, y: float, shown: float, v: float, l: int) -> None:
    """Whether the sample is used: s.ok and s.seen; and the patience."""
    e, off, out = y - shown, abs(y - s.y_mean[l]), abs(shown - s.y_mean[l])
    reach, patience = REACH * REACH * s.y_spread[l], s.patience[l]
    judged = (s.ok[l] > 0.0) & (s.y_count[l] >= s.y_first[l]) & (s.misfits[l] >= ENOUGH)
    strange = judged & (e * e > reach) & (e * e > SURE * SURE * v * s.misfit[l]) & (min(off, out) < 0.5 * abs(e))
    trusted = (off > out) | (s.distrusted[l] < LAGS)
    beyond = strange & trusted & (e * e > reach * patience * patience)
    lasting = strange & (not beyond) & (patience > LASTING)
    lagging = (
        judged
        & (not lasting)
        & (s.lagging[l] > 0.0)
        & (s.distrusted[l] < LAGS)
        & (v > 2.0 * s.r[l] * s.noise[l] * s.scale[l])
    )
    left = beyond | lagging
    more = 1.0 if left & (off <= out) else -SELDOM
    s.distrusted[l] = min(max(s.distrusted[l] + more, 0.0), 2.0 * LAGS) if s.ok[l] > 0.0 else s.distrusted[l]
    of_reading = SLOWEST if y == s.y_strange[l] else QUICK
    of_prediction = (1.0 if out * ALIKE < s.far[l] else SLOWEST) if out < ALIKE * s.far[l] else SLOW
    grown = min((of_reading if off > out else of_prediction) * patience, LONGEST)
    left_over = 0.0 if lasting else max(s.lagging[l] - 1.0, 0.0)
    s.lagging[l] = LAGS if beyond & (off <= out) else left_over
    s.patience[l] = grown if strange else (1.0 if s.ok[l] > 0.0 else patience)
    s.y_strange[l] = y if strange else s.y_strange[l]
    s.far[l] = max(out, SINKING * s.far[l]) if strange else 0.0
    s.left_out[l] += 1.0 if left else 0.0
    s.seen[l] = 0.0 if beyond & (off > out) else s.seen[l]
    s.ok[l] = 0.0 if left else s.ok[l]


@kernel
def learn_misfit(s: State, square: float, v: float, used: float, l: int) -> None:
    """Mean of e^2 / s, from e^2 and s."""
    measured = (v > 0.0) & (v < np.inf) & (s.y_count[l] > s.y_first[l] - JUDGED)
    part = square / v if measured else 0.0
    new = used if measured else 0.0
    s.misfits[l] = min(s.misfits[l] + new, MEMORY)
    bounded = min(part, FAR * s.misfit[l]) if s.misfits[l] > ENOUGH else part
    s.misfit[l] += new * (bounded - s.misfit[l]) / max(s.misfits[l], 1.0)


@kernel
def leave_out_contradiction(s: State, y_hat: float, v: float, l: int) -> None:
    """Leave out a sample that contradicts all before, given its prediction and the variance of that.

    A single lane skips what would change nothing; several lanes are faster without a branch.
    """
    square, alone = (s.y[l] - y_hat) ** 2, s.theta.shape[1] == 1
    quiet = (square <= REACH * REACH * s.y_spread[l]) & (s.patience[l] <= 1.0) & (s.lagging[l] + s.distrusted[l] <= 0.0)
    if not (alone and quiet):
        judge(s, s.y[l] + s.shift[l], y_hat + s.shift[l], v, l)
    learn_range(s, s.y[l] + s.shift[l], s.ok[l], l)
    learn_misfit(s, square, v, s.ok[l], l)


@kernel
def judged_measurement(s: State, l: int) -> None:
    """One correction with noise variance s.r, unless the sample contradicts all before it."""
    y_hat, v = prediction(s, l), symmetric_product(s, l) + s.r[l] * s.noise[l]
    leave_out_contradiction(s, y_hat, v * s.scale[l], l)
    corrected(s, y_hat, v, l)


def contradictions(lane: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
    """The line of a summary: none if all samples were accepted."""
    count = int(lane["left_out"]) if "left_out" in lane else 0
    return (("Left out", f"{count} samples out of all proportion to those before"),) if count else ()

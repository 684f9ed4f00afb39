"""Samples that contradict all samples before them: fault codes and spikes in the output or in an input.

A reading of 9999 where the output is near 10, or an input of 9999 where it is near 1, carries no information about the
system, but least squares gives it more weight than all others. In both cases the reading and its prediction are far
apart, and one of the two is far outside the range of the readings so far. With m and v the mean and variance of these
readings, e = y - y_hat, and s the tracker's variance of e times the mean of e^2 / s so far, a sample is strange if

    e^2 > (REACH p)^2 v    and    e^2 > SURE^2 s    and    min(|y - m|, |y_hat - m|) < |e| / 2

and is not used; with `LIKELY` instead of SURE if y_hat is farther from m than y, because one input may outweigh all
samples to come. If y is farther from m than y_hat, its lag also counts as missing. The second condition does not hold
where parameters are hardly known, and the third not after a test signal to which the output responds. A change of gain
or level within the usual range of the readings is never strange.

If instead y_hat is farther from m, an input is probably at fault. An estimate that went astray also gives strange
predictions, however, and must be corrected; so inputs are blamed for at most `TRUST` samples in a row, and for one
sample in ten in the long run. A code whose effect would stay within the range of the readings is found by the range of
its own regressor (`driftfit.trackers.parts.faults.strange_inputs`).

A strange input stays in the regressors, as a lag or in what a model simulates, where its effect may be smaller. In the
`TRUST` samples after one for which an input was blamed, a sample with phi' P phi > r, which would change the estimate
more than all samples before it, is therefore not used either; after n samples, when lags are ordinary again, only if it
does not agree with its prediction, e^2 > LIKELY^2 s.

A reading that has no prediction, because a lag or an input is missing, is judged by the first condition alone, with
y - m in the place of e. After na codes in a row, or a gap, the next code would otherwise become a lag, and the one
after it a response to that. One that is inside diminishes p only a little: it may be a large signal that crosses zero.

The factor p begins at 1 and doubles with every strange reading that is near the last one: a value that persists is a
change of level and is accepted, also if it is 1000 standard deviations away. It doubles in 16 samples where a reading
repeats the last strange one in all digits, or is far from it, because codes come in runs, some of them with either
sign. Where the prediction is strange, p doubles in four samples, and in 16 where the strange value repeats itself. It
stays the same while a strange prediction decays, as the output of a simulation does. The first `FIRST` readings are not
judged here; those of a diffuse start are judged together (`driftfit.trackers.parts.faults.judged_start`).

Nearly every sample is ordinary: no input was blamed lately, and e^2 is at most REACH^2 v and UNUSUAL^2 times what is
usual, or (y - m)^2 at most REACH^2 v without a prediction. Ordinary samples are added to a block, a sum of y - m, of
its square and of e^2 / s. Before a sample that is not ordinary is judged, the block is closed: its sums enter the
means. It is also closed when it has a quarter as many samples as there were readings before.

Source: ours; see `driftfit.trackers.parts.faults.outlying_readings` for the rule of a tracker that learns its own
noise. Cost per ordinary sample: two comparisons, three sums, and the range of the regressors.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.covariance import corrected, prediction, symmetric_product
from driftfit.trackers.parts.faults.outlying_readings import FIRST, LONGEST, MEMORY, REACH, SURE
from driftfit.trackers.parts.faults.strange_inputs import ALIKE, TRUST, learn_inputs, spend_trust, trusted_inputs

UNUSUAL, GROWN = 8.0, 4.0
"""Usual standard deviations of the prediction from which on a sample is not ordinary; the most that the square of these
grows with one sample."""
LIKELY = 3.0
"""`SURE` where the prediction, and not the reading, is out of range."""
JUDGED = 6.0
"""After a prior for n parameters the first n + `JUDGED` readings are accepted, if those are more than `FIRST`: before
that s may say nothing about e."""
ENOUGH, CLIP, BLOCK_CLIP = 4.0, 100.0, 4.0
"""Samples from which on the mean of e^2 / s is used; the largest multiples of it by which a sample, and the mean of a
block, enter it."""
BLOCK, GROWING = 32.0, 0.25
"""Samples of a block at least, and per reading before."""
LASTING = 4.0
"""The factor p from which on the lag of a strange input is accepted as well."""
QUICK, SLOW, SLOWEST = 2.0, 2.0 ** (1.0 / 4.0), 2.0 ** (1.0 / 16.0)
"""Growth of the factor p: for readings that persist, for predictions, and for values that repeat themselves or jump."""
SAME, SINKING = 1.01, 0.8
"""A strange prediction repeats itself if its distance from m is that of the ones before, up to `SAME`. The latter is
the largest of them, of which `SINKING` is kept with every sample."""


def no_contradictions(n: int = 0) -> dict[str, Any]:
    """Fields before the first reading; n is the number of parameters of which a prior may say too little."""
    return {
        "judged_from": max(FIRST, n + JUDGED),
        "y_mean": 0.0, "y_variance": 0.0, "y_count": 0.0, "y_last": np.nan, "widening": 1.0, "y_strange": np.nan,
        "farthest": 0.0, "mean_ratio": 0.0, "ratios": 0.0, "shift": 0.0,
        "lagging": 0.0, "usual_variance": 0.0, "ordinary": 0.0, "block_size": 0, "block_left": 0, "block_sum": 0.0,
        "block_squares": 0.0, "block_ratios": 0.0, **trusted_inputs(),
    }  # fmt: skip


@kernel
def learn_range(s: State, away: float, variance: float, count: float, l: int) -> None:
    """Mean and variance of the readings, with ``count`` more that have a mean ``away`` from the former, and this
    variance."""
    s.y_count[l] += count
    share = count / min(max(s.y_count[l], 1.0), MEMORY)
    s.y_mean[l] += share * away
    s.y_variance[l] += share * (variance + (1.0 - share) * away * away - s.y_variance[l])


@kernel
def learn_reading(s: State, y: float, l: int) -> None:
    """The same with one reading; if it repeats the last, it has nothing new."""
    learn_range(s, y - s.y_mean[l], 0.0, 1.0 if (y != s.y_last[l]) | (s.y_count[l] < 1.0) else 0.0, l)
    s.y_last[l] = y


@kernel
def learn_ratio(s: State, ratio: float, count: float, l: int) -> None:
    """Mean of e^2 / s, with ``count`` more that have the mean ``ratio``."""
    s.ratios[l] = min(s.ratios[l] + count, MEMORY)
    bounded = min(ratio, max(CLIP / count, BLOCK_CLIP) * s.mean_ratio[l]) if s.ratios[l] > ENOUGH else ratio
    s.mean_ratio[l] += count * (bounded - s.mean_ratio[l]) / max(s.ratios[l], 1.0)


@kernel
def add_to_block(s: State, ratio: float, l: int) -> None:
    """Add a sample, if it is used, with e^2 / s in units of the scale of the noise."""
    used = s.ok[l] > 0.0
    away = s.y[l] + s.shift[l] - s.y_mean[l] if used else 0.0
    s.block_sum[l] += away
    s.block_squares[l] += away * away
    s.block_ratios[l] += ratio if used else 0.0
    s.block_left[l] -= 1 if used else 0


@partial(kernel, inline=False)
def close_block(s: State, l: int) -> None:
    """Learn from the samples of the block, and begin the next one.

    A block of one sample is the present one, or follows one that was not ordinary; one of equal readings is left out.
    """
    count = float(s.block_size[l] - s.block_left[l])
    if count > 0.0:
        away, square = s.block_sum[l] / count, s.block_squares[l] / count
        ratio = s.block_ratios[l] / (count * s.scale[l])
        variance = max(square - away * away, 0.0)
        differ = variance > ROUNDING * square
        if count == 1.0:
            learn_reading(s, s.y_mean[l] + away, l)
        if (count > 1.0) & differ:
            learn_range(s, away, variance, count, l)
        if (ratio >= 0.0) & (s.y_count[l] > s.judged_from[l] - JUDGED) & ((count == 1.0) | differ):
            learn_ratio(s, ratio, count, l)
    known = (s.y_count[l] >= s.judged_from[l]) & (s.ratios[l] >= ENOUGH)
    calm = (s.widening[l] <= 1.0) & (s.lagging[l] + s.distrusted[l] <= 0.0)
    size = int(min(max(GROWING * s.y_count[l], BLOCK), GROWING * MEMORY)) if known & calm else 0
    most = UNUSUAL * UNUSUAL * s.usual_variance[l] * s.mean_ratio[l]
    reach = REACH * REACH * s.y_variance[l]
    s.ordinary[l] = min(most, reach) if most > 0.0 else reach
    s.block_size[l], s.block_left[l] = size, size
    s.block_sum[l], s.block_squares[l], s.block_ratios[l] = 0.0, 0.0, 0.0


@kernel
def judge(s: State, y: float, shown: float, v: float, blame: float, l: int) -> None:
    """Decide whether the sample is used, s.ok and s.observed, and update s.widening, the factor p.

    ``shown`` is the predicted reading, v the variance of y - ``shown`` by the tracker, and ``blame`` the trust that the
    range of the inputs says the sample costs, 0 without blame.
    """
    # is it strange, and is its reading to blame (off > out) or its prediction?
    e, off, out = y - shown, abs(y - s.y_mean[l]), abs(shown - s.y_mean[l])
    reach, widening = REACH * REACH * s.y_variance[l], s.widening[l]
    sure = SURE if off > out else LIKELY
    judged = (s.ok[l] > 0.0) & (s.y_count[l] >= s.judged_from[l]) & (s.ratios[l] >= ENOUGH)
    strange = judged & (e * e > reach) & (e * e > sure * sure * v * s.mean_ratio[l]) & (min(off, out) < 0.5 * abs(e))
    trusted = (off > out) | (s.distrusted[l] < TRUST)
    unpredicted = (s.observed[l] > s.valid[l]) & (s.y_count[l] >= s.judged_from[l])
    outside = unpredicted & (off * off > reach)
    # the factor p: a strange reading is compared with the last one before it is judged
    of_reading, apart, follows = outside | (off > out), abs(y - s.y_strange[l]), widening > 1.0
    persists = follows & (apart > 0.0) & (apart < ALIKE * off)
    of_readings = min((QUICK if persists else SLOWEST) * widening, LONGEST)
    p = of_readings if of_reading & follows else widening
    beyond = strange & trusted & (e * e > reach * p * p)
    refused = (beyond & (off > out)) | (outside & (off * off > reach * p * p))
    # the lags of a strange input are left out where they would outweigh all samples before, or contradict them
    lasting = strange & (not beyond) & (p > LASTING)
    lagging = (
        judged
        & (not lasting)
        & (s.lagging[l] > 0.0)
        & (s.distrusted[l] < TRUST)
        & (v > 2.0 * s.r[l] * s.noise[l] * s.scale[l])
        & ((s.lagging[l] > TRUST - s.theta.shape[0]) | (e * e > LIKELY * LIKELY * v * s.mean_ratio[l]))
    )
    blamed = judged & (blame > 0.0)
    left = beyond | lagging | blamed
    spend_trust(s, blame if blamed else (1.0 if left & (off <= out) else 0.0), l)
    # what the next samples are compared with
    of_prediction = (1.0 if out * SAME < s.farthest[l] else SLOWEST) if out < SAME * s.farthest[l] else SLOW
    grown = of_readings if of_reading else min(of_prediction * widening, LONGEST)
    left_over = 0.0 if lasting else max(s.lagging[l] - 1.0, 0.0)
    s.lagging[l] = TRUST if blamed | (beyond & (off <= out)) else left_over
    s.widening[l] = (
        grown
        if strange | outside
        else (1.0 if s.ok[l] > 0.0 else (max(widening / SLOWEST, 1.0) if unpredicted else widening))
    )
    s.y_strange[l] = y if strange | outside else s.y_strange[l]
    s.farthest[l] = max(out, SINKING * s.farthest[l]) if strange else 0.0
    s.left_out[l] += 1.0 if refused else 0.0
    s.inputs_out[l] += 1.0 if left & (not refused) else 0.0
    s.observed[l] = 0.0 if refused else s.observed[l]
    s.usual_variance[l] = (
        (min(v, GROWN * s.usual_variance[l]) if s.usual_variance[l] > 0.0 else v)
        if judged & (not left)
        else s.usual_variance[l]
    )
    s.ok[l] = 0.0 if left else s.ok[l]


@partial(kernel, inline=False)
def judge_unusual(s: State, y_hat: float, v: float, blame: float, l: int) -> None:
    """Judge a sample that is not ordinary, given its prediction, the variance of that in units of the scale, and the
    blame of inputs (`driftfit.trackers.parts.faults.strange_inputs`).
    """
    close_block(s, l)
    judge(s, s.y[l] + s.shift[l], y_hat + s.shift[l], v * s.scale[l], blame, l)


@kernel
def needs_judging(s: State, e: float, l: int) -> bool:
    """Whether a sample with innovation e is not ordinary, or the block is full."""
    off = s.y[l] + s.shift[l] - s.y_mean[l]
    outside = (off * off > s.ordinary[l]) & (s.observed[l] > s.valid[l])
    return ((e * e > s.ordinary[l]) & (s.ok[l] > 0.0)) | outside | (s.block_left[l] <= 0)  # type: ignore[no-any-return]


@kernel
def needs_begin(s: State, l: int) -> int:
    """Whether ``begin`` takes the sample: in square-root form, or not ordinary.

    It reports s.y_hat and s.e, which do not depend on the time update.
    """
    y_hat = prediction(s, l)
    e = s.y[l] - y_hat
    s.y_hat[l], s.e[l] = y_hat, e
    return max(s.root[l], 1 if needs_judging(s, e, l) else 0)  # type: ignore[no-any-return]


@kernel
def judged_measurement(s: State, l: int) -> None:
    """One correction with noise variance s.r, by a sample whose s.y_hat and s.e are known."""
    e = s.e[l]
    gain = corrected(s, s.y_hat[l], symmetric_product(s, l) + s.r[l] * s.noise[l], l)
    add_to_block(s, gain * e * e, l)
    learn_inputs(s, l)


@kernel
def leave_out_contradiction(s: State, y_hat: float, v: float, l: int) -> None:
    """Leave out a sample that contradicts all before, for trackers that take so long that a comparison is nothing."""
    e = s.y[l] - y_hat
    unusual = needs_judging(s, e, l)
    if unusual:
        judge_unusual(s, y_hat, v, 0.0, l)
    add_to_block(s, e * e / v, l)
    if unusual:
        close_block(s, l)

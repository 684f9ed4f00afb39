"""Fault codes among the first samples, before a scale is known with which they could be compared.

Least squares fits any first samples, so one reading of 9999, or one in an input, would determine estimates, scales and
noise for hundreds of samples. The first samples are therefore judged together, when there are enough of them for a
start. A value is outlying if it is more than `OUTLYING` times the median absolute deviation of its column away from the
median; readings that repeat the one before count once. Where most values are equal, as of an input that often rests or
a coarse meter, the usual distance of those that differ takes its place. A sample is doubtful if

    its reading is outlying and no regressor is unusual: probably a fault code;
    or a regressor is outlying and the reading is not: a fault code of an input, or of an earlier output, now a lag.

A large output after a large input is neither. A regressor is unusual if it is outlying, or if it differs where most are
equal, as after a step of an input, and two readings or more, and most of those where it differs, are outlying; a lag
with the same fault code as the reading is not unusual. If half of the samples or more are doubtful and more cannot be
waited for, the level has changed, and no sample is doubtful. Nor are values outlying if they are more than one in
`FREQUENT` and nearer to the median than half of it: a meter of whole litres that shows 32, 32.0002 and 33 by turns.

A large input with a slow response looks the same, and its samples are the most informative of all. Doubtful samples
are therefore left out only if the others contradict them: if least squares on all samples leaves these others a sum of
squared residuals Q, and least squares on themselves only q with nu residuals, and

    nu (Q - q) > WORSE q,    or SURELY_WORSE q with `RESIDUALS_IN_DOUBT` or more

Source: the median absolute deviation as a scale is Hampel's (1974); the rule is ours. Cost: O(n N^2) for N samples,
once.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared

OUTLYING, OUTLYING_INPUT = 30.0, 10.0
"""Median absolute deviations from which on a value is outlying: 20 standard deviations of normal data; and 7 for
regressors if no sample is doubtful otherwise."""
WORSE = 36.0
"""F statistic from which samples contradict each other: six standard deviations for one sample."""
STEPS = 3
"""Number of values that differ where most are equal, as those of an input that often rests, to tell a usual one."""
SURELY_WORSE = 16.0
"""The same with `RESIDUALS_IN_DOUBT`, of which a sum of squares is less uncertain: four standard deviations."""
FREQUENT = 5
"""One value in so many may be a fault code that is near the others."""
RESIDUALS, RESIDUALS_IN_DOUBT = 4, 12
"""Number of residuals after which the first samples are judged; and of the others while some samples are doubtful."""
Y, SPAN, NOISE, READING, PHI = range(5)
"""Entries of a sample: the output, intervals of drift since the previous sample, the noise factor (negative if the
sample is doubtful), the output as it was measured, and the first entry of the regressor."""


@shared
def contradict(every: float, alone: float, residuals: float) -> bool:
    """Whether least squares on every sample, and on some alone, leave these sums of squares of the latter."""
    return (every - alone) * residuals > (WORSE if residuals < RESIDUALS_IN_DOUBT else SURELY_WORSE) * alone


@shared
def fresh(samples: Array, k: int) -> bool:
    """Whether the reading of sample k is not that of the sample before."""
    return k == 0 or samples[k, READING] != samples[max(k - 1, 0), READING]


@shared
def median(samples: Array, N: int, column: int, center: float, apart: float) -> float:
    """The upper median of a column over fresh readings, or, with apart = 1, of its distances from center.

    Every value that is not the median is a bound for it, and values beyond a bound are not counted.
    """
    count, low, high = 0, -np.inf, np.inf
    for k in range(N):
        count += 1 if fresh(samples, k) else 0
    for k in range(N):
        value: float = abs(samples[k, column] - center) if apart > 0.0 else samples[k, column]
        if low < value < high:
            less, same = 0, 0
            for other in range(N):
                x = abs(samples[other, column] - center) if apart > 0.0 else samples[other, column]
                if x <= value and fresh(samples, other):
                    less += 1 if x < value else 0
                    same += 1 if x == value else 0
            if less > count // 2:
                high = value
            elif count // 2 < less + same:
                return value
            else:
                low = value
    return 0.0


@shared
def reach(samples: Array, N: int, column: int, center: float, far: float) -> float:
    """Distance from center beyond which a value is outlying: ``far`` median deviations, inf if these are a level."""
    limit: float = far * median(samples, N, column, center, 1.0)
    count, beyond, farthest = 0, 0, 0.0
    for k in range(N):
        if fresh(samples, k):
            away = abs(samples[k, column] - center)
            count += 1
            beyond += 1 if away > limit else 0
            farthest = max(farthest, away)
    return np.inf if limit > 0.0 and FREQUENT * beyond > count and farthest < 0.5 * abs(center) else limit


@shared
def answered(samples: Array, N: int, column: int, center: float, usual: float, limit: float) -> bool:
    """Whether outlying readings go with a regressor that differs from center: two do, and most where it differs."""
    outlying, ordinary = 0, 0
    for k in range(N):
        if samples[k, column] != center:
            far = abs(samples[k, READING] - usual) > limit
            outlying += 1 if far else 0
            ordinary += 0 if far else 1
    return outlying >= 2 and outlying > ordinary


@shared
def usual_step(samples: Array, N: int, column: int, center: float) -> float:
    """The lower median of the distances from center of values that differ from it; inf for fewer than `STEPS`."""
    count = 0
    for k in range(N):
        count += 1 if samples[k, column] != center else 0
    if count < STEPS:
        return np.inf
    for k in range(N):
        step: float = abs(samples[k, column] - center)
        less, same = 0, 0
        for other in range(N):
            x = abs(samples[other, column] - center)
            less += 1 if 0.0 < x < step else 0
            same += 1 if x == step else 0
        if step > 0.0 and less <= (count - 1) // 2 < less + same:
            return step
    return np.inf


@shared
def doubt_beyond(samples: Array, N: int, last: bool, far: float) -> int:
    """`doubt`, for regressors more than ``far`` deviations away; returns the number of doubtful samples."""
    usual = median(samples, N, READING, 0.0, 0.0)
    limit = reach(samples, N, READING, usual, OUTLYING)
    if limit == 0.0:
        step = usual_step(samples, N, READING, usual)
        limit = OUTLYING * step if step < np.inf else 0.0
    for k in range(N):
        doubtful = limit > 0.0 and abs(samples[k, READING] - usual) > limit
        samples[k, NOISE] = -abs(samples[k, NOISE]) if doubtful else abs(samples[k, NOISE])
    for i in range(PHI, samples.shape[1]):
        center = median(samples, N, i, 0.0, 0.0)
        most = reach(samples, N, i, center, far)
        steps = most > 0.0 or answered(samples, N, i, center, usual, limit)
        apart = most if most > 0.0 else OUTLYING * usual_step(samples, N, i, center)
        for k in range(N):
            away = abs(samples[k, i] - center)
            if away > most:
                outlying = abs(samples[k, READING] - usual) > limit
                code = samples[k, READING] != 0.0 and abs(samples[k, i]) == abs(samples[k, READING])
                if outlying and steps and not code:
                    samples[k, NOISE] = abs(samples[k, NOISE])
                elif away > apart and not outlying:
                    samples[k, NOISE] = -abs(samples[k, NOISE])
    count, all_fresh = 0, 0
    for k in range(N):
        counts = fresh(samples, k)
        all_fresh += 1 if counts else 0
        count += 1 if counts and samples[k, NOISE] < 0.0 else 0
    if last and 2 * count >= all_fresh:
        count = 0
        for k in range(N):
            samples[k, NOISE] = abs(samples[k, NOISE])
    return count


@shared
def doubt(samples: Array, N: int, last: bool) -> None:
    """Give a negative noise factor to those of N samples (.., PHI + n) that are doubtful, a positive one to the rest.

    Half of them or more are kept as doubtful while further samples can be waited for, which is until ``last``.
    """
    if doubt_beyond(samples, N, last, OUTLYING) == 0:
        doubt_beyond(samples, N, last, OUTLYING_INPUT)


@Driver
def mark_doubtful(samples: Array) -> None:
    """`doubt`, for Python."""
    doubt(samples, len(samples), True)


def doubtful(phi: Array, y: Array, reading: Array) -> Array:
    """Which of all samples (T,) of a start are doubtful, given their regressors, outputs and readings."""
    samples = np.column_stack([y, np.ones((len(y), 2)), reading, phi])
    mark_doubtful(samples)
    found: Array = samples[:, NOISE] < 0.0
    return found

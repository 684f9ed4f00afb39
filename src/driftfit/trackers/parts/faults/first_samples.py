"""Fault codes among the first samples, before a scale is known with which they could be compared.

Least squares fits any first samples, so one reading of 9999, or one in an input, would determine estimates, scales and
noise for hundreds of samples. The first samples are therefore judged together, when there are enough of them for a
start. A value is far if it is more than `FAR` times the median absolute deviation of its column away from the median;
readings that repeat the one before count once. A sample is doubtful if

    its reading is far and no regressor is unusual: probably a fault code;
    or a regressor is far and the reading is not: a fault code of an input, or of an earlier output, which is now a lag.

A large output after a large input is neither. A regressor is unusual if it is far, or if it differs where most are
equal, as after a step of an input; a lag with the same fault code as the reading is not unusual. If half of the
samples or more are doubtful and more cannot be waited for, the level has changed, and no sample is doubtful.

A large input with a slow response looks the same, and its samples are the most informative of all. Doubtful samples
are therefore left out only if the others contradict them: if least squares on all samples leaves the other samples a
sum of squared residuals more than `WORSE` times as large as least squares on these alone.

Source: the median absolute deviation as a scale is Hampel's (1974); the rule is ours. Cost: O(n N^2) for N samples,
once.
"""

from __future__ import annotations

from driftfit.engine.kernel import Array, Driver, shared

FAR = 30.0
"""Median absolute deviations; 20 standard deviations of normal data."""
WORSE = 10.0
"""Ratio of sums of squares from which samples contradict each other."""
Y, SPAN, NOISE, READING = range(4)
"""Entries of a sample after its regressor: the output, intervals of drift since the previous sample, the noise factor
(negative if the sample is doubtful), and the output as it was measured."""


@shared
def fresh(samples: Array, k: int, reading: int) -> bool:
    """Whether the reading of sample k is not that of the sample before."""
    return k == 0 or samples[k, reading] != samples[max(k - 1, 0), reading]


@shared
def median(samples: Array, N: int, reading: int, column: int, center: float, apart: float) -> float:
    """The upper median of a column over fresh readings, or, with apart = 1, of its distances from center."""
    found, count = 0.0, 0
    for k in range(N):
        count += 1 if fresh(samples, k, reading) else 0
    for k in range(N):
        value = abs(samples[k, column] - center) if apart > 0.0 else samples[k, column]
        less, same = 0, 0
        for other in range(N):
            x = abs(samples[other, column] - center) if apart > 0.0 else samples[other, column]
            counts = fresh(samples, other, reading)
            less += 1 if counts and x < value else 0
            same += 1 if counts and x == value else 0
        found = value if less <= count // 2 and count // 2 < less + same else found
    return found


@shared
def doubt(samples: Array, N: int, n: int, last: bool) -> None:
    """Give a negative noise factor to those of N samples (.., n + 4) that are doubtful, a positive one to the rest.

    Half of them or more are kept as doubtful while further samples can be waited for, which is until ``last``.
    """
    noise, reading = n + NOISE, n + READING
    usual = median(samples, N, reading, reading, 0.0, 0.0)
    limit = FAR * median(samples, N, reading, reading, usual, 1.0)
    for k in range(N):
        doubtful = limit > 0.0 and abs(samples[k, reading] - usual) > limit
        samples[k, noise] = -abs(samples[k, noise]) if doubtful else abs(samples[k, noise])
    for i in range(n):
        center = median(samples, N, reading, i, 0.0, 0.0)
        most = FAR * median(samples, N, reading, i, center, 1.0)
        for k in range(N):
            if abs(samples[k, i] - center) > most:
                far = abs(samples[k, reading] - usual) > limit
                code = samples[k, reading] != 0.0 and abs(samples[k, i]) == abs(samples[k, reading])
                if far and not code:
                    samples[k, noise] = abs(samples[k, noise])
                elif most > 0.0 and not far:
                    samples[k, noise] = -abs(samples[k, noise])
    count, all_fresh = 0, 0
    for k in range(N):
        counts = fresh(samples, k, reading)
        all_fresh += 1 if counts else 0
        count += 1 if counts and samples[k, noise] < 0.0 else 0
    if last and 2 * count >= all_fresh:
        for k in range(N):
            samples[k, noise] = abs(samples[k, noise])


@Driver
def doubtful(samples: Array, n: int) -> None:
    """`doubt`, for Python."""
    doubt(samples, len(samples), n, True)

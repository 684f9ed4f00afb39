"""A bank after a gap: the probability of a change in it, and the density of the next sample, with the exact values.

One parameter, observed in noise of standard deviation 0.2, drifts a little and jumps by about 1 once in a hundred
samples. After a gap without observations comes a sample that is 0.6 off. The exact value sums over all numbers of jumps
in the gap. Usage: bank_gaps.py
"""

from math import comb

import numpy as np

from driftfit import GPB, Bank, Change, Regression, Sensor, track

P, DRIFT, JUMP, R, OFF = 0.01, 1e-4, 1.0, 0.04, 0.6


def density(y, s):
    """N(y; 0, s)."""
    return np.exp(-0.5 * y * y / s) / np.sqrt(2.0 * np.pi * s)


def exact(gap):
    """p(change in the gap | y), log p(y)."""
    number = np.arange(gap + 1)
    prior = np.array([float(comb(gap, k)) for k in number]) * P**number * (1.0 - P) ** (gap - number)
    total = 0.0
    none = 0.0
    for q, share in ((DRIFT, 1.0 - P), (JUMP, P)):  # the first sample, of 0, may have been preceded by a jump
        before = share * density(0.0, 1.0 + q + R)
        C = (1.0 + q) * R / (1.0 + q + R)
        parts = before * prior * density(OFF, C + number * JUMP + (gap - number) * DRIFT + R)
        total, none = total + parts.sum(), none + parts[0]
    first = (1.0 - P) * density(0.0, 1.0 + DRIFT + R) + P * density(0.0, 1.0 + JUMP + R)
    return 1.0 - none / total, np.log(total / first)


def main():
    bank = Bank([Change(DRIFT), Change(JUMP, prob=P)], [Sensor.nominal(R)], reduce=GPB(2), p0=1.0)
    print("gap   p(change)   exact   log p(y)    exact")
    for gap in (1, 2, 5, 20, 50, 100):
        y = np.r_[0.0, np.full(gap - 1, np.nan), OFF]
        run = track(Regression(1), bank, y, np.ones((gap + 1, 1)))
        found = run.hypotheses.mode_prob[-1, 1], run.hypotheses.evidence[-1]
        right = exact(gap)
        print(f"{gap:3d} {found[0]:11.3f} {right[0]:7.3f} {found[1]:10.3f} {right[1]:8.3f}")


if __name__ == "__main__":
    main()

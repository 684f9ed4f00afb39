"""The effect of the jump size that a bank assumes: errors with sizes that are wrong by factors of 3 and 10.

Prints the error of the parameters after 200 samples for 20 simulated records with rare jumps, divided by that of the
bank with the true size, and the same for the Kalman filter with the best ratio of drift to noise for these records.
Usage: jump_size.py
"""

import numpy as np

from driftfit import Bank, Change, Kalman, Regression, track
from driftfit.systems import scenarios

JUMP, RATE = 0.7, 1.0 / 200.0  # of the scenario: standard deviation, and how often
RUNS = 20


def error(tracker, records):
    """Root mean square error of theta after 200 samples, over all records."""
    squares = [np.mean((track(Regression(3), tracker, r.y, r.u).theta - r.theta)[200:] ** 2) for r in records]
    return float(np.sqrt(np.mean(squares)))


def bank(factor):
    """A bank that assumes jumps ``factor`` times as large as they are."""
    return Bank(changes=[Change(0.0), Change((factor * JUMP) ** 2, prob=RATE)])


def main():
    records = [scenarios.simulate("sparse_jumps", "regression", seed) for seed in range(RUNS)]
    r = float(np.mean([np.mean(one.noise) for one in records]))
    given = error(bank(1.0), records)
    print(f"size of the jumps given:  {given:.4f}")
    for factor in (0.1, 1.0 / 3.0, 3.0, 10.0):
        print(f"{factor:5.2g} times as large: {error(bank(factor), records) / given:.2f}")
    print(f"Bank():               {error(Bank(), records) / given:.2f}")
    best = min(error(Kalman(q=ratio * r, r=r), records) for ratio in np.logspace(-4.0, 0.0, 9))
    print(f"Kalman, best ratio:   {best / given:.2f}")


if __name__ == "__main__":
    main()

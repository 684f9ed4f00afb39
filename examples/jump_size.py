"""The effect of the jump size that a bank assumes: errors with sizes that are wrong by factors of 3 and 10.

Prints the error of the parameters after 200 samples for 20 simulated records with rare jumps, divided by that of the
bank with the true size, and the same for the Kalman filter with the best ratio of drift to noise for these records.
Usage: jump_size.py
"""

import numpy as np

from driftfit import Bank, Change, Kalman, Regression, track

JUMP, RATE, NOISE = 0.7, 1.0 / 200.0, 0.3  # size and rate of the jumps, standard deviation of the noise
RUNS, T = 20, 1000


def record(seed):
    """(y, u, theta): three parameters that jump together, and white inputs."""
    rng = np.random.default_rng([seed, *b"sparse_jumps"])
    jump = rng.random(T) < RATE
    theta = np.array([1.0, -0.5, 0.8]) + np.cumsum(jump[:, None] * rng.normal(size=(T, 3)) * JUMP, axis=0)
    noise = NOISE * rng.normal(size=T)
    rng.normal(size=T)  # that all inputs share in other records
    u = rng.normal(size=(T, 3))
    return np.sum(u * theta, axis=1) + noise, u, theta


def error(tracker, records):
    """Root mean square error of theta after 200 samples, over all records."""
    squares = [np.mean((track(Regression(3), tracker, y, u).theta - theta)[200:] ** 2) for y, u, theta in records]
    return float(np.sqrt(np.mean(squares)))


def bank(factor):
    """A bank that assumes jumps ``factor`` times as large as they are."""
    return Bank(changes=[Change(0.0), Change((factor * JUMP) ** 2, prob=RATE)])


def main():
    records, r = [record(seed) for seed in range(RUNS)], NOISE
    given = error(bank(1.0), records)
    print(f"size of the jumps given:  {given:.4f}")
    for factor in (0.1, 1.0 / 3.0, 3.0, 10.0):
        print(f"{factor:5.2g} times as large: {error(bank(factor), records) / given:.2f}")
    print(f"Bank():               {error(Bank(), records) / given:.2f}")
    best = min(error(Kalman(q=ratio * r, r=r), records) for ratio in np.logspace(-4.0, 0.0, 9))
    print(f"Kalman, best ratio:   {best / given:.2f}")


if __name__ == "__main__":
    main()

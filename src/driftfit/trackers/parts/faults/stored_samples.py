"""The samples of a diffuse start, stored so that it can be repeated without those that are doubtful.

A row of ``s.samples`` is a sample, with the entries that `driftfit.trackers.parts.faults.first_samples` lists;
``s.remembered`` rows are filled, and ``s.waited`` are the intervals of drift since the last one. Entries come before
the regressor, so that they are in the same place for any number of parameters
(`driftfit.trackers.parts.common_size`).

Cost: O(n) to store, repeat or compare a sample.
"""

from __future__ import annotations

from driftfit.engine.kernel import State, cubes, kernel, machine
from driftfit.trackers.parts.faults.first_samples import NOISE, PHI, READING, SPAN, Y, doubt


@machine
def machine_doubt(samples: int, rows: int, columns: int, count: int, last: int, L: int, l: int) -> None:
    """`doubt` for lane l of L, from the address of the samples (rows, columns)."""
    doubt(cubes(samples, rows, columns, L)[:, :, l], count, last > 0)


@kernel
def store(s: State, l: int) -> None:
    """Store the sample in the first row that is not filled."""
    at = s.remembered[l]
    for i in range(s.theta.shape[0]):
        s.samples[at, PHI + i, l] = s.phi[i, l]
    s.samples[at, Y, l], s.samples[at, READING, l] = s.y[l], s.y[l] + s.shift[l]
    s.samples[at, SPAN, l], s.samples[at, NOISE, l] = s.waited[l], s.noise[l]


@kernel
def recall(s: State, at: int, l: int) -> None:
    """The regressor, output, noise factor and shift of a stored sample are those of the present one."""
    for i in range(s.theta.shape[0]):
        s.phi[i, l] = s.samples[at, PHI + i, l]
    s.y[l], s.noise[l] = s.samples[at, Y, l], abs(s.samples[at, NOISE, l])
    s.shift[l] = s.samples[at, READING, l] - s.y[l]


@kernel
def doubtful_samples(s: State, last: int, l: int) -> int:
    """Mark the doubtful samples, and count them; ``last`` is 1 if no further samples can be waited for."""
    rows, columns, L = s.samples.shape
    machine_doubt(s.samples.ctypes.data, rows, columns, s.remembered[l], last, L, l)
    found = 0
    for at in range(s.remembered[l]):
        found += 1 if s.samples[at, NOISE, l] < 0.0 else 0
    return found


@kernel
def squares_left(s: State, l: int) -> float:
    """Sum of squares of the residuals of the samples that are not doubtful, in units of r."""
    squares = 0.0
    for at in range(s.remembered[l]):
        e, noise = s.samples[at, Y, l], s.samples[at, NOISE, l]
        for i in range(s.theta.shape[0]):
            e -= s.samples[at, PHI + i, l] * s.theta[i, l]
        squares += e * e / noise if noise > 0.0 else 0.0
    return squares


@kernel
def without_fault(s: State, y_hat: float, l: int) -> None:
    """The newest sample was left out: if its reading, and not an input, is at fault, models take it for a missing one.

    They would otherwise compute later regressors with it. ``y_hat`` is its prediction.
    """
    newest, mean, count = s.remembered[l] - 1, 0.0, 0.0
    for at in range(newest):
        used = 1.0 if s.samples[at, NOISE, l] > 0.0 else 0.0
        count += used
        mean += used * (s.samples[at, READING, l] - mean) / max(count, 1.0)
    away = s.samples[newest, READING, l] - mean
    out = y_hat + s.samples[newest, READING, l] - s.samples[newest, Y, l] - mean
    if (s.samples[newest, NOISE, l] < 0.0) & (abs(away) > abs(out)):
        s.observed[l] = 0.0

"""Published examples: systems that others estimated, with our estimates beside the truth and the best possible error.

- Box-Jenkins: the system of the example in MATLAB's page on ``bj``, y = B/F u + C/D e with B = z^-1 + 0.5 z^-2,
  C = 1 - z^-1 + 0.2 z^-2, D = 1 + 1.5 z^-1 + 0.7 z^-2, F = 1 - 1.5 z^-1 + 0.7 z^-2, variance 0.1; here 1000 samples.
- Continuous time: the benchmark of Rao and Garnier, (-6400 s + 1600) / (s^4 + 5 s^3 + 408 s^2 + 416 s + 1600), sampled
  every 10 ms at a signal-to-noise ratio of 10 dB, of which CONTSID's page on SRIVC makes its example; 7000 samples.

On line: at the end of the record. Off line: ``run.refine()``. The bound is that of Cramer and Rao, from the gradient of
the prediction at the true parameters; the error is the median over all records, as the standard deviation of a normal
distribution with that median. A record is astray if a parameter ends beyond six bounds.
"""

import numpy as np
from scipy import linalg, signal

from driftfit import RLS, BoxJenkins, ContinuousTransfer, InstrumentalVariables, track
from driftfit.smooth.problem import replay

BJ, OF_BJ = BoxJenkins(2, 2, 2, 2), np.array([1.0, 0.5, -1.0, 0.2, -1.5, -0.7, 1.5, -0.7])
RAO, OF_RAO = ContinuousTransfer(4, 1, dt=0.01, cutoff=10.0), np.array([5.0, 408.0, 416.0, 1600.0, -6400.0, 1600.0])


def box_jenkins(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """y and u."""
    u, e = rng.choice([-1.0, 1.0], 1000), np.sqrt(0.1) * rng.normal(size=1000)
    noise = signal.lfilter([1.0, -1.0, 0.2], [1.0, 1.5, 0.7], e)
    return signal.lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u) + noise, u


def rao_garnier(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """y and u."""
    u = np.repeat(rng.choice([-1.0, 1.0], 700), 10)
    A, B = np.diag(np.ones(3), 1), np.array([0.0, 0.0, -6400.0, 1600.0])
    A[:, 0] = -OF_RAO[:4]
    moved = linalg.expm(np.block([[A, B[:, None]], [np.zeros((1, 5))]]) * 0.01)
    x, y = np.zeros(4), np.zeros(7000)
    for k in range(1, 7000):
        x = moved[:4, :4] @ x + moved[:4, 4] * u[k - 1]
        y[k] = x[0]
    return y + np.std(y) * 10.0**-0.5 * rng.normal(size=7000), u


def compare(title, model, truth, record, records) -> None:
    """A table: a row for each parameter."""
    trackers = (RLS(1.0), InstrumentalVariables(1.0))
    theta, std = np.zeros((2, 2, 2, records, len(truth)))
    for seed in range(records):
        y, u = record(np.random.default_rng(seed))
        for k, tracker in enumerate(trackers):
            run = track(model, tracker, y, u)
            fine = run.refine()
            theta[k, :, seed], std[k, :, seed] = (run.theta[-1], fine.theta[-1]), (run.std[-1], fine.std[-1])
    held = track(model.held_at(truth), RLS(1.0, p0=1e-20, theta0=tuple(truth)), y, u)
    phi = replay(held)["phi"][held.ok, :, 0]
    bound = np.sqrt(np.nanmean(held.innovation[100:] ** 2) * np.diag(np.linalg.inv(phi.T @ phi)))
    error = np.median(np.abs(theta - truth), axis=2) / 0.6745
    astray = (np.abs(theta - truth) > 6.0 * bound).any(axis=3).sum(axis=2)
    inside = np.mean(np.abs(theta - truth) < 1.96 * std, axis=(2, 3))
    print(f"{title}, {records} records")
    print(f"{'':8}{'truth':>8}{'bound':>8}   on line: {'RLS':>8}{'instr.':>8}   off line: {'RLS':>8}{'instr.':>8}")
    for i, name in enumerate(track(model, trackers[0], y, u).names):
        line, off = error[:, 0, i], error[:, 1, i]
        print(
            f"{name:8}{truth[i]:8.4g}{bound[i]:8.2g}{'':12}{line[0]:8.2g}{line[1]:8.2g}{'':13}{off[0]:8.2g}{off[1]:8.2g}"
        )
    print(f"records astray{'':23}{astray[0, 0]:8}{astray[1, 0]:8}{'':13}{astray[0, 1]:8}{astray[1, 1]:8}")
    print(f"95 % bands cover{'':21}{inside[0, 0]:8.2f}{inside[1, 0]:8.2f}{'':13}{inside[0, 1]:8.2f}{inside[1, 1]:8.2f}")


def main() -> None:
    """Print both tables."""
    compare("Box-Jenkins of MATLAB's page", BJ, OF_BJ, box_jenkins, 12)
    compare("Rao and Garnier, continuous time", RAO, OF_RAO, rao_garnier, 4)


if __name__ == "__main__":
    main()

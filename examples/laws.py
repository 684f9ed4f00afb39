"""Parameters that return, turn with the day, or follow a trend: laws against the best random walk.

Each is followed over 1000 samples, of which outputs 600 to 699 are missing. The random walk has the drift that is best
for the record, in hindsight; the laws have the numbers by which the records were made.
"""

import numpy as np

from driftfit import Kalman, Law, Regression, track

T, R, RECORDS = 1000, 0.25, 20
GAP = slice(600, 700)
t = np.arange(T)


def returning(rng):
    deviation, keep = np.zeros(T), np.exp(-1.0 / 50.0)
    for k in range(1, T):
        deviation[k] = keep * deviation[k - 1] + 0.5 * np.sqrt(1.0 - keep**2) * rng.normal()
    return 2.0 + deviation


def daily(rng):
    phase = rng.uniform(0.0, 2.0 * np.pi)
    return 2.0 + np.cumsum(0.01 * rng.normal(size=T)) + 0.5 * np.cos(2.0 * np.pi * t / 48 + phase)


def trending(rng):
    return 2.0 + np.cumsum(np.cumsum(0.0005 * rng.normal(size=T)))


LAWS = {
    "returns": (returning, Law.returns(time=50, std=0.5)),
    "season": (daily, Law.season(48)),
    "trend": (trending, Law.trend(0.0005**2)),
}
WALKS = [Kalman(q=q, r=R) for q in 10.0 ** np.arange(-6.0, 0.0)]


def errors(run, theta):
    inside = np.abs(run.theta[:, 0] - theta) < 1.96 * run.std[:, 0]
    miss = (run.theta[:, 0] - theta) ** 2
    return np.sqrt(miss[50:600].mean()), np.sqrt(miss[GAP].mean()), inside[50:].mean()


print(f"{'error of theta':16}{'walk':>8}{'law':>8}{'in the gap: walk':>20}{'law':>8}{'in band: walk':>17}{'law':>8}")
for name, (path, law) in LAWS.items():
    rows = []
    for seed in range(RECORDS):
        rng = np.random.default_rng(seed)
        theta, u = path(rng), rng.normal(size=T)
        y = theta * u + np.sqrt(R) * rng.normal(size=T)
        y[GAP] = np.nan
        walk = min((errors(track(Regression(["b"]), one, y, u), theta) for one in WALKS), key=lambda found: found[0])
        own = errors(track(Regression(["b"]), Kalman(q=1e-4, r=R, laws={"b": law}), y, u), theta)
        rows.append([walk[0], own[0], walk[1], own[1], walk[2], own[2]])
    a, b, c, d, e, f = np.mean(rows, axis=0)
    print(f"{name:16}{a:8.3f}{b:8.3f}{c:20.3f}{d:8.3f}{e:17.2f}{f:8.2f}")

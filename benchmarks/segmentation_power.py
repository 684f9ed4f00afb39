"""How many jumps can be found in correlated noise: `segment` and generalised least squares that knows the noise.

400 samples, noise 0.5 with v_t = a v_(t-1) + w_t, a mean with jumps of 0.8 at 133 and 266. Rows for each a:

    known        a and the variance of w are given; the likelihood of all breaks and pairs of breaks is compared
    estimated    order 1 is given; a and the variance are estimated again for every break and pair
    segment      nothing is given

The first two divide a record if the gain of the best break or pair exceeds what 1 % of simulated records without breaks
exceed (half of one per cent for each of the two), so their rate of false breaks is 1 % by construction. A jump is found
if a break is within 20 samples of it.
Run: python benchmarks/segmentation_power.py [--quick]
"""

import sys

import numpy as np
from scipy import signal

from driftfit import segment

T, AT, LEAST, NOISE, JUMP = 400, (133, 266), 10, 0.5, 0.8
TRIED = np.arange(0.0, 0.96, 0.04)


def record(seed: int, jump: float, a: float) -> np.ndarray:
    rng, t = np.random.default_rng(seed), np.arange(T)
    e = signal.lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.normal(size=T + 200))[200:]
    return 5.0 + jump * ((t >= AT[0]) & (t < AT[1])) + NOISE * e


def sums(y: np.ndarray, a: float) -> tuple[list[float], list[tuple[int, ...]]]:
    """Least sums of squares of w with no break, one, and two, and where the breaks are."""
    z, w, b = np.r_[0.0, y[1:] - a * y[:-1]], 1.0 - a, np.arange(T)
    after = T - 1 - b
    constant, both = w * w * (T - 1), w * (1.0 + w * after)
    Sz = z + w * np.r_[np.cumsum(z[::-1])[::-1], 0.0][b + 1] - both * w * z.sum() / constant
    SS = 1.0 + w * w * after - both**2 / constant
    cross = np.where(b[:, None] < b, w + w * w * after[None], 0.0) - np.outer(both, both) / constant
    inside = (b >= LEAST) & (b <= T - LEAST)
    one = np.where(inside, Sz**2 / np.where(inside, SS, 1.0), -1.0)
    pairs = (b - b[:, None] >= LEAST) & inside & inside[:, None]
    det = np.where(pairs, np.outer(SS, SS) - cross**2, 1.0)
    two = np.where(pairs, (np.outer(Sz**2, SS) - 2.0 * cross * np.outer(Sz, Sz) + np.outer(SS, Sz**2)) / det, -1.0)
    rss = float(z @ z) - (w * z.sum()) ** 2 / constant
    at = int(one.argmax()), np.unravel_index(int(two.argmax()), two.shape)
    return [rss, rss - one.max(), rss - two.max()], [(), (at[0],), tuple(int(k) for k in at[1])]


def gains(y: np.ndarray, a: float) -> dict[str, tuple[float, float, tuple[int, ...], tuple[int, ...]]]:
    """Twice the gain of log-likelihood of the best break and the best pair, and where they are."""
    rss, at = sums(y, a)
    variance = NOISE**2 * (1.0 - a * a)
    found = {"known": ((rss[0] - rss[1]) / variance, (rss[0] - rss[2]) / variance, at[1], at[2])}
    tried = [sums(y, value) for value in TRIED]
    log = (T - 1) * np.log([rss for rss, _ in tried])
    best = log.argmin(axis=0)
    log = log.min(axis=0)
    found["estimated"] = (log[0] - log[1], log[0] - log[2], tried[best[1]][1][1], tried[best[2]][1][2])
    return found


def main(quick: bool = False) -> None:
    constant, records = (8, 4) if quick else (200, 100)
    print(f"{'a':>4}  {'':<10} {'found':>10} {'false':>6}   records divided without jumps")
    for a in (0.3, 0.6):
        null = [gains(record(10_000 + seed, 0.0, a), a) for seed in range(constant)]
        seen = [gains(record(seed, JUMP, a), a) for seed in range(records)]
        for name in ("known", "estimated"):
            one, two = np.quantile([found[name][:2] for found in null], 0.995, axis=0)
            breaks = []
            for found in seen:
                gain, pair, at, both = found[name]
                breaks.append(both if pair > two and pair - gain > two - one else at if gain > one else ())
            show(a, name, breaks, sum(g[name][0] > one or g[name][1] > two for g in null), constant)
        breaks = [tuple(b.at for b in segment(record(seed, JUMP, a)).breaks) for seed in range(records)]
        divided = sum(bool(segment(record(10_000 + seed, 0.0, a)).breaks) for seed in range(constant))
        show(a, "segment", breaks, divided, constant)


def show(a: float, name: str, breaks: list[tuple[int, ...]], divided: int, constant: int) -> None:
    hits = sum(any(abs(b - at) <= 20 for b in found) for found in breaks for at in AT)
    false = sum(map(len, breaks)) - hits
    print(f"{a:>4}  {name:<10} {hits:>3} of {2 * len(breaks)} {false:>6}   {divided} of {constant}", flush=True)


if __name__ == "__main__":
    main("--quick" in sys.argv)

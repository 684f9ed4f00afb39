"""Control while the gain jumps: a fixed PI controller, certainty equivalence, caution, and learning on purpose.

    y_(t+1) = 0.9 y_t + b_t u_t + 0.1 N(0, 1)

`Live.control` plans one sample ahead from the mean and covariance of the mixture of all hypotheses; the PI controller
has the settings that are best for it on these runs. Prints the mean squared tracking error, overall and within 15
samples of a jump: for a gain that jumps while the reference is constant, and for one that jumps in the same sample as
the reference. Run: python benchmarks/jump_control.py [--quick, a row]
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from driftfit import ARX, GPB, AdaptiveKalman, Bank, Change, Kalman, Live, Sensor

NOISE, T, RUNS, LIMIT = 0.1, 180, 20, 10.0
CHANGES, KNOWN = [Change(1e-6), Change(1.0, prob=0.01, which=[1], name="gain")], [Sensor.nominal(NOISE**2)]
BANK, MERGED = Bank(CHANGES, KNOWN, p0=1.0), Bank(CHANGES, KNOWN, reduce=GPB(2), p0=1.0)
KALMAN = Kalman(q=[1e-6, 0.01], r=NOISE**2, p0=1.0)
LAWS: dict[str, Any] = {
    "Kalman, cautious": (KALMAN, {}),
    "bank, certain": (BANK, {"caution": 0.0}),
    "bank, cautious": (BANK, {}),
    "bank, probing": (BANK, {"probe": 0.2}),
    "GPB(2), cautious": (MERGED, {}),
    "default, cautious": (AdaptiveKalman(), {}),
}
Law = Callable[[float, float], float]


def gain(t: int, late: int) -> float:
    """1, 2.6, 0.7; the jumps are ``late`` samples after the reference has changed."""
    return 1.0 if t < 60 + late else 2.6 if t < 120 + late else 0.7


def adaptive(tracker: Any, **how: float) -> Law:
    """The law of a new stream."""
    live = Live(ARX(1, 1), tracker)

    def law(y: float, ref: float) -> float:
        live.update(y)
        # the first input shows the sign of the gain
        u = 1.0 if live.samples == 1 else float(live.control(ref, 1, (-LIMIT, LIMIT), **how).u[0])
        live.apply(u)
        return u

    return law


def pi(P: float, I: float) -> Law:
    """u = P e + I sum(e), which stops where the input does."""
    total = 0.0

    def law(y: float, ref: float) -> float:
        nonlocal total
        wanted = P * (ref - y) + I * (total + ref - y)
        total += ref - y if abs(wanted) < LIMIT else 0.0
        return float(np.clip(wanted, -LIMIT, LIMIT))

    return law


def squares(make: Callable[[], Law], seed: int, late: int) -> np.ndarray:
    """Squared errors of one run."""
    rng = np.random.default_rng(seed)
    law, out, y = make(), np.zeros(T), 0.0
    for t in range(T):
        ref = 1.0 if t // 15 % 2 else -1.0
        y = 0.9 * y + gain(t, late) * law(y, ref) + NOISE * rng.standard_normal()
        out[t] = (y - ref) ** 2
    return out


def parts(make: Callable[[], Law], late: int) -> list[float]:
    """Mean squared errors: all, after jumps, otherwise."""
    near, known = np.isin(np.arange(T), late + np.r_[60:75, 120:135]), np.arange(T) >= 20
    found = np.array([squares(make, seed, late) for seed in range(RUNS)])
    return [float(found[:, part].mean()) for part in (known, near, known & ~near)]


def line(name: str, found: list[float]) -> None:
    print(f"{name:<22}" + "".join(f"{value:>12.3f}" for value in found))


def table(late: int) -> None:
    grid = [partial(pi, P, I) for P in (0.2, 0.3, 0.4, 0.5) for I in (0.02, 0.05, 0.1, 0.2)]
    line("PI, best settings", min((parts(make, late) for make in grid), key=lambda found: found[0]))
    for name, (tracker, how) in LAWS.items():
        line(name, parts(partial(adaptive, tracker, **how), late))


def main(quick: bool = False) -> None:
    heads = "all    after jumps   otherwise"
    print(f"the gain jumps alone        {heads}")
    if quick:
        line("Kalman, cautious", parts(partial(adaptive, KALMAN), 7))
        return
    table(7)
    print(f"\nwith the reference          {heads}")
    table(0)
    line("least possible", [NOISE**2] * 3)


if __name__ == "__main__":
    main("--quick" in sys.argv)

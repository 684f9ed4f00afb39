"""Control while the gain jumps: certainty equivalence and caution, both with the mixture of a bank.

    y_{t+1} = a y_t + b u_t + e,  to follow a reference: minimise E (y_{t+1} - ref)^2 over u
    certain      u = (ref - m_a y) / m_b
    cautious     u = (m_b (ref - m_a y) - P_ab y) / (m_b^2 + P_bb)

m and P are mean and covariance of the mixture of all hypotheses. Prints the mean squared tracking error, overall and
within 15 samples of a jump: for a gain that jumps while the reference is constant, and for one that jumps in the same
sample as the reference. Run: python examples/jump_control.py
"""

import numpy as np

from driftfit import ARX, GPB, Bank, Change, Kalman, Live, Sensor

NOISE, T, RUNS = 0.1, 180, 30
CHANGES, KNOWN = [Change(1e-6), Change(1.0, prob=0.01, which=[1], name="gain")], [Sensor.nominal(NOISE**2)]
BANK, MERGED = Bank(CHANGES, KNOWN, p0=1.0), Bank(CHANGES, KNOWN, reduce=GPB(2), p0=1.0)
KALMAN = Kalman(q=[1e-6, 0.01], r=NOISE**2, p0=1.0)


def gain(t: int, late: int) -> float:
    """1, 2.6, 0.7; the jumps are ``late`` samples after the reference has changed."""
    return 1.0 if t < 60 + late else 2.6 if t < 120 + late else 0.7


def certain(m: np.ndarray, P: np.ndarray, y: float, ref: float) -> float:
    return (ref - m[0] * y) / m[1] if m[1] else 0.0


def cautious(m: np.ndarray, P: np.ndarray, y: float, ref: float) -> float:
    return (m[1] * (ref - m[0] * y) - P[0, 1] * y) / (m[1] ** 2 + P[1, 1])


def squares(tracker: object, law: object, seed: int, late: int) -> np.ndarray:
    """Squared errors of one run; inputs are limited to +-10."""
    rng = np.random.default_rng(seed)
    live, out = Live(ARX(1, 1, nk=0, start="zero"), tracker), np.zeros(T)
    u = 1.0  # a first input, to learn the sign of the gain
    y = gain(0, late) * u + NOISE * rng.standard_normal()
    for t in range(T):
        ref = 1.0 if t // 15 % 2 else -1.0
        live.update(y, u)  # y_t, the response to the previous input
        u = float(np.clip(law(live.theta, live.cov, y, ref), -10.0, 10.0))
        y = 0.9 * y + gain(t, late) * u + NOISE * rng.standard_normal()
        out[t] = (y - ref) ** 2
    return out


def table(late: int) -> None:
    near = np.isin(np.arange(T), late + np.r_[60:75, 120:135])
    known = np.arange(T) >= 20
    for name, tracker, law in (
        ("Kalman, certain", KALMAN, certain),
        ("Kalman, cautious", KALMAN, cautious),
        ("bank, certain", BANK, certain),
        ("bank, cautious", BANK, cautious),
        ("GPB(2), cautious", MERGED, cautious),
    ):
        found = np.array([squares(tracker, law, seed, late) for seed in range(RUNS)])
        parts = [found[:, part].mean() for part in (known, near, known & ~near)]
        print(f"{name:<20}" + "".join(f"{value:>12.3f}" for value in parts))


def main() -> None:
    heads = "all    after jumps   otherwise"
    print(f"the gain jumps alone      {heads}")
    table(7)
    print(f"\nwith the reference        {heads}")
    table(0)
    print(f"{'least possible':<20}" + f"{NOISE**2:>12.3f}" * 3)


if __name__ == "__main__":
    main()

"""Control while the gain jumps: certainty equivalence against caution, both with the mixture of a bank.

    y_{t+1} = a y_t + b u_t + e,  to follow a reference: minimise E (y_{t+1} - ref)^2 over u
    certain      u = (ref - m_a y) / m_b
    cautious     u = (m_b (ref - m_a y) - P_ab y) / (m_b^2 + P_bb)

m and P are mean and covariance of the mixture of all hypotheses. Prints the mean squared error of following, over all
and within 15 samples of a jump. Run: python examples/jump_control.py
"""

import numpy as np

from driftfit import ARX, Bank, Change, Kalman, Live, Sensor

NOISE, T, RUNS = 0.1, 180, 30
BANK = Bank([Change(1e-6), Change(1.0, prob=0.01, which=[1], name="gain")], [Sensor.nominal(NOISE**2)], p0=1.0)
KALMAN = Kalman(q=[1e-6, 0.01], r=NOISE**2, p0=1.0)


def gain(t: int) -> float:
    return 1.0 if t < 60 else 2.6 if t < 120 else 0.7


def certain(m: np.ndarray, P: np.ndarray, y: float, ref: float) -> float:
    return (ref - m[0] * y) / m[1] if m[1] else 0.0


def cautious(m: np.ndarray, P: np.ndarray, y: float, ref: float) -> float:
    return (m[1] * (ref - m[0] * y) - P[0, 1] * y) / (m[1] ** 2 + P[1, 1])


def squares(tracker: object, law: object, seed: int) -> np.ndarray:
    """Squared errors of one run; inputs are limited to +-10."""
    rng = np.random.default_rng(seed)
    live, out = Live(ARX(1, 1, nk=0, start="zero"), tracker), np.zeros(T)
    u = 1.0  # a first move, to learn the sign of the gain
    y = gain(0) * u + NOISE * rng.standard_normal()
    for t in range(T):
        ref = 1.0 if t // 15 % 2 else -1.0
        live.update(y, u)  # y_t, which the input before it made
        u = float(np.clip(law(live.theta, live.cov, y, ref), -10.0, 10.0))
        y = 0.9 * y + gain(t) * u + NOISE * rng.standard_normal()
        out[t] = (y - ref) ** 2
    return out


def main() -> None:
    near = np.isin(np.arange(T), np.r_[60:75, 120:135])
    late = np.arange(T) >= 20
    print("                          all    after jumps   otherwise")
    for name, tracker, law in (
        ("Kalman, certain", KALMAN, certain),
        ("Kalman, cautious", KALMAN, cautious),
        ("bank, certain", BANK, certain),
        ("bank, cautious", BANK, cautious),
    ):
        found = np.array([squares(tracker, law, seed) for seed in range(RUNS)])
        parts = [found[:, part].mean() for part in (late, near, late & ~near)]
        print(f"{name:<20}" + "".join(f"{value:>12.3f}" for value in parts))
    print(f"{'least possible':<20}" + f"{NOISE**2:>12.3f}" * 3)


if __name__ == "__main__":
    main()

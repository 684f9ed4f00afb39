"""A control loop: y_t is read, then u_t is chosen and applied; and the effect of passing the two to `Live` wrongly.

    y_(t+1) = 1.05 y_t + b_t u_t + 0.1 N(0, 1),     b_t = 0.5, and 1 from sample 200 on

The plant is unstable and follows a set-point that changes between -1 and 1; u is limited to +-20. The law is certainty
equivalence, or its cautious variant, which allows for the uncertainty of the gain:

    u = (ref - a y) / b,     u = (b (ref - a y) - P_ab y) / (b^2 + P_bb)

Prints the root mean square of the error after the first 50 samples, and the share of loops that diverged (|y| above
1000). Run: python examples/control_loop.py
"""

import numpy as np

from driftfit import ARX, Kalman, Live

T, LOOPS, LIMIT, LOST = 400, 40, 20.0, 1000.0


def certain(m: np.ndarray, P: np.ndarray, y: float, ref: float) -> float:
    return (ref - m[0] * y) / m[1]


def cautious(m: np.ndarray, P: np.ndarray, y: float, ref: float) -> float:
    return (m[1] * (ref - m[0] * y) - P[0, 1] * y) / (m[1] ** 2 + P[1, 1])


def followed(order: str, law: object, seed: int) -> float:
    """Root mean square error of one loop; inf if it diverged."""
    rng = np.random.default_rng(seed)
    live = Live(ARX(1, 1), Kalman(q=[1e-4, 1e-3], r=0.01, p0=1.0, theta0=[0.5, 0.7]))
    y, errors = 0.0, np.zeros(T)
    for t in range(T):
        ref = 1.0 if t // 25 % 2 else -1.0
        if order == "right":
            live.update(y)  # y_t, before there is an input
        u = float(np.clip(law(live.theta, live.cov, y, ref), -LIMIT, LIMIT))
        if order == "right":
            live.apply(u)  # u_t: its effect appears in y_(t+1)
        y = 1.05 * y + (0.5 if t < T // 2 else 1.0) * u + 0.1 * rng.standard_normal()
        if order == "wrong":
            live.update(y, u)  # y_(t+1) in one row with u_t
        if abs(y) > LOST:
            return np.inf
        errors[t] = y - ref
    return float(np.sqrt(np.mean(errors[50:] ** 2)))


def main() -> None:
    print(f"{'':<44}{'error, median':>14}{'largest':>10}{'lost':>8}")
    for name, law in (("certainty equivalence", certain), ("cautious", cautious)):
        for order, result in (("right", "update(y), apply(u)"), ("wrong", "update(y, u)")):
            found = np.array([followed(order, law, seed) for seed in range(LOOPS)])
            lost = f"{100.0 * np.mean(np.isinf(found)):.0f} %"
            print(f"{name:<23}{result:<21}{np.median(found):>14.3f}{found.max():>10.3f}{lost:>8}")
    print(f"{'least possible':<44}{0.1:>14.3f}")


if __name__ == "__main__":
    main()

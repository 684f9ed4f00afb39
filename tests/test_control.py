"""`Live.control`: closed forms one sample ahead, the minimum of J within limits, caution, probing, what is refused."""

import numpy as np
import pytest
from scipy import optimize

from driftfit import ARX, FLS, AdaptiveKalman, AugmentedFLS, Kalman, Live, Regression

KALMAN = Kalman(q=1e-3, r=0.01, p0=1.0)


PLAIN, DELAYED = ARX(1, 1), ARX(2, (2, 1), nk=(1, 3))


def stream(model: ARX = PLAIN, tracker: object = KALMAN, T: int = 12, seed: int = 0) -> Live:
    """A stream whose last input is outstanding where the model allows it."""
    rng = np.random.default_rng(seed)
    live, y, u = Live(model, tracker), np.zeros(T + 1), rng.normal(size=(T + 1, 2))
    later = model.lags[0][1] > 0
    for t in range(1, T + 1):
        y[t] = 0.8 * y[t - 1] + 0.5 * u[t - 1, 0] + 0.1 * rng.normal()
        row = u[t, : live.model.m]
        if later:
            live.update(y[t])
            if t < T:
                live.apply(row)
        else:
            live.update(y[t], row)
    return live


def points(live: Live, h: int) -> np.ndarray:
    """theta (S, h, n), written from the page: a random walk from the present mean and covariance."""
    n = len(live.theta)
    P = np.array([live.cov + (k + 1) * 1e-3 * np.eye(n) for k in range(h)])
    roots = np.sqrt(n) * np.linalg.cholesky(P)
    return np.concatenate([live.theta + sign * roots.transpose(2, 0, 1) for sign in (1, -1)])


def outputs(live: Live, theta: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Outputs (S, h) of an ARX model, sample by sample; u (h, m) begins with that of now."""
    lane, terms = live.lane(), live.model.terms or ()
    past_y = list(lane["y_lag"][0, ::-1])
    past_u = np.vstack([lane["u_lag"].T[:0:-1], u])
    found = np.zeros(theta.shape[:2])
    for s in range(len(theta)):
        y = past_y.copy()
        for k in range(len(u)):
            now = len(past_u) - len(u) + k + 1
            phi = [y[-lag] if what == "y" else past_u[now - lag, j] for what, j, lag in terms]
            y.append(float(np.dot(phi, theta[s, k])))
        found[s] = y[len(past_y) :]
    return found


@pytest.mark.parametrize("later", [True, False])
def test_one_sample_ahead_is_the_closed_form(later: bool) -> None:
    live = stream(ARX(1, 1, nk=int(later)))
    m, P, y = live.theta, live.cov + 1e-3 * np.eye(2), live.lane()["y_lag"][0, 0]
    certain = (2.0 - m[0] * y) / m[1]
    cautious = (m[1] * (2.0 - m[0] * y) - P[0, 1] * y) / (m[1] ** 2 + P[1, 1])
    assert live.control(2.0, 1, caution=0.0).u == pytest.approx([certain], rel=1e-6)
    assert live.control(2.0, 1).u == pytest.approx([cautious], rel=1e-6)


def test_the_plan_is_the_minimum_of_j_within_limits_and_moves() -> None:
    live = stream(DELAYED, T=30)
    h, target, effort = 5, np.array([1.0, 2.0, -1.0, 0.5, 3.0]), 0.02
    given = np.full((h, 2), np.nan)
    given[2, 1] = 0.4
    plan = live.control(target, h, ([-0.6, -1.0], [0.6, 1.5]), move=[0.5, 1.0], effort=effort, u=given)
    theta, last = points(live, h), live.lane()["u_lag"][:, 1]

    def j(v: np.ndarray) -> float:
        u = v.reshape(h, 2)
        off = outputs(live, theta, u) - target
        return float(np.sum(np.mean(off**2, axis=0)) + effort * np.sum(np.diff(u, axis=0, prepend=last[None]) ** 2))

    def room(v: np.ndarray) -> np.ndarray:
        moves = np.diff(v.reshape(h, 2), axis=0, prepend=last[None])
        return np.concatenate([([0.5, 1.0] - np.abs(moves)).ravel(), [1e-9 - abs(v[5] - 0.4)]])

    reach = np.arange(1, h + 1)[:, None] * [0.5, 1.0]
    low = np.minimum([-0.6, -1.0], last + reach).ravel()
    high = np.maximum([0.6, 1.5], last - reach).ravel()
    best = optimize.minimize(
        j, plan.u.ravel() * 0.9, bounds=list(zip(low, high, strict=True)),
        constraints={"type": "ineq", "fun": room}, method="SLSQP", options={"ftol": 1e-12, "maxiter": 500},
    )  # fmt: skip
    v = plan.u.ravel()
    assert min(room(v).min(), (v - low).min(), (high - v).min()) > -1e-9
    assert j(v) <= best.fun * (1.0 + 1e-6)
    assert plan.u[2, 1] == 0.4
    found = outputs(live, theta, plan.u)
    np.testing.assert_allclose(plan.y_hat, found.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(plan.theta_std, found.std(axis=0), rtol=1e-9)
    assert "Plan for 5 samples" in repr(plan)


def test_without_caution_the_outputs_are_those_of_the_forecast() -> None:
    live = stream()
    plan = live.control(1.0, 6, (-0.3, 0.3), caution=0.0)
    np.testing.assert_allclose(plan.y_hat, live.forecast(6, plan.u).y_hat, rtol=1e-9)


def test_certainty_equivalence_does_not_start_by_itself_and_probing_does() -> None:
    """Without an input nothing is learned of its gain, which begins at 0."""
    errors = {}
    for name, how in (("certain", {"caution": 0.0}), ("probing", {"probe": 0.2})):
        rng, live, y, off = np.random.default_rng(3), Live(ARX(1, 1), KALMAN), 0.0, []
        for t in range(120):
            live.update(y)
            u = float(live.control(1.0 if t // 15 % 2 else -1.0, 1, (-4.0, 4.0), move=3.0, **how).u[0])
            live.apply(u)
            assert abs(u) <= 4.0
            y = 0.9 * y + 1.3 * u + 0.1 * rng.normal()
            off.append(y - (1.0 if t // 15 % 2 else -1.0))
        errors[name] = float(np.mean(np.square(off[20:])))
    assert errors["certain"] > 0.5
    assert errors["probing"] < 0.05


def test_an_input_outside_its_limits_returns_by_its_moves() -> None:
    live = stream()
    live.apply(5.0)
    live.update(2.0)
    assert live.control(0.0, 3, (-1.0, 1.0), move=2.0).u[:2] == pytest.approx([3.0, 1.0])


def test_inputs_are_held_where_nothing_can_be_planned() -> None:
    live = Live(ARX(1, 1), AdaptiveKalman())
    live.update(1.0)
    live.apply(0.7)
    live.update(0.9)
    plan = live.control(1.0, 3)
    assert "held: the data do not determine" in repr(plan)
    assert plan.u.tolist() == [0.7] * 3
    assert np.isnan(plan.y_hat).all()
    late = stream(DELAYED)
    late.apply([np.nan, 0.0])
    late.update(0.2)
    assert "missing" in late.control(1.0, 4).held


@pytest.mark.parametrize(
    ("model", "tracker", "how", "message"),
    [
        (Regression(1), KALMAN, {}, "needs a stream of an ARX model"),
        (ARX(1, 1), FLS(10.0, differences=2), {}, "parameters have no slopes"),
        (ARX(1, 1), AugmentedFLS(10.0), {}, "give caution=0"),
        (ARX(1, 1), KALMAN, {"limits": (1.0, -1.0)}, "limits are (low, high)"),
        (ARX(1, 1), KALMAN, {"effort": -1.0}, "effort"),
        (ARX(1, 1), KALMAN, {"horizon": 0}, "h must be a whole number"),
        (ARX(1, 1), KALMAN, {"u": [5.0, np.nan], "horizon": 2, "limits": (-1, 1), "move": 0.1}, "leave none within"),
    ],
)
def test_what_cannot_be_planned_is_refused(model: ARX, tracker: object, how: dict[str, object], message: str) -> None:
    live = Live(model, tracker)
    if isinstance(model, ARX):
        live = stream(model, tracker)
    with pytest.raises(ValueError, match=message.replace("(", r"\(").replace(")", r"\)")):
        live.control(1.0, **how)  # type: ignore[arg-type]

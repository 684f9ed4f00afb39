"""Inputs that come after their output: bit for bit the record, whatever happens in between; a loop that needs it."""

import copy
import pickle

import numpy as np
import pytest
from support import arx_record, damaged, same

from driftfit import ARX, HammersteinWiener, Kalman, Live, OutputError, Regression, track
from driftfit.data.storage import fields
from driftfit.models.hammerstein_wiener.basis import Legendre

K = Kalman(q=1e-3, r=0.01)
Y, U = damaged(*arx_record(60, 1))
TWO = np.column_stack([Y, Y[::-1]])


def again(live, t):
    """What may be done to a stream between an output and its input."""
    ways = (lambda live: live, lambda live: pickle.loads(pickle.dumps(live)), copy.copy, copy.deepcopy,
            lambda live: type(live).from_bytes(live.to_bytes()))  # fmt: skip
    return ways[t % len(ways)](live)


@pytest.mark.parametrize(
    ("model", "tracker", "y", "u"),
    [
        (ARX(2, 2), K, Y, U),
        (ARX(1, 1, ny=2), K, TWO, U),
        (HammersteinWiener(2, 2, input=Legendre(2, (-4, 4))), OutputError(q=1e-4, r=0.1, q_w=0.1), Y, U),
        (HammersteinWiener(1, 1, nk=[1, 2], input=[Legendre(2, (-4, 4)), None]), K, Y, np.column_stack([U, U[::-1]])),
    ],
    ids=["ARX", "two outputs", "Hammerstein", "two inputs"],
)
def test_output_then_input_is_the_record(model, tracker, y, u):
    whole, split = Live(model, tracker), Live(model, tracker)
    for t in range(len(y)):
        assert all(same(a, b) for a, b in zip(whole.update(y[t], u[t]), split.update(y[t]), strict=True))
        assert split.awaits
        split = again(split, t)
        assert all(same(a, b) for a, b in zip(split.predict(u[t]), whole.predict(), strict=True))
        if t in (7, 40):
            ahead = whole.forecast(3, [*u[t + 1 : t + 3], 0.0 * u[0]])
            assert split.forecast(3, u[t : t + 3]).table.equals(ahead.table)
        split.apply(u[t])
        assert not split.awaits
        for name in set(fields(whole._tile)) - {"u", *tracker.scratch}:
            assert same(whole._tile[name], split._tile[name]), (t, name)
    assert same(split.theta, track(model, tracker, y, u).theta[-1])


def test_times_windows_and_warm_starts_go_along():
    time = np.cumsum(np.where(np.arange(60) % 7 == 3, 0.0, 1.0)) + np.where(np.arange(60) > 30, 5.0, 0.0)
    whole, split = (Live(ARX(2, 2), K, lag=4) for _ in range(2))
    for t in range(60):
        # a time that is not after the last is ignored, and its input with it
        assert same(whole.update(Y[t], U[t], time=time[t]), split.update(Y[t], time=time[t]))
        split = again(split, t)
        split.apply(U[t])
    assert split.ignored == whole.ignored > 0
    assert same(split.theta, whole.theta)
    assert same(split.smooth().std, whole.smooth().std)
    waiting = Live(ARX(2, 2), K)
    waiting.update(1.0)
    onward = Live(ARX(2, 2), K, warm_start=waiting)
    assert onward.awaits
    onward.apply(1.0)


def test_the_order_is_enforced():
    live = Live(ARX(2, 2), K)
    with pytest.raises(ValueError, match=r"no sample is waiting.*update\(y\) without u, then apply"):
        live.apply(1.0)
    live.update(1.0)
    before = live.to_bytes()
    for late in (lambda: live.update(1.0), lambda: live.update(1.0, 2.0), lambda: live.update(1.0, 1.0, time=3.0)):
        with pytest.raises(ValueError, match="input of the last sample has not been given yet"):
            late()
    with pytest.raises(ValueError, match="1 inputs, but u has shape"):
        live.apply([1.0, 2.0])
    assert live.to_bytes() == before
    live.apply(None)
    assert live.update(1.0, None)[3] is False
    two = Live(ARX(1, 1, ny=2), K)
    two.update([1.0, 2.0])
    with pytest.raises(ValueError, match="has not been given yet"):
        two.update([1.0, 2.0], 1.0)
    with pytest.raises(ValueError, match=r"1 inputs, but u has shape"):
        two.apply([1.0, 2.0])
    two.apply(1.0)


@pytest.mark.parametrize(
    "model", [Regression(1), Regression(2), ARX(1, [1, 1], nk=[0, 1]), ARX(2, 1, nk=0)], ids=lambda model: repr(model)
)
def test_a_model_that_needs_its_input_at_once_says_so(model):
    live = Live(model, K)
    before = live.to_bytes()
    with pytest.raises(ValueError, match=r"no input was given.*update\(y, u\).*apply\(u\)"):
        live.update(1.0)
    with pytest.raises(ValueError, match="no input was given"):
        live.update(1.0, weight=2.0)
    assert live.to_bytes() == before
    assert not live.update(1.0, None)[3]


def loop(right, T=300, seed=0):
    """Mean square error of y_(t+1) = 1.05 y_t + b u_t + e under certainty equivalence; inf where it is lost."""
    rng = np.random.default_rng(seed)
    live = Live(ARX(1, 1), Kalman(q=[1e-4, 1e-3], r=0.01, p0=1.0, theta0=[0.5, 0.7]))
    y, errors = 0.0, np.zeros(T)
    for t in range(T):
        ref = 1.0 if t // 25 % 2 else -1.0
        if right:
            live.update(y)
        u = float(np.clip((ref - live.theta[0] * y) / live.theta[1], -20.0, 20.0))
        if right:
            live.apply(u)
        y = 1.05 * y + (0.5 if t < T // 2 else 1.0) * u + 0.1 * rng.standard_normal()
        if not right:
            live.update(y, u)  # y_(t+1) in a row with u_t, which the model takes for the input of the sample after
        if abs(y) > 1000.0:
            return np.inf
        errors[t] = y - ref
    return float(np.mean(errors[50:] ** 2))


def test_a_loop_is_held_in_the_right_order_and_lost_in_the_wrong_one():
    """The least possible is the variance of the noise, 0.01; learning the gain and its jump cost the rest."""
    assert max(loop(True, seed=seed) for seed in range(10)) < 0.08
    assert [loop(False, seed=seed) for seed in range(10)] == [np.inf] * 10

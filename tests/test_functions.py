"""Plain functions as models: the formula has the values of the function, and what cannot be read is named."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from driftfit import Equation, StateSpace

GRAVITY = 9.81


def drag(v, theta, power=2):
    return theta.d * v**power if v > 0 else -theta.d * v**power


def force(u, theta):
    """Branches, a loop, unpacking, a function within, and numbers from outside."""
    m, d = theta.m, theta.d
    total = 0.0
    for i in range(1, 4):
        total += i * u.f / (m + i)
    if u.v > 1.0 and not u.v >= 2.0:
        total -= drag(u.v, theta) / m
    elif 0.0 < u.v <= 0.5 or u.f > 1.5:
        return total - GRAVITY * math.sin(u.slope) + np.clip(u.v, 0.1, 0.3)
    low, high = (-1.0, d)
    return total + np.where(u.slope > 0, np.hypot(u.v, low), max(u.v, high, 0.2)) - np.log10(2.0 + np.square(u.slope))


def test_the_formula_has_the_values_of_the_function():
    model, rng = Equation(force), np.random.default_rng(0)
    assert model.outputs == ("force",)
    assert set(model.names) == {"m", "d"}
    for _ in range(300):
        theta = SimpleNamespace(m=rng.uniform(1.0, 2.0), d=rng.uniform(0.1, 1.0))
        u = SimpleNamespace(f=rng.uniform(0.0, 2.0), v=rng.uniform(-1.0, 3.0), slope=rng.normal())
        signals = {name: np.array([[getattr(u, name)]]) for name in model.input_names}
        given = np.array([[getattr(theta, name)] for name in model.names])
        assert model.formula.value(given, signals)[0] == pytest.approx(force(u, theta), rel=1e-12)


def test_states_lags_time_and_single_inputs():
    def move(x, u, theta, t, dt):
        k, c = theta
        return {"a": x.a + dt * (k * u - c * x.b), "b": x["b"] + 0.1 * t}

    def level(x, theta, y, u):
        return x.a + theta.k * y[-1] + theta["c"] * u[-2]

    assert StateSpace([move, level], start={"a": 2.0}) == StateSpace(
        """
        a = a[-1] + dt * (theta.k * u - theta.c * b[-1])
        b = b[-1] + 0.1 * clock
        level = a + theta.k * level[-1] + theta.c * u[-2]
        """.replace("        ", "").strip(),
        start={"a": 2.0},
    )

    def heat(u, theta):
        return theta[0] * u[0] + theta[1] * u.T[-1]

    assert Equation(heat).equation == "heat = theta.theta0 * u0 + theta.theta1 * T[-1]"
    model = Equation(heat)
    assert Equation.from_settings(model.settings()) == model


def test_what_cannot_be_read_is_named():
    def endless(u, theta):
        while u.a > 0:
            pass
        return theta.k

    def long(u, theta):
        total = 0.0
        for i in u:
            total += i
        return total

    def other(p, theta):
        return theta.k * p

    def nothing(u, theta):
        if u.a > 0:
            return theta.k

    def unknown(u, theta):
        return np.linalg.norm(u.a) * theta.k

    def whole(u, theta):
        return theta * u.a

    def tuple_of(x, u, theta):
        return theta.k, x.a

    for function, message in (
        (endless, "'while u.a > 0:' is not understood"), (long, "'for i in u' has no known length"),
        (other, "other takes p; arguments are x, u"), (nothing, "nothing has a branch that returns nothing"),
        (unknown, "cannot be read|not understood|source"), (whole, "theta itself is no number; use its parts"),
        (lambda u, theta: theta.k * u, "has no name of its own|lambda"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            Equation(function)
    with pytest.raises(ValueError, match="tuple_of must return the states by name"):
        StateSpace([tuple_of, force])
